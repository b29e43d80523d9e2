"""How the rig moves over a second: turns from the gyroscope, the shape of the way from the accelerometer, the
distance from GNSS. The direction of the way is left to the cameras (`velocity.py`)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter1d

from rigwake._robust import robust_std
from rigwake._types import Array, Stamps
from rigwake.geometry import so3
from rigwake.odometry.gyro import integrate_gyro
from rigwake.odometry.imu_alignment import with_noise
from rigwake.recording import GnssStream, ImuStream

_GRAVITY_WINDOW_S = 60.0  # a vessel's velocity changes by a few m/s at most: 0.07 m/s^2 of the mean force
_BIAS_WINDOW_S, _BIAS_MEAN_S = 120.0, 10.0
_FORCE_STD, _BIAS_STD = 0.4, 3e-3  # m/s^2 of a mean over ten seconds; rad/s
_LEAST_DISTANCE_STD_M = 0.01
_UNKNOWN_DISTANCE_M, _UNKNOWN_DISTANCE_STD_M = 1.5, 1.5  # of one second without GNSS


@dataclass(frozen=True, eq=False)
class PairMotion:
    """The rig's motion over P pairs of times, in rig axes at the earlier time.

    rotation: (P, 3, 3) `rig1_from_rig2`. by_bias: (P, 3, 3), its left tangent by the gyro's bias. by_velocity:
    (P, 3, 3), of `translation = by_velocity @ v + known`, where v (3,) is the rig's velocity in level axes at the
    reference time of the pair's slot. known: (P, 3) metres. turning: (P, 3), how the rotation (left tangent) changes if
    both times come a second later. drift: (P, 3), the change of the translation likewise, without the part from
    `turning_first`. turning_first: (P, 3) rad/s.
    """

    rotation: Array
    by_bias: Array
    by_velocity: Array
    known: Array
    turning: Array
    drift: Array
    turning_first: Array


@dataclass(frozen=True, eq=False)
class VelocityGained:
    """Changes of the velocity between M stamps in level axes, which a gyro bias b turns: `dv/dt = a + (R b) x v`.

    change: (M - 1, 3) m/s. by_accel_bias: (M - 1, 3, 3), what an acceleration in rig axes adds. by_gyro_bias: likewise
    per rad/s, from gravity that tilts in turning axes; without `(R b) x v`.
    """

    change: Array
    by_accel_bias: Array
    by_gyro_bias: Array


@dataclass(frozen=True, eq=False)
class RigMotion:
    """The rig's motion as IMU and GNSS tell it. The rig's axes and origin are those of the IMU.

    timestamps_ns: (N,) of the IMU. level_from_rig: (N, 3, 3), the gyro integrated; level axes start as the rig's.
    rate: (N, 3) rad/s. velocity, position: (N, 3) integrals of the acceleration in level axes, from zero.
    up_level: (N, 3) unit vectors against gravity. force: (N, 3) integral of the specific force in level axes.
    turned, turned_twice: (N, 9) integrals of `level_from_rig`. gyro_noise: rad/sqrt(s). accel_noise: m/s/sqrt(s).
    distances: GNSS, or None.
    """

    timestamps_ns: Stamps
    level_from_rig: Array
    rate: Array
    velocity: Array
    position: Array
    up_level: Array
    force: Array
    turned: Array
    turned_twice: Array
    gyro_noise: float
    accel_noise: float
    distances: GnssDistances | None

    def _at(self, values: Array, at_ns: Stamps) -> Array:
        """Linear interpolation of (N, K) values."""
        origin = self.timestamps_ns[0]
        known, wanted = (self.timestamps_ns - origin) * 1e-9, (at_ns - origin) * 1e-9
        return np.stack([np.interp(wanted, known, column) for column in values.T], axis=-1)

    def _position_at(self, at_ns: Stamps) -> Array:
        """Integrated position, with the velocity's change within a sample."""
        before = np.clip(
            np.searchsorted(self.timestamps_ns, at_ns, side="right") - 1, 0, len(self.timestamps_ns) - 2
        )
        step = (self.timestamps_ns[before + 1] - self.timestamps_ns[before]) * 1e-9
        since = ((at_ns - self.timestamps_ns[before]) * 1e-9)[:, None]
        change = (self.velocity[before + 1] - self.velocity[before]) / step[:, None]
        return np.asarray(self.position[before] + self.velocity[before] * since + change * since**2 / 2)

    def rotation_at(self, at_ns: Stamps) -> Array:
        """(M, 3, 3) `level_from_rig`."""
        before = np.clip(
            np.searchsorted(self.timestamps_ns, at_ns, side="right") - 1, 0, len(self.timestamps_ns) - 2
        )
        span = (self.timestamps_ns[before + 1] - self.timestamps_ns[before]).astype(np.float64)
        fraction = (at_ns - self.timestamps_ns[before]) / span
        step = so3.log(np.swapaxes(self.level_from_rig[before], 1, 2) @ self.level_from_rig[before + 1])
        return np.asarray(self.level_from_rig[before] @ so3.exp(step * fraction[:, None]))

    def up_rig_at(self, at_ns: Stamps) -> Array:
        """(M, 3) unit vectors against gravity in rig axes."""
        up = np.einsum("nji,nj->ni", self.rotation_at(at_ns), self._at(self.up_level, at_ns))
        return np.asarray(up / np.linalg.norm(up, axis=1, keepdims=True))

    def velocity_gained(self, at_ns: Stamps) -> VelocityGained:
        """What the accelerometer says of the velocity between increasing stamps (M,) of some seconds."""
        seconds = (np.diff(at_ns) * 1e-9)[:, None]
        middle = int(at_ns[len(at_ns) // 2])
        reach = round(_GRAVITY_WINDOW_S / 2 * 1e9)
        ends = np.clip([middle - reach, middle + reach], self.timestamps_ns[0], self.timestamps_ns[-1])
        over = self._at(self.force, ends)
        gravity = (over[0] - over[1]) / max(float(ends[1] - ends[0]) * 1e-9, 1e-3)
        turned = self._at(self.turned, at_ns)
        tilted = np.diff(self._at(self.turned_twice, at_ns), axis=0) - turned[:1] * seconds
        return VelocityGained(
            np.diff(self._at(self.force, at_ns), axis=0) + gravity * seconds,
            np.diff(turned, axis=0).reshape(-1, 3, 3),
            so3.hat(gravity) @ tilted.reshape(-1, 3, 3),
        )

    def between(self, first_ns: Stamps, second_ns: Stamps, reference_ns: Stamps, bias: Array) -> PairMotion:
        """The motion from `first_ns` to `second_ns` (P,), with velocities given at `reference_ns` (P,).

        bias: (3,) rad/s, of the gyro beside what `rig_motion` was told; it counts within each pair only.
        """
        R1, R2 = self.rotation_at(first_ns), self.rotation_at(second_ns)
        seconds = ((second_ns - first_ns) * 1e-9)[:, None]
        R1_inverse = np.swapaxes(R1, 1, 2)
        turned = self._at(self.turned, second_ns) - self._at(self.turned, first_ns)
        by_bias = -R1_inverse @ turned.reshape(-1, 3, 3)
        rotation = so3.exp(by_bias @ bias) @ R1_inverse @ R2
        way = self._position_at(second_ns) - self._position_at(first_ns)
        way = way - self._at(self.velocity, reference_ns) * seconds
        rate1, rate2 = self._at(self.rate, first_ns) - bias, self._at(self.rate, second_ns) - bias
        gained = self._at(self.velocity, second_ns) - self._at(self.velocity, first_ns)
        return PairMotion(
            rotation,
            by_bias,
            R1_inverse * seconds[:, :, None],
            np.einsum("nij,nj->ni", R1_inverse, way),
            np.einsum("nij,nj->ni", rotation, rate2) - rate1,
            np.einsum("nij,nj->ni", R1_inverse, gained),
            rate1,
        )


@dataclass(frozen=True, eq=False)
class GnssDistances:
    """How far the antenna came. antenna_rig: (3,). std_m: of a difference of two positions."""

    timestamps_ns: Stamps
    position: Array
    antenna_rig: Array
    std_m: float

    def between(self, first_ns: Stamps, second_ns: Stamps) -> tuple[Array, Array]:
        """Distances (M,) in metres and whether there are fixes around both times (M,)."""
        origin = self.timestamps_ns[0]
        known = (self.timestamps_ns - origin) * 1e-9
        moved, there = [], np.ones(len(first_ns), dtype=bool)
        for at_ns in (first_ns, second_ns):
            wanted = (at_ns - origin) * 1e-9
            after = np.clip(np.searchsorted(known, wanted), 1, len(known) - 1)
            there &= (known[after] - known[after - 1] < 1.5) & (wanted >= known[0]) & (wanted <= known[-1])
            moved.append(np.stack([np.interp(wanted, known, column) for column in self.position.T], axis=1))
        return np.linalg.norm(moved[1] - moved[0], axis=1), there


def rig_motion(imu: ImuStream, gnss: GnssStream | None = None, antenna_rig: Array | None = None) -> RigMotion:
    """Integrate the IMU, whose axes are the rig's, and prepare the GNSS distances.

    antenna_rig: (3,) lever arm; the IMU's origin if unknown. The gyro's bias about level axes is taken off as far as
    gravity tells it.
    """
    imu = with_noise(imu)
    first = _integrated(imu, gnss, antenna_rig)
    return _integrated(replace(imu, gyro=imu.gyro - _bias_by_gravity(first)), gnss, antenna_rig)


def _integrated(imu: ImuStream, gnss: GnssStream | None, antenna_rig: Array | None) -> RigMotion:
    assert imu.gyro_noise_density is not None
    assert imu.accel_noise_density is not None
    level_from_rig = integrate_gyro(imu).rotation
    seconds = np.diff(imu.timestamps_ns) * 1e-9
    force = np.einsum("nij,nj->ni", level_from_rig, imu.accel)
    turned = _integral(level_from_rig.reshape(-1, 9), seconds)
    samples = max(int(_GRAVITY_WINDOW_S / max(float(np.median(seconds)), 1e-4)), 1)
    gravity = uniform_filter1d(force, min(samples, len(force)), axis=0, mode="nearest")
    velocity = _integral(force - gravity, seconds)
    steps = velocity[:-1] * seconds[:, None] + np.diff(velocity, axis=0) * seconds[:, None] / 2
    position = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return RigMotion(
        imu.timestamps_ns,
        level_from_rig,
        imu.gyro,
        velocity,
        position,
        gravity / np.linalg.norm(gravity, axis=1, keepdims=True),
        _integral(force, seconds),
        turned,
        _integral(turned, seconds),
        imu.gyro_noise_density,
        imu.accel_noise_density,
        _distances(gnss, antenna_rig),
    )


def _bias_by_gravity(motion: RigMotion) -> Array:
    """(3,) rad/s: gravity stays put in level axes unless they turn, and an accelerometer's mean over ten seconds shows
    it to a few hundredths of g. From the first minutes; heading stays unknown.

    `mean force = up - hat(up) (R b integrated)`, linear in `up` (three numbers) and b.
    """
    seconds = (motion.timestamps_ns - motion.timestamps_ns[0]) * 1e-9
    edges = np.arange(0.0, min(float(seconds[-1]), _BIAS_WINDOW_S) + 1e-9, _BIAS_MEAN_S)
    if len(edges) < 4:
        return np.zeros(3)
    stamps = motion.timestamps_ns[0] + np.round(edges * 1e9).astype(np.int64)
    force = np.diff(motion._at(motion.force, stamps), axis=0) / _BIAS_MEAN_S
    turned = (np.diff(motion._at(motion.turned_twice, stamps), axis=0) / _BIAS_MEAN_S).reshape(-1, 3, 3)
    up = force.mean(axis=0)
    b = np.zeros(3)
    for _ in range(3):
        A = np.concatenate([np.broadcast_to(np.eye(3), turned.shape), -so3.hat(up) @ turned], axis=2).reshape(
            -1, 6
        )
        ridge = np.diag([0.0, 0, 0, 1, 1, 1]) * (_FORCE_STD / _BIAS_STD) ** 2
        solution = np.linalg.solve(A.T @ A + ridge, A.T @ force.reshape(-1))
        up, b = solution[:3], solution[3:]
    return np.asarray(b)


def _integral(values: Array, seconds: Array) -> Array:
    """Trapezoids (N, K) from zero."""
    steps = (values[1:] + values[:-1]) / 2 * seconds[:, None]
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])


def _distances(gnss: GnssStream | None, antenna_rig: Array | None) -> GnssDistances | None:
    """None with hardly any fixes. The noise is read off second differences: errors that last cancel in them."""
    if gnss is None or len(gnss.timestamps_ns) < 10:
        return None
    jitter = np.diff(gnss.position_enu, n=2, axis=0) / np.sqrt(6)
    white = robust_std(jitter)
    std = max(np.sqrt(2) * white, _LEAST_DISTANCE_STD_M)
    lever = np.zeros(3) if antenna_rig is None else np.asarray(antenna_rig, dtype=np.float64)
    return GnssDistances(gnss.timestamps_ns, gnss.position_enu, lever, std)


def distance_prior(motion: RigMotion, first_ns: Stamps, second_ns: Stamps) -> tuple[Array, Array, Array]:
    """Distances (M,) of the antenna in metres, standard deviations (M,), and the antenna's lever arm (3,)."""
    unknown = np.full(len(first_ns), _UNKNOWN_DISTANCE_M), np.full(len(first_ns), _UNKNOWN_DISTANCE_STD_M)
    if motion.distances is None:
        return *unknown, np.zeros(3)
    distance, there = motion.distances.between(first_ns, second_ns)
    return (
        np.where(there, distance, unknown[0]),
        np.where(there, motion.distances.std_m, unknown[1]),
        motion.distances.antenna_rig,
    )
