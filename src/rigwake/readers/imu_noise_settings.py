"""An IMU's noise densities in `rig.yaml`.

    imu: {gyro_noise_density: 2.0e-4, accel_noise_density: 2.0e-3, gyro_bias_walk: 2.0e-5, accel_bias_walk: 3.0e-4}

for every IMU of the folder, or `imu: {imu_bow: {...}}` by name. Kalibr's and EuRoC's names are known too. Units are
those of `ImuStream`: rad/s/sqrt(Hz) and m/s^2/sqrt(Hz).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from rigwake.errors import InputError
from rigwake.recording import Finding, ImuStream

_FIELDS = {
    "gyro_noise_density": "gyro_noise_density",
    "accel_noise_density": "accel_noise_density",
    "gyro_bias_walk": "gyro_bias_walk",
    "accel_bias_walk": "accel_bias_walk",
    "gyroscope_noise_density": "gyro_noise_density",
    "accelerometer_noise_density": "accel_noise_density",
    "gyroscope_random_walk": "gyro_bias_walk",
    "accelerometer_random_walk": "accel_bias_walk",
}
_BESIDE_NOISE = {"rostopic", "topic", "update_rate", "rate_hz", "rate", "model", "sensor_type", "frame_id"}


def with_noise_settings(imu: ImuStream, settings: Any, where: str) -> tuple[ImuStream, list[Finding]]:
    """The IMU with the densities that `settings` (the value of the key `imu` in a file) gives for it, and findings
    about keys that are not known. Raises InputError for values that are not positive numbers.
    """
    if settings is None:
        return imu, []
    if not isinstance(settings, Mapping):
        raise InputError(f"{where}: imu must hold named noise densities, not {settings!r}.")
    by_name = {str(key): value for key, value in settings.items() if isinstance(value, Mapping)}
    own: Mapping[Any, Any] = by_name.get(imu.name, {}) if by_name else settings
    known: dict[str, Any] = {}
    strange: list[str] = []
    for key, value in own.items():
        field = _FIELDS.get(str(key))
        if field is not None:
            known[field] = _positive(value, f"{where}: imu.{key}")
        elif str(key) not in _BESIDE_NOISE:
            strange.append(str(key))
    findings = []
    if strange:
        words = f"{where}: unknown settings of the IMU, not used: {', '.join(strange)}. Known: {', '.join(_FIELDS)}."
        findings.append(Finding("warning", imu.name, words))
    return replace(imu, **known), findings


def _positive(value: Any, where: str) -> float:
    try:
        number = float(value) if not isinstance(value, bool) else -1.0  # YAML reads 2e-4 as text
    except (TypeError, ValueError):
        number = -1.0
    if not 0 <= number < float("inf"):  # 0 is what a simulated sensor without noise has
        raise InputError(f"{where} must be a positive number, it is {value!r}.")
    return number
