"""Samples of everything but the cameras: inertial unit, satellite positioning, compass."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.recording import AttitudeStream, GnssStream, ImuStream
from rigwake.simulation.scenario import Attitude, Gnss, Imu
from rigwake.simulation.vessel import VesselMotion, rotation_from_euler

_GNSS_STD_M = {"rtk": (0.02, 0.0), "standalone": (0.25, 1.2), "perfect": (0.0, 0.0)}  # white, correlated
_UNSTATED_STD = 1e-4  # a covariance of zero means "unknown" in most formats
_VERTICAL = 1.6


def mounted(position_m: Array, yaw_deg: float, pitch_deg: float, roll_deg: float) -> SE3:
    """`rig_from_body` of something mounted at a position and turned by yaw (to port), pitch (down), roll."""
    return SE3(rotation_from_euler(np.deg2rad([roll_deg, pitch_deg, yaw_deg])), np.asarray(position_m, float))


def regular_stamps(rate_hz: float, duration_s: float, start_ns: int, phase: float = 0.0) -> NDArray[np.int64]:
    """Stamps every `1/rate_hz`, the first `phase` of a period after the start, the last before the end."""
    count = int(np.ceil(duration_s * rate_hz - phase - 1e-9))
    return start_ns + np.round((np.arange(count) + phase) * 1e9 / rate_hz).astype(np.int64)


def seconds_since(stamps_ns: NDArray[np.int64], start_ns: int) -> Array:
    """(N,) seconds from `start_ns`, subtracted before the conversion to float."""
    return np.asarray((stamps_ns - start_ns) * 1e-9, dtype=np.float64)


def gauss_markov(rng: np.random.Generator, count: int, dt_s: float, std: float, tau_s: float) -> Array:
    """First-order Gauss-Markov noise (count, 3) of stationary standard deviation `std`, started stationary."""
    decay = np.exp(-dt_s / tau_s)
    drive = rng.standard_normal((count, 3)) * std * np.sqrt(1 - decay**2)
    drive[0] = rng.standard_normal(3) * std
    for i in range(1, count):
        drive[i] += decay * drive[i - 1]
    return drive


def simulate_imu(
    motion: VesselMotion, imu: Imu, start_ns: int, rng: np.random.Generator, topic: str
) -> ImuStream:
    """Ideal samples plus bias random walk plus white noise `density * sqrt(rate)` per sample."""
    stamps = regular_stamps(imu.rate_hz, motion.duration_s, start_ns)
    rig_from_imu = imu_mounting(imu)
    gyro, accel = motion.inertial(seconds_since(stamps, start_ns), rig_from_imu)

    def error(density: float, walk: float, bias_std: float) -> Array:
        shape = gyro.shape
        bias = rng.standard_normal(3) * bias_std
        steps = rng.standard_normal(shape) * walk / np.sqrt(imu.rate_hz)
        return np.asarray(
            bias + np.cumsum(steps, 0) + rng.standard_normal(shape) * density * np.sqrt(imu.rate_hz)
        )

    gyro = gyro + error(imu.gyro_noise_density, imu.gyro_bias_walk, imu.gyro_bias_std)
    accel = accel + error(imu.accel_noise_density, imu.accel_bias_walk, imu.accel_bias_std)
    return ImuStream(
        "imu",
        stamps,
        gyro,
        accel,
        topic=topic,
        frame_id="imu_link",
        gyro_noise_density=imu.gyro_noise_density,
        accel_noise_density=imu.accel_noise_density,
        gyro_bias_walk=imu.gyro_bias_walk,
        accel_bias_walk=imu.accel_bias_walk,
    )


def imu_mounting(imu: Imu) -> SE3:
    """`rig_from_imu`."""
    return mounted(np.array(imu.position_m), imu.yaw_deg, imu.pitch_deg, imu.roll_deg)


def simulate_gnss(
    motion: VesselMotion, gnss: Gnss, start_ns: int, rng: np.random.Generator, topic: str
) -> GnssStream:
    """Antenna positions `p + R lever` plus white and slowly wandering error; no fixes in outages."""
    stamps = regular_stamps(gnss.rate_hz, motion.duration_s, start_ns, phase=0.1)
    times = seconds_since(stamps, start_ns)
    lever = np.array(gnss.position_m)
    position = motion.world_from_rig(times) * lever
    default_white, default_correlated = _GNSS_STD_M[gnss.quality]
    white = default_white if gnss.white_std_m is None else gnss.white_std_m
    correlated = default_correlated if gnss.correlated_std_m is None else gnss.correlated_std_m
    axes = np.array([1.0, 1.0, _VERTICAL])
    noise = rng.standard_normal(position.shape) * white
    noise += gauss_markov(rng, len(times), 1 / gnss.rate_hz, correlated, gnss.correlated_tau_s)
    variance = max(white**2 + correlated**2, _UNSTATED_STD**2) * axes**2
    velocity = None
    if gnss.with_velocity:
        jitter = rng.standard_normal(position.shape) * (0.03 if white else 0.0)
        velocity = motion.velocity_world(times, lever) + jitter
    seen = np.ones(len(times), dtype=bool)
    for first, last in gnss.outages_s:
        seen &= (times < first) | (times > last)
    return GnssStream(
        "gnss",
        stamps[seen],
        (position + noise * axes)[seen],
        np.broadcast_to(np.diag(variance), (int(seen.sum()), 3, 3)).copy(),
        gnss.origin_lla,
        velocity_enu=None if velocity is None else velocity[seen],
        topic=topic,
        frame_id="gnss_link",
    )


def simulate_attitude(
    motion: VesselMotion, attitude: Attitude, start_ns: int, rng: np.random.Generator, topic: str
) -> AttitudeStream:
    """Rotation of the rig frame with a slowly wandering error, half of its variance white; a compass reports
    heading alone, with roll and pitch zero and their variance huge."""
    stamps = regular_stamps(attitude.rate_hz, motion.duration_s, start_ns, phase=0.5)
    times = seconds_since(stamps, start_ns)
    std = np.deg2rad(attitude.std_deg)
    error = gauss_markov(
        rng, len(times), 1 / attitude.rate_hz, std / np.sqrt(2), attitude.correlated_tau_s
    ) + rng.standard_normal((len(times), 3)) * std / np.sqrt(2)
    variance = np.full(3, max(std, _UNSTATED_STD) ** 2)
    if attitude.kind == "heading":
        yaw = motion.spline(times)[:, 5] + error[:, 2]
        rotation = rotation_from_euler(np.stack([0 * yaw, 0 * yaw, yaw], 1))
        variance[:2] = np.pi**2
    else:
        rotation = motion.world_from_rig(times).rotation @ so3.exp(error)
    covariances = np.broadcast_to(np.diag(variance), (len(times), 3, 3)).copy()
    return AttitudeStream("attitude", stamps, rotation, covariances, topic=topic, frame_id="base_link")
