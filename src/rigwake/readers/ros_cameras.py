"""Which image topics of a ROS bag are cameras, and the lens of each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from rigwake.cameras.protocol import CameraModel
from rigwake.errors import InputError
from rigwake.readers.camera_info_choice import INFO, lens_from_infos
from rigwake.readers.channels import Channel
from rigwake.readers.images import ImageSize
from rigwake.readers.rig_description import RigDescription
from rigwake.readers.ros_decoding import HEADER_BYTES, StampedRows, read_header, stamped_rows
from rigwake.readers.ros_frames import (
    COMPRESSED,
    IMAGE_TYPES,
    ImageFormat,
    RosFrames,
    first_image_format,
    other_formats,
    used_sample_bits,
)
from rigwake.readers.streams import time_order
from rigwake.readers.topics import (
    TopicMap,
    camera_base,
    distinct_names,
    image_base,
    info_topics,
    is_rectified,
    sensor_names,
)
from rigwake.recording import CameraStream, Finding

_ABOUT_AS_FULL = 0.95  # of the messages of the fullest topic of a camera


@dataclass(frozen=True, eq=False)
class ImageTopic:
    """A topic of images: its messages' stamps, and the format of its first readable image."""

    channel: Channel
    stamped: StampedRows
    format: ImageFormat

    @property
    def topic(self) -> str:
        """Its name."""
        return self.channel.topic

    @property
    def frame_id(self) -> str:
        """The optical frame that its first header names."""
        return self.stamped.frame_id


def read_cameras_of_bag(
    channels: Mapping[str, Channel],
    headers: Mapping[str, Sequence[bytes]],
    topics: TopicMap,
    description: RigDescription,
) -> tuple[dict[str, CameraStream], list[Finding]]:
    """All cameras by name, and what was left out or repaired.

    headers: first bytes of the messages of an image topic, where they were read already. description: names that
    the recording itself gives. Topics of depth are
    left out unless the user names them; of several topics of one camera one is taken.
    """
    chosen, findings = topics.chosen("camera"), []
    images: dict[str, ImageTopic] = {}
    for topic, channel in channels.items():
        if channel.message_type in IMAGE_TYPES and (chosen is None or topic in chosen.values()):
            try:
                images[topic] = _image_topic(channel, headers.get(topic))
            except InputError as error:
                findings.append(Finding("error", topic, f"left out: {error.cause}"))
    if chosen is None:
        selected = _one_topic_per_camera(images, findings)
        names = sensor_names([image.topic for image in selected], "camera")
        given = {topic: description.name_of("camera", topic, name) for topic, name in names.items()}
        names = distinct_names(given)
        named = {names[image.topic]: image for image in selected}
    else:
        named = {name: images[topic] for name, topic in chosen.items() if topic in images}
    infos = {topic: c for topic, c in channels.items() if c.message_type == INFO}
    lenses = _info_of_each(named, infos)
    cameras = {}
    for name, image in named.items():
        try:
            cameras[name] = _camera(name, image, lenses.get(name), findings)
        except InputError as error:
            findings.append(Finding("error", name, f"left out: {error.cause}"))
    return cameras, findings


def _image_topic(channel: Channel, headers: Sequence[bytes] | None) -> ImageTopic:
    starts = headers or list(channel.payloads.read(range(len(channel)), HEADER_BYTES))
    stamped = stamped_rows(channel.topic, channel, starts)
    if not len(stamped.rows):
        raise InputError(f"{channel.topic} has no readable message.")
    image = first_image_format(channel, stamped.rows)
    others = other_formats(starts, channel)
    if others:
        words = f"{others} of {len(starts)} images have another size or encoding than most, or are damaged."
        finding = Finding("warning", channel.topic, words)
        stamped = stamped._replace(findings=(*stamped.findings, finding))
    return ImageTopic(channel, stamped, image)


def _one_topic_per_camera(images: Mapping[str, ImageTopic], findings: list[Finding]) -> list[ImageTopic]:
    """Of several topics of one camera (raw, compressed, rectified) the fullest, then the least treated.

    Topics are of one camera if they share a namespace and name the same optical frame.
    """
    groups: dict[tuple[str, str], list[ImageTopic]] = {}
    for image in images.values():
        if image.format.is_depth:
            message = (
                f"{image.topic} holds distances ({image.format.encoding or 'compressed depth'}), not pictures: left "
                f"out. If it is a camera: --topic camera.NAME={image.topic}."
            )
            findings.append(Finding("note", image.topic, message))
        else:
            groups.setdefault((camera_base(image.topic), image.frame_id), []).append(image)
    best = []
    for group in groups.values():
        fullest = max(len(image.channel) for image in group)
        kept = min(group, key=lambda image: _preference(image, fullest))
        best.append(kept)
        findings += [
            Finding("note", image.topic, f"{image.topic} shows the same camera as {kept.topic}: not used.")
            for image in group
            if image is not kept
        ]
    return sorted(best, key=lambda image: image.topic)


def _preference(image: ImageTopic, fullest: int) -> tuple[bool, bool, bool, int, str]:
    """Sorts first what is to be used."""
    is_fuller = len(image.channel) >= _ABOUT_AS_FULL * fullest
    words = image_base(image.topic).rpartition("/")[2].lower().split("_")
    is_grey_copy = "mono" in words or "grey" in words or "gray" in words
    is_compressed = image.channel.message_type == COMPRESSED
    return (
        not is_fuller,
        is_rectified(image.topic) or is_grey_copy,
        is_compressed,
        -len(image.channel),
        image.topic,
    )


def _info_of_each(named: Mapping[str, ImageTopic], infos: Mapping[str, Channel]) -> dict[str, Channel]:
    """The camera_info of each camera: by the names of topics, else the one of its optical frame that is left."""
    found: dict[str, Channel] = {}
    for name, image in named.items():
        topic = next((t for t in info_topics(image.topic) if t in infos), None)
        if topic is not None:
            found[name] = infos[topic]
    for topic in {channel.topic for channel in found.values()}:
        _keep_own_frame(topic, found, named, infos)
    taken = {channel.topic for channel in found.values()}
    frames = {topic: _frame_of(c) for topic, c in infos.items() if topic not in taken}
    for name, image in named.items():
        if name not in found and image.frame_id:
            matching = [topic for topic, frame in frames.items() if frame == image.frame_id]
            rivals = [other for other in named.values() if other.frame_id == image.frame_id]
            if len(matching) == 1 and len(rivals) == 1:
                found[name] = infos[matching[0]]
    return found


def _keep_own_frame(
    topic: str, found: dict[str, Channel], named: Mapping[str, ImageTopic], infos: Mapping[str, Channel]
) -> None:
    """Of several cameras beside one camera_info only those of its optical frame have it, if it names one of them."""
    sharing = [name for name, channel in found.items() if channel.topic == topic]
    frame = _frame_of(infos[topic])
    if len(sharing) > 1 and any(named[name].frame_id == frame for name in sharing):
        for name in sharing:
            if named[name].frame_id != frame:
                del found[name]


def _frame_of(channel: Channel) -> str:
    headers: Iterable[bytes] = channel.payloads.read(range(min(len(channel), 20)), HEADER_BYTES)
    return next((h.frame_id for h in (read_header(p, channel.encoding) for p in headers) if h), "")


def _camera(name: str, image: ImageTopic, info: Channel | None, findings: list[Finding]) -> CameraStream:
    channel, stamped = image.channel, image.stamped
    order, repaired = time_order(name, stamped.timestamps_ns)
    rows, stamps = stamped.rows[order], stamped.timestamps_ns[order]
    size = image.format.size
    if image.format.is_depth and (channel.message_type == COMPRESSED or size.width_px == 0):
        raise InputError(f"{channel.topic} holds compressed distances.")
    bits = used_sample_bits(channel, rows, image.format.encoding)
    if bits is not None and bits < 16:
        words = f"samples use {bits} bits: the 8 highest of these are kept."
        repaired.append(Finding("note", name, words))
    model, remark = _lens(name, image.topic, info, size)
    findings += [*(Finding(f.severity, name, f.message) for f in stamped.findings), *repaired, *remark]
    source = RosFrames(channel, rows, stamps, size, bits)
    return CameraStream(
        name, stamps, source, size.width_px, size.height_px, model, channel.topic, stamped.frame_id
    )


def _lens(
    name: str, topic: str, info: Channel | None, size: ImageSize
) -> tuple[CameraModel | None, list[Finding]]:
    if info is None:
        places = f"looked for {info_topics(topic)[0]} and in other usual places"
        message = f"no camera_info ({places}): intrinsics must be given."
        return None, [Finding("warning", name, message)]
    rectified = is_rectified(topic)
    model, findings = lens_from_infos(name, info, size, rectified=rectified)
    if rectified and model is not None:
        words = f"{topic} is rectified: the lens is the ideal pinhole camera P of {info.topic}."
        findings = [*findings, Finding("note", name, words)]
    return model, findings
