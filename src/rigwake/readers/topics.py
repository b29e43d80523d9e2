"""Which topic is which sensor: the names of ROS, recognised or given by the user."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

from rigwake.errors import InputError, UsageError
from rigwake.yaml_input import read_yaml

ROLES = ("camera", "imu", "gnss", "pose")

# components of image and sensor topics that do not say which sensor it is
_RECTIFIED_WORDS = {"image_rect", "image_rect_color"}
_IMAGE_WORDS = {"compressed", "image", "image_raw", "image_color", "image_mono", "rgb", "color", "raw"}
_IMAGE_WORDS |= _RECTIFIED_WORDS
_PLAIN_WORDS = {"data", "data_raw", "fix", "raw", "sensor", "sensors"}


@dataclass(frozen=True)
class TopicMap:
    """Topics chosen by the user: per role (`camera`, `imu`, `gnss`, `pose`) name -> topic.

    A role that is given replaces recognition for that role; a role that is not given is recognised.
    """

    roles: Mapping[str, Mapping[str, str]] = field(default_factory=lambda: MappingProxyType({}))

    def chosen(self, role: str) -> Mapping[str, str] | None:
        """Name -> topic for this role, or None where the user left it to recognition."""
        return self.roles.get(role)

    @classmethod
    def from_options(cls, assignments: Sequence[str] = (), file: Path | None = None) -> TopicMap:
        """From `camera.front=/a/b`, `imu=/x` on the command line and a YAML mapping file of the same keys.

        The command line wins. In the file roles may nest: `camera: {front: /a/b}`. UsageError on anything else.
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
        return cls(MappingProxyType(roles))


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


def camera_base(topic: str) -> str:
    """What topics of one camera share: `/front_camera` of `/front_camera/image_raw/compressed`."""
    parts = topic.split("/")
    while len(parts) > 2 and parts[-1] in _IMAGE_WORDS:
        parts.pop()
    return "/".join(parts)


def sensor_names(topics: Sequence[str], role: str) -> dict[str, str]:
    """Short unique names by topic: `front` for `/wamv/sensors/cameras/front_camera/image_raw`.

    Where two topics would share a name, as many parents as it takes are put before it (`davis_left`).
    """
    components = {topic: _components(topic, role) for topic in topics}
    names = dict.fromkeys(topics, "")
    for depth in range(1, 1 + max((len(c) for c in components.values()), default=0)):
        taken = list(names.values())
        for topic in topics:
            if not names[topic] or taken.count(names[topic]) > 1:
                names[topic] = "_".join(components[topic][-depth:])
    return names


def _components(topic: str, role: str) -> list[str]:
    parts = [part for part in camera_base(topic).split("/") if part and part not in _PLAIN_WORDS] or [role]
    last = parts[-1]
    for affix in ("_camera", "camera_", "_cam", "cam_", "_imu"):
        shorter = last.removesuffix(affix).removeprefix(affix)
        if shorter and not shorter.isdigit():
            last = shorter
    parts[-1] = last
    return [part for at, part in enumerate(parts) if at == 0 or part != parts[at - 1]]
