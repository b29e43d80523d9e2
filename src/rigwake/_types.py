"""The array types of all signatures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["Array", "Floats", "Image", "Indices", "Mask", "Stamps"]

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Image = NDArray[np.uint8]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
Stamps = NDArray[np.int64]
