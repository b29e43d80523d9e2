"""Which registrations are believed: gates that follow the noise of the stream.

A fixed bound on the correlation asks for a contrast of so many times the noise, and so for a good camera. What tells a
patch that is seen again from one that is not are residuals beyond those that the same camera leaves where nothing can
have changed: in patches that are one frame old.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigwake._types import Array, Mask
from rigwake.tracking.registration import Registration
from rigwake.tracking.tracking_options import TrackingOptions

_LEAST_PATCHES = 15  # that tell a median
_BLEND = 0.3  # of what one frame tells with what those before told
_NOISE_ALLOWED = 1.0  # times the median variance
_WORSE = 2.5  # times the median deviation
_LEAST_CORRELATION = 0.6  # with the noise in it: below, another patch fits as well
_LARGEST_STD_PX = 0.6
_SLOW_LOSS, _FAST_LOSS = 1 / 30, 1 / 10


@dataclass(frozen=True)
class StreamQuality:
    """What one stream has shown of itself while it was tracked.

    variance: median variance of the residuals of patches that were made one frame before, grey levels^2. std_px: median
    predicted deviation of a coordinate from those. lost: fraction of older points whose patch fails from one frame
    to the next.
    """

    variance: float = 2.25
    std_px: float = 0.0
    lost: float = 0.0
    known: bool = False

    @property
    def haste(self) -> float:
        """How quickly patches stop being seen again: 0 if they serve for 30 frames and more, 1 if for 10 or fewer."""
        return min(max((self.lost - _SLOW_LOSS) / (_FAST_LOSS - _SLOW_LOSS), 0.0), 1.0)

    def with_residuals(self, variance: Array, std_px: Array) -> StreamQuality:
        """With what one more frame shows: (N,) both, of its patches that are one frame old."""
        if len(variance) < _LEAST_PATCHES:
            return self
        weight = _BLEND if self.known else 1.0
        return replace(
            self,
            variance=self.variance + weight * (float(np.median(variance)) - self.variance),
            std_px=self.std_px + weight * (float(np.median(std_px)) - self.std_px),
            known=True,
        )

    def with_losses(self, failed: Mask) -> StreamQuality:
        """With one more frame, in which `failed` (N,) of the older points were not seen again."""
        if len(failed) < _LEAST_PATCHES:
            return self
        return replace(self, lost=self.lost + _BLEND * (float(failed.mean()) - self.lost))


def largest_std_px(shown: StreamQuality, options: TrackingOptions) -> float:
    """Predicted deviation above which a point is lost: of the options, and more in a stream that shows no better."""
    return max(options.max_std_px, min(_WORSE * shown.std_px, _LARGEST_STD_PX))


def believed(seen: Registration, shown: StreamQuality, options: TrackingOptions) -> Mask:
    """Which registrations (N,) agree with their reference but for noise, are certain and hardly stretched.

    The bound of the options is on the correlation that there would be without the noise of the stream.
    """
    good = seen.found & (gate_ratios(seen, shown, options) <= 1)
    stretch = np.linalg.svd(seen.warps, compute_uv=False)
    good &= seen.correlation >= min(_LEAST_CORRELATION, options.min_correlation)
    good &= seen.std_px <= largest_std_px(shown, options)
    good &= (stretch[:, 0] <= options.max_stretch) & (stretch[:, 1] >= 1 / options.max_stretch)
    return np.asarray(good)


def gate_ratios(seen: Registration, shown: StreamQuality, options: TrackingOptions) -> Array:
    """(N,) residuals beyond the noise of the stream, by those that the options allow; above 1 is not believed."""
    with np.errstate(divide="ignore", invalid="ignore"):
        against_signal = 1 / np.square(seen.correlation) - 1
        beyond_noise = np.maximum(1 - _NOISE_ALLOWED * shown.variance / np.square(seen.noise), 0.0)
        return np.nan_to_num(against_signal * beyond_noise / (1 / options.min_correlation**2 - 1), nan=np.inf)
