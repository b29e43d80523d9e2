"""Which topic is which sensor: the names of ROS, recognised or given by the user."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

from rigwake.errors import InputError, UsageError
from rigwake.readers.lens_choice import ChosenLens, lenses_from_options
from rigwake.readers.printable import is_plain_name, plain_name, printable
from rigwake.yaml_input import read_yaml

ROLES = ("camera", "imu", "gnss", "pose")

# words of the last part of an image topic that do not say which camera it is: `image_rect_color`, `mono`
_IMAGE_WORDS = frozenset({"image", "img", "raw", "color", "colour", "rgb", "bgr", "mono", "grey", "gray"})
_IMAGE_WORDS |= {"rect", "rectified", "undistorted", "jpeg", "mjpeg", "bayer", "data"}
_RECTIFIED_WORDS = frozenset({"rect", "rectified", "undistorted"})
_TRANSPORTS = frozenset({"compressed", "compressedDepth", "theora", "ffmpeg", "jpeg", "png"})
_PLAIN_WORDS = {"data", "data_raw", "fix", "raw", "sensor", "sensors"}
_COLOUR_WORDS = {
    "color",
    "colour",
    "rgb",
    "raw",
}  # of `/front/rgb/image_raw` when `front` has no other camera


@dataclass(frozen=True)
class TopicMap:
    """Topics chosen by the user: per role (`camera`, `imu`, `gnss`, `pose`) name -> topic.

    A role that is given replaces recognition for that role; a role that is not given is recognised.
    lenses: intrinsics that the user gives, by camera; they replace those of the recording.
    """

    roles: Mapping[str, Mapping[str, str]] = field(default_factory=lambda: MappingProxyType({}))
    lenses: Mapping[str, ChosenLens] = field(default_factory=lambda: MappingProxyType({}))

    def __post_init__(self) -> None:
        for names in self.roles.values():
            for name in names:
                if not is_plain_name(name):
                    raise UsageError(
                        f"{printable(name)!r} cannot name a sensor.",
                        consequence="Results are written into files of this name.",
                        remedy="Use up to 100 letters, digits, underscores and hyphens: camera.front=/a/b.",
                    )

    def chosen(self, role: str) -> Mapping[str, str] | None:
        """Name -> topic for this role, or None where the user left it to recognition."""
        return self.roles.get(role)

    @classmethod
    def from_options(
        cls, assignments: Sequence[str] = (), file: Path | None = None, intrinsics: Sequence[str] = ()
    ) -> TopicMap:
        """From `camera.front=/a/b`, `imu=/x` on the command line and a YAML mapping file of the same keys.

        The command line wins. In the file roles may nest: `camera: {front: /a/b}`. UsageError on anything else.
        intrinsics: files of lenses, see `lenses_from_options`.
        """
        flat = dict(_flat_mapping(file)) if file is not None else {}
        for assignment in assignments:
            key, separator, topic = assignment.partition("=")
            if not separator:
                raise UsageError(f"--topic {assignment!r} is not NAME=TOPIC.", remedy=_EXAMPLE)
            flat[key.strip()] = topic.strip()
        roles: dict[str, dict[str, str]] = {}
        for key, topic in flat.items():
            role, _, name = key.partition(".")
            if role not in ROLES or not topic or (role == "camera" and not name):
                raise UsageError(
                    f"{key!r} = {topic!r} does not say which sensor has which topic.", remedy=_EXAMPLE
                )
            roles.setdefault(role, {})[name or role] = topic
        return cls(MappingProxyType(roles), MappingProxyType(lenses_from_options(intrinsics)))


_EXAMPLE = "Write camera.front=/a/b, imu=/x, gnss=/y, or pose.base=/z."


def _flat_mapping(file: Path) -> Iterable[tuple[str, str]]:
    try:
        content = read_yaml(file)
    except InputError as error:
        raise InputError(
            f"The topic mapping {file} cannot be read: {error.cause}", remedy=_EXAMPLE
        ) from error
    if not isinstance(content, dict):
        raise InputError(f"The topic mapping {file} is not a YAML mapping.", remedy=_EXAMPLE)
    for key, value in content.items():
        if isinstance(value, dict):
            yield from ((f"{key}.{name}", str(topic)) for name, topic in value.items())
        else:
            yield str(key), str(value)


def image_base(topic: str) -> str:
    """The topic without the name of its transport: `/front/image_raw` of `/front/image_raw/compressed`."""
    parts = topic.split("/")
    return "/".join(parts[:-1]) if len(parts) > 2 and parts[-1] in _TRANSPORTS else topic


def camera_base(topic: str) -> str:
    """What topics of one camera share: `/front_camera` of `/front_camera/image_raw/compressed`."""
    base, _, last = image_base(topic).rpartition("/")
    return base if base and set(last.lower().split("_")) <= _IMAGE_WORDS else image_base(topic)


def is_rectified(topic: str) -> bool:
    """Whether a topic says that its images are rectified, hence those of the ideal camera `P`."""
    return any(_RECTIFIED_WORDS.intersection(part.lower().split("_")) for part in topic.split("/"))


def info_topics(topic: str) -> list[str]:
    """Where the camera_info of an image topic may stand, the most likely first.

    The rule of image_transport (`camera_info` beside the image) first, then the conventions of drivers that
    have others: below the camera's namespace, below the image, beside it under its own name.
    """
    base = image_base(topic)
    beside, _, last = base.rpartition("/")
    infos = [f"{beside}/camera_info"]
    if is_rectified(topic):
        infos.insert(0, f"{beside}/camera_info_rect")
    infos += [
        f"{camera_base(topic)}/camera_info",
        f"{base}/camera_info",
        f"{base}_info",
        f"{beside}/{last}_camera_info",
    ]
    parent = camera_base(topic).rpartition("/")[0]
    if camera_base(topic).rpartition("/")[2] in _COLOUR_WORDS and parent:
        infos.append(f"{parent}/camera_info")
    return list(dict.fromkeys(infos))


def sensor_names(topics: Sequence[str], role: str) -> dict[str, str]:
    """Short unique names by topic: `front` for `/wamv/sensors/cameras/front_camera/image_raw`.

    Where two topics would share a name, as many parents as it takes are put before it (`davis_left`); where
    that does not tell them apart, the words left out at first (`imu_data`, `imu_data_raw`), then a number.
    """
    short = {topic: _components(topic, role, topics) for topic in topics}
    spread = Counter(tuple(parts) for parts in short.values())
    components = {t: p if spread[tuple(p)] == 1 else _all_components(t, role) for t, p in short.items()}
    names = dict.fromkeys(topics, "")
    for depth in range(1, 1 + max((len(c) for c in components.values()), default=0)):
        taken = Counter(names.values())
        for topic in topics:
            if not names[topic] or taken[names[topic]] > 1:
                names[topic] = "_".join(components[topic][-depth:])
    return distinct_names({topic: plain_name(name) for topic, name in names.items()})


def distinct_names(names: Mapping[str, str]) -> dict[str, str]:
    """The names, a number behind those that are still equal."""
    unique: dict[str, str] = {}
    for topic, name in names.items():
        candidate, number = name, 2
        while candidate in unique.values():
            candidate, number = f"{name[:90]}_{number}", number + 1
        unique[topic] = candidate
    return unique


def _all_components(topic: str, role: str) -> list[str]:
    base = camera_base(topic) if role == "camera" else topic
    return [part for part in base.split("/") if part] or [role]


def _components(topic: str, role: str, others: Sequence[str]) -> list[str]:
    base = camera_base(topic)
    above, _, last = base.rpartition("/")
    if role == "camera" and above and last in _COLOUR_WORDS:
        siblings = [o for o in others if camera_base(o) != base and o.startswith(f"{above}/")]
        base = base if siblings else above
    parts = [part for part in base.split("/") if part and (role == "camera" or part not in _PLAIN_WORDS)]
    if role == "camera":
        parts = [part for part in parts[:-1] if part not in _PLAIN_WORDS] + parts[-1:]
    parts = parts or [role]
    last = parts[-1]
    for affix in ("_camera", "camera_", "_cam", "cam_", "_imu"):
        shorter = last.removesuffix(affix).removeprefix(affix)
        if shorter and not shorter.isdigit():
            last = shorter
    parts[-1] = last
    return [part for at, part in enumerate(parts) if at == 0 or part != parts[at - 1]]
