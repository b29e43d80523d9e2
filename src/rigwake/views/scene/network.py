"""Networks that tell water, obstacle and sky apart, run by OpenCV on the processor.

The one that comes with rigwake (`views/models/water.onnx`, its card beside it) takes four channels: BGR, normalised
over what is seen, and the elevation. An external network (WaSR, eWaSR and the like) takes RGB as trained on ImageNet.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Floats, Image
from rigwake.errors import EstimationError, InputError, UsageError

CLASSES = ("water", "obstacle", "sky")
SHIPPED = "water.onnx"
_STRIDE = 32  # of the deepest layer: sizes are multiples of it
_WRAP_COLUMNS = 30  # each side sees so far around the circle
_MAX_BYTES = 2**30
_IMAGENET_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
_IMAGENET_STD = np.array([0.229, 0.224, 0.225], np.float32)
_ELEVATION_SCALE = 20.0  # degrees
_MOST_LOGIT = 1e30


def network_input(image: Image, is_seen: NDArray[np.bool_], elevation_deg: Array | None) -> Floats:
    """(4, H, W): BGR of (H, W, 3), zero mean and unit deviation over what is seen, zero elsewhere; and the elevation of
    each row in units of 20 degrees (zero if unknown)."""
    scaled = image.astype(np.float32) / 255
    known = scaled[is_seen]
    mean, std = (float(known.mean()), float(known.std())) if known.size else (0.0, 1.0)
    channels = np.zeros((4, *image.shape[:2]), np.float32)
    channels[:3] = np.moveaxis((scaled - mean) / (std + 0.05) * is_seen[..., None], -1, 0)
    if elevation_deg is not None:
        channels[3] = np.clip(elevation_deg / _ELEVATION_SCALE, -2, 2)[:, None]
    return channels


@dataclass(frozen=True, eq=False)
class SegmentationNetwork:
    """A network ready to run. classes: what each of its output channels is: one of `CLASSES`, or `other` (counts as
    obstacle). is_shipped: whether it takes our four channels, else RGB as trained on ImageNet."""

    name: str
    classes: tuple[str, ...]
    is_shipped: bool
    _net: Any = field(repr=False)

    def probabilities(
        self,
        image: Image,
        is_seen: NDArray[np.bool_] | None = None,
        elevation_deg: Array | None = None,
        wraps: bool = False,
    ) -> Floats:
        """(3, H, W) probabilities of water, obstacle and sky in an (H, W, 3) BGR picture.

        is_seen: (H, W), all by default. elevation_deg: (H,) of the rows, where known. wraps: the picture goes all
        around. Raises InputError if the network does not fit, EstimationError if it gives no numbers.
        """
        rows, columns = image.shape[:2]
        seen = np.ones((rows, columns), np.bool_) if is_seen is None else is_seen
        channels = network_input(image, seen, elevation_deg) if self.is_shipped else _imagenet_input(image)
        padded, left = _padded(channels, wraps)
        logits = self._run(padded)[:, :rows, left : left + columns]
        if not (np.abs(logits) < _MOST_LOGIT).all():  # OpenCV clips infinities to the largest float
            raise EstimationError(
                f"{self.name} gave values that are not numbers.",
                consequence="Nothing is known about this picture.",
                remedy="Use the network that comes with rigwake (leave --onnx out), or --method colour.",
            )
        return self._merged(logits)

    def _run(self, padded: Floats) -> Floats:
        """Logits at the resolution of the padded input."""
        try:
            self._net.setInput(padded[None])
            output = np.asarray(self._net.forward())
        except cv2.error as error:
            raise InputError(
                f"{self.name} does not take a picture of {padded.shape[2]} x {padded.shape[1]} pixels and "
                f"{padded.shape[0]} channels ({_short(error)}).",
                remedy="Export it for any size of picture, with one input of shape (1, 3, rows, columns).",
            ) from error
        if output.ndim != 4 or output.shape[:2] != (1, len(self.classes)):
            raise InputError(
                f"{self.name} gives an output of shape {'x'.join(map(str, output.shape))}; "
                f"1x{len(self.classes)}xROWSxCOLUMNS was expected for the classes {', '.join(self.classes)}.",
                remedy="Name the classes of its output channels in order: --classes obstacle,water,sky.",
            )
        rows, columns = padded.shape[1:]
        if output.shape[2:] != (rows, columns):
            output = np.stack([cv2.resize(plane, (columns, rows)) for plane in output[0]])[None]
        return np.asarray(output[0], np.float32)

    def _merged(self, logits: Floats) -> Floats:
        each = np.exp(logits - logits.max(axis=0))
        each /= each.sum(axis=0)
        merged = np.zeros((3, *logits.shape[1:]), np.float32)
        for plane, name in zip(each, self.classes, strict=True):
            merged[CLASSES.index(name) if name in CLASSES else 1] += plane
        return merged


def shipped_network() -> SegmentationNetwork:
    """The network that comes with rigwake."""
    content = (resources.files("rigwake.views.models") / SHIPPED).read_bytes()
    return SegmentationNetwork(SHIPPED, CLASSES, True, _read(content, SHIPPED))


def external_network(path: Path, classes: Sequence[str]) -> SegmentationNetwork:
    """Any semantic segmentation as an ONNX file: input (1, 3, H, W) RGB normalised as for ImageNet, output
    (1, len(classes), h, w). Raises InputError, or UsageError for wrong class names."""
    known = {*CLASSES, "other"}
    if not set(classes) <= known or not {"water", "obstacle"} <= set(classes):
        raise UsageError(
            f"--classes {','.join(classes)}: these must be names out of {', '.join(sorted(known))}, "
            "with water and obstacle among them.",
            remedy="Name the output channels in order, for example obstacle,water,sky.",
        )
    if not path.is_file():
        raise InputError(f"There is no {path}.", remedy="Give an ONNX file, or leave --onnx out.")
    if path.stat().st_size > _MAX_BYTES:
        raise InputError(f"{path} is larger than 1 GB.", remedy="Give a smaller network.")
    content = path.read_bytes()
    net = _read(content, path.name)
    taken = _input_channels(content)
    if taken not in (None, 3):
        raise InputError(
            f"{path.name} does not take a picture: its input has {taken} channels, not 3.",
            consequence="OpenCV would run it all the same, on garbage.",
            remedy="Export it with one input of shape (1, 3, rows, columns), RGB.",
        )
    return SegmentationNetwork(path.name, tuple(classes), False, net)


def _input_channels(content: bytes) -> int | None:
    """Channels that an ONNX file says its first input of four dimensions has; None if it does not say."""
    for graph in _fields(content, 7):
        for value in _fields(graph, 11):
            for shape in (s for t in _fields(value, 2) for k in _fields(t, 1) for s in _fields(k, 2)):
                sizes = [
                    next((n for n in _fields(d, 1) if isinstance(n, int)), None) for d in _fields(shape, 1)
                ]
                if len(sizes) == 4:
                    return sizes[1]
    return None


def _fields(message: Any, wanted: int) -> Iterator[Any]:
    """Values of one field of a protobuf message: bytes, or int. Nothing of what is not a message."""
    at = 0

    def number() -> int:
        nonlocal at
        value = shift = 0
        while at < len(message) and shift < 70:
            byte = message[at]
            value, shift, at = value | (byte & 127) << shift, shift + 7, at + 1
            if byte < 128:
                break
        return value

    while isinstance(message, bytes | memoryview) and at < len(message):
        field, kind = divmod(number(), 8)
        if kind == 0:
            found: Any = number()
        elif kind in (1, 5):
            found, at = None, at + (8 if kind == 1 else 4)
        elif kind == 2:
            size = number()
            found, at = memoryview(message)[at : at + size], at + size
        else:
            return
        if field == wanted and found is not None:
            yield found


def _read(content: bytes, name: str) -> Any:
    classic = getattr(
        cv2.dnn, "ENGINE_CLASSIC", None
    )  # OpenCV 5 has a second engine, slower for small networks
    buffer = np.frombuffer(content, np.uint8)
    try:
        return (
            cv2.dnn.readNetFromONNX(buffer) if classic is None else cv2.dnn.readNetFromONNX(buffer, classic)
        )
    except cv2.error as error:
        raise InputError(
            f"{name} cannot be read as an ONNX network ({_short(error)}).",
            remedy="Give an ONNX file with plain layers (opset 11 to 17).",
        ) from error


def _short(error: cv2.error) -> str:
    return " ".join(str(error.err or error).split())[:120]


def _imagenet_input(image: Image) -> Floats:
    rgb = image[..., ::-1].astype(np.float32) / 255
    return np.asarray(np.moveaxis((rgb - _IMAGENET_MEAN) / _IMAGENET_STD, -1, 0), np.float32)


def _padded(channels: Floats, wraps: bool) -> tuple[Floats, int]:
    """Channels with rows and columns a multiple of the stride, and where the first column went."""
    rows, columns = channels.shape[1:]
    left = _WRAP_COLUMNS if wraps else 0
    right = -(columns + 2 * left) % _STRIDE + left
    if wraps:
        channels = np.pad(channels, ((0, 0), (0, 0), (left, right)), "wrap")
    else:
        channels = np.pad(channels, ((0, 0), (0, 0), (0, right)), "edge")
    return np.ascontiguousarray(np.pad(channels, ((0, 0), (0, -rows % _STRIDE), (0, 0)), "edge")), left
