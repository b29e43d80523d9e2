"""Tiny ONNX files, written byte by byte: a 1x1 convolution with a bias."""

import struct
from collections.abc import Sequence


def _key(field: int, kind: int) -> bytes:
    return _number(field << 3 | kind)


def _number(value: int) -> bytes:
    parts = b""
    while True:
        value, low = value >> 7, value & 127
        parts += bytes([low | (128 if value else 0)])
        if not value:
            return parts


def _bytes(field: int, content: bytes | str) -> bytes:
    raw = content.encode() if isinstance(content, str) else content
    return _key(field, 2) + _number(len(raw)) + raw


def _int(field: int, value: int) -> bytes:
    return _key(field, 0) + _number(value)


def _tensor(name: str, shape: Sequence[int], values: Sequence[float]) -> bytes:
    dims = b"".join(_int(1, d) for d in shape)
    return dims + _int(2, 1) + _bytes(8, name) + _bytes(9, struct.pack(f"<{len(values)}f", *values))


def _value(name: str, shape: Sequence[int | str]) -> bytes:
    dims = b"".join(_bytes(1, _bytes(2, d) if isinstance(d, str) else _int(1, d)) for d in shape)
    return _bytes(1, name) + _bytes(2, _bytes(1, _int(1, 1) + _bytes(2, dims)))


def _convolution(channels: int, weights: Sequence[float], bias: Sequence[float]) -> bytes:
    kernel = _bytes(1, "kernel_shape") + _int(8, 1) + _int(8, 1) + _int(20, 7)
    node = (
        _bytes(1, "x")
        + _bytes(1, "w")
        + _bytes(1, "b")
        + _bytes(2, "y")
        + _bytes(4, "Conv")
        + _bytes(5, kernel)
    )
    out = len(bias)
    graph = _bytes(1, node) + _bytes(2, "g")
    graph += _bytes(5, _tensor("w", (out, channels, 1, 1), weights)) + _bytes(5, _tensor("b", (out,), bias))
    graph += _bytes(11, _value("x", (1, channels, "rows", "columns")))
    graph += _bytes(12, _value("y", (1, out, "rows", "columns")))
    return _int(1, 7) + _bytes(7, graph) + _bytes(8, _int(2, 13))


def constant_network(logits: Sequence[float]) -> bytes:
    """RGB in, the same logits everywhere."""
    return _convolution(3, [0.0] * 3 * len(logits), logits)


def one_layer(channels: int, classes: int) -> bytes:
    """So many channels in, so many classes out."""
    return _convolution(channels, [0.1] * channels * classes, [0.0] * classes)
