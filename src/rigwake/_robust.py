"""Robust spread: what a few wrong values do not move."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

MAD_TO_STD = 1.4826  # the median absolute value of Gaussian noise times this is its standard deviation


def robust_std(values: ArrayLike) -> float:
    """Standard deviation of Gaussian noise about zero by the median absolute value of all entries."""
    return MAD_TO_STD * float(np.median(np.abs(values)))
