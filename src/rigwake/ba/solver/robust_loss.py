"""Robust losses: how much an outlier may say."""

from __future__ import annotations

from typing import Literal

import numpy as np

from rigwake._types import Array

Loss = Literal["none", "huber", "cauchy", "tukey"]


def robust(squared: Array, loss: Loss, scale: float) -> tuple[Array, Array]:
    """Loss `rho(s)` and weight `rho'(s)` of squared whitened norms s (n,), in a cost of `1/2 rho`.

    Weighting residuals by `sqrt(rho')` (iteratively reweighted least squares) minimises a bound of the cost
    that touches it at the current values: no step of it needs the loss's second derivative.
    """
    s, c2 = squared / scale**2, scale**2
    if loss == "huber":
        root = np.sqrt(np.maximum(s, 1.0))
        return np.where(s <= 1, s, 2 * root - 1) * c2, 1 / root
    if loss == "cauchy":
        return c2 * np.log1p(s), 1 / (1 + s)
    if loss == "tukey":
        inside = np.clip(1 - s, 0, None)
        return c2 / 3 * (1 - inside**3), inside**2
    return squared, np.ones_like(squared)
