"""Hypothesis strategies for rotations and rigid transforms."""

import numpy as np
from hypothesis import strategies as st

from rigwake.geometry.se3 import SE3

_unit = st.floats(-1, 1, allow_nan=False, width=64)


@st.composite
def rotation_vectors(draw: st.DrawFn, max_angle: float = np.pi - 1e-3) -> np.ndarray:
    axis = np.array([draw(_unit) for _ in range(3)])
    norm = np.linalg.norm(axis)
    axis = axis / norm if norm > 1e-3 else np.array([0.0, 0.0, 1.0])
    exponent = draw(st.floats(-12, 0))
    return axis * max_angle * 10**exponent


@st.composite
def tangents(draw: st.DrawFn, max_angle: float = np.pi - 1e-3) -> np.ndarray:
    translation = [draw(st.floats(-20, 20, allow_nan=False)) for _ in range(3)]
    return np.concatenate([draw(rotation_vectors(max_angle)), translation])


def transforms() -> st.SearchStrategy[SE3]:
    return tangents().map(SE3.exp)
