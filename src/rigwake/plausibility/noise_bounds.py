"""Noise learnt from the bundle adjustment's residuals, held against what such sensors can have."""

from __future__ import annotations

from collections.abc import Mapping

from rigwake.plausibility.values import SensorCheck

# continuous densities that even a poor, vibrating MEMS sensor keeps below: rad/s/sqrt(Hz), m/s^2/sqrt(Hz)
MOST_NOISE = {"gyro": 4e-3, "accel": 0.1}
_MOST_FACTOR = 25.0
_NAMES = {"gyro": "gyroscope", "accel": "accelerometer"}


def check_imu_noise(
    factors: Mapping[str, float], stated_densities: Mapping[str, float]
) -> tuple[SensorCheck, ...]:
    """Whether the noise that the bundle adjustment asks for is noise.

    factors: how many times more than stated it is, by `gyro` and `accel`. What is beyond the bounds of the sensor's
    physics, and far beyond what was stated, is a fault that the other checks did not name.
    """
    checks = []
    for key, factor in factors.items():
        density = factor * stated_densities[key]
        limit = max(MOST_NOISE[key] / stated_densities[key], _MOST_FACTOR)
        quantity = "noise of the residuals over that stated"
        if factor <= limit:
            checks.append(SensorCheck(_NAMES[key], True, factor, limit, quantity=quantity))
            continue
        words = (
            f"the adjustment asks for {factor:.0f} times the noise stated ({density:.2g} per root hertz): that is no "
            "noise. It and the cameras contradict each other."
        )
        remedy = "Check its axes, scale and stamps, and the cameras' lenses; `rigwake inspect` compares them."
        checks.append(SensorCheck(_NAMES[key], False, factor, limit, words, remedy, quantity))
    return tuple(checks)
