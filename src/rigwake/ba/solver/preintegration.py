"""Inertial preintegration: how far the rig turned and moved between two times, before its start is known.

Samples are instantaneous and vary linearly between their stamps, so the angular rate of a step is the mean
of its ends, and rotated accelerations are integrated by the trapezoid rule: second order, unbiased, and exact
stamps of states and images fall anywhere between samples. Rectangles instead (one end's sample for the whole
step) bias the rotation by half a sample.

Source: Forster, Carlone, Dellaert, Scaramuzza, *On-Manifold Preintegration for Real-Time Visual-Inertial
Odometry* (T-RO 2017), eq. 33-37 and 59-63, with increments expressed in the frame of the start.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigwake._kernels import njit
from rigwake._types import Array, Indices
from rigwake.ba.solver.rig_problem import RigProblem
from rigwake.errors import UsageError
from rigwake.recording import ImuStream

LONGEST_BRIDGE_S = 5.0
"""Seconds between states over which inertial samples are not integrated any more."""
_GAP = 2.5  # a step longer than this many median steps is a gap


@dataclass(frozen=True, eq=False)
class Preintegrated:
    """Increments from n start to n end times, at the states' current biases.

    rotation: (n, 3, 3) start_from_end. velocity, position: (n, 3) in start axes, without gravity and start
    velocity. Derivatives (n, 3, 3) by the biases; that of the rotation is its right tangent.
    covariance: (n, 9, 9) of `[rotation, velocity, position]` from sensor noise. final_rate: (n, 3) bias-free
    angular rate at the end.
    """

    rotation: Array
    velocity: Array
    position: Array
    rotation_by_gyro_bias: Array
    velocity_by_gyro_bias: Array
    velocity_by_accel_bias: Array
    position_by_gyro_bias: Array
    position_by_accel_bias: Array
    covariance: Array
    final_rate: Array


@dataclass(frozen=True)
class ImuNoiseModel:
    """Continuous-time densities of the samples, and of the biases' random walks."""

    gyro: float
    accel: float
    gyro_walk: float
    accel_walk: float


def imu_noise(imu: ImuStream) -> ImuNoiseModel:
    """The stream's noise; UsageError names what is missing."""
    given = {
        "gyro_noise_density": imu.gyro_noise_density,
        "accel_noise_density": imu.accel_noise_density,
        "gyro_bias_walk": imu.gyro_bias_walk,
        "accel_bias_walk": imu.accel_bias_walk,
    }
    values = [value for value in given.values() if value is not None and value > 0]
    if len(values) < 4:
        missing = ", ".join(name for name, value in given.items() if not value or value <= 0)
        raise UsageError(
            f"IMU {imu.name}: {missing} not known.",
            consequence="Without it inertial and visual measurements cannot be weighed against each other.",
            remedy="Take the values from the data sheet or an Allan analysis.",
        )
    return ImuNoiseModel(*values)


def gap_walks(imu: ImuStream) -> tuple[Array, float]:
    """(2,) intensity of a Wiener process that leaves as much across the longest gap as gyro and accelerometer leave of
    themselves when they are bridged by a straight line elsewhere, and the step length (s) above which samples count as
    missing.

    A Brownian bridge over L integrates to a variance of `w L^3 / 12`: w follows from what straight lines over stretches
    of that length miss in the rest of the recording, and is at least what successive samples show.
    """
    steps = np.diff(imu.timestamps_ns) * 1e-9
    usual = float(np.median(steps))
    regular = steps <= _GAP * usual
    signals = (imu.gyro, imu.accel)
    walks = np.array([np.mean(np.diff(signal, axis=0)[regular] ** 2) / usual for signal in signals])
    if regular.all():
        return walks, _GAP * usual
    length = round(min(float(steps.max()), LONGEST_BRIDGE_S) / usual)
    seconds = length * usual
    broken = np.concatenate([[0], np.cumsum(~regular)])
    for k, signal in enumerate(signals):
        starts = np.arange(0, len(signal) - length, max(length // 4, 1))
        starts = starts[broken[starts + length] == broken[starts]]
        if len(starts) and length > 1:
            total = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (signal[1:] + signal[:-1]), axis=0)])
            whole = (total[starts + length] - total[starts]) * usual
            missed = whole - 0.5 * (signal[starts] + signal[starts + length]) * seconds
            walks[k] = max(walks[k], float(np.mean(missed**2)) * 12 / seconds**3)
    return walks, _GAP * usual


def preintegrate(problem: RigProblem, starts_s: Array, ends_s: Array, states: Indices) -> Preintegrated:
    """Increments from `starts_s` (n,) to `ends_s` (n,) (seconds since the first state; either may be later)
    with the biases of `states` (n,). The nearest sample stands in for times outside the samples' range.

    A gap adds the variance of a Brownian bridge across it (`gap_walks`): what the signal may have done unseen.
    """
    imu, biases = problem.imu, problem.states.inertial
    assert imu is not None
    assert biases is not None
    noise = imu_noise(imu)
    walks, gap_s = gap_walks(imu)
    times = (imu.timestamps_ns - problem.states.timestamps_ns[0]) * 1e-9
    n = len(starts_s)
    rotation, vectors = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3, 3))
    by_bias, covariance = np.zeros((n, 5, 3, 3)), np.zeros((n, 9, 9))
    _integrate_all(
        times,
        np.ascontiguousarray(imu.gyro, dtype=np.float64),
        np.ascontiguousarray(imu.accel, dtype=np.float64),
        np.ascontiguousarray(starts_s),
        np.searchsorted(times, starts_s, side="right"),
        np.ascontiguousarray(ends_s),
        biases.gyro_bias[states],
        biases.accel_bias[states],
        np.array([noise.gyro**2, noise.accel**2, walks[0], walks[1], gap_s]),
        rotation,
        vectors,
        by_bias,
        covariance,
    )
    return Preintegrated(
        rotation,
        vectors[:, 0],
        vectors[:, 1],
        by_bias[:, 0],
        by_bias[:, 1],
        by_bias[:, 2],
        by_bias[:, 3],
        by_bias[:, 4],
        covariance,
        vectors[:, 2],
    )


@njit(error_model="numpy")
def _matmul3(a, b, out):  # type: ignore[no-untyped-def]
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@njit(error_model="numpy")
def _exp3(v, out, jacobian):  # type: ignore[no-untyped-def]
    """Rotation and right Jacobian of a rotation vector."""
    angle2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    angle = np.sqrt(angle2)
    if angle < 1e-4:
        a, b, c = 1 - angle2 / 6, 0.5 - angle2 / 24, 1 / 6 - angle2 / 120
    else:
        a = np.sin(angle) / angle
        b = 2 * np.sin(angle / 2) ** 2 / angle2
        c = (angle - np.sin(angle)) / (angle2 * angle)
    for i in range(3):
        for j in range(3):
            square = v[i] * v[j] - (angle2 if i == j else 0.0)
            out[i, j] = (1.0 if i == j else 0.0) + b * square
            jacobian[i, j] = (1.0 if i == j else 0.0) + c * square
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        # hat(v)[i, j] = -v[k], hat(v)[j, i] = v[k]
        out[i, j] -= a * v[k]
        out[j, i] += a * v[k]
        jacobian[i, j] += b * v[k]
        jacobian[j, i] -= b * v[k]


@njit(error_model="numpy")
def _sample(times, signal, t, index, out):  # type: ignore[no-untyped-def]
    """The signal at time t, linear between samples `index` and `index + 1`, held outside them."""
    fraction = (t - times[index]) / (times[index + 1] - times[index])
    fraction = min(max(fraction, 0.0), 1.0)
    for i in range(3):
        out[i] = (1 - fraction) * signal[index, i] + fraction * signal[index + 1, i]


@njit(error_model="numpy")
def _minus_rotated_hat(R, a, out):  # type: ignore[no-untyped-def]
    """`-R hat(a)`: derivative of R a by the right tangent of R."""
    for i in range(3):
        out[i, 0] = R[i, 2] * a[1] - R[i, 1] * a[2]
        out[i, 1] = R[i, 0] * a[2] - R[i, 2] * a[0]
        out[i, 2] = R[i, 1] * a[0] - R[i, 0] * a[1]


@njit(error_model="numpy")
def _spread(covariance, A, B, work):  # type: ignore[no-untyped-def]
    """`A covariance A^T + B` in place; A (9, 9), B (9,) diagonal."""
    for i in range(9):
        for j in range(9):
            total = 0.0
            for k in range(9):
                total += A[i, k] * covariance[k, j]
            work[i, j] = total
    for i in range(9):
        for j in range(9):
            total = 0.0
            for k in range(9):
                total += work[i, k] * A[j, k]
            covariance[i, j] = total
        covariance[i, i] += B[i]


@njit(error_model="numpy")
def _integrate_all(  # type: ignore[no-untyped-def]
    times,
    gyro,
    accel,
    starts,
    after_start,
    ends,
    gyro_bias,
    accel_bias,
    noise,
    rotation,
    vectors,
    by_bias,
    covariance,
):
    """One row of the outputs per interval: added up from identity and zeros, in place; `vectors` holds velocity,
    position and final rate."""
    last = len(times) - 2
    A, B, work, scratch = np.zeros((9, 9)), np.zeros(9), np.zeros((9, 9)), np.zeros((8, 3, 3))
    for i in range(9):
        A[i, i] = 1.0
    w0, w1, a0, a1 = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for n in range(len(starts)):
        R, moved, slopes, spread = rotation[n], vectors[n], by_bias[n], covariance[n]
        t, end = starts[n], ends[n]
        forward = end >= t
        k = min(max(after_start[n] - 1, 0), last)
        if not forward and k > 0 and times[k] >= t:
            k -= 1
        _bias_free(times, gyro, t, k, gyro_bias[n], w0)
        _bias_free(times, accel, t, k, accel_bias[n], a0)
        while t != end:
            if forward:
                reached = end if k >= last else min(end, times[k + 1])
            else:
                reached = end if k <= 0 else max(end, times[k])
            _bias_free(times, gyro, reached, k, gyro_bias[n], w1)
            _bias_free(times, accel, reached, k, accel_bias[n], a1)
            _advance(reached - t, w0, w1, a0, a1, R, moved, slopes, A, scratch)
            _step_noise(noise, abs(reached - t), times[k + 1] - times[k], B)
            _spread(spread, A, B, work)
            for i in range(3):
                w0[i], a0[i] = w1[i], a1[i]
            t = reached
            k = min(max(k + (1 if forward else -1), 0), last)
        for i in range(3):
            moved[2, i] = w0[i]


@njit(error_model="numpy")
def _bias_free(times, signal, t, index, bias, out):  # type: ignore[no-untyped-def]
    _sample(times, signal, t, index, out)
    for i in range(3):
        out[i] -= bias[i]


@njit(error_model="numpy")
def _advance(dt, w0, w1, a0, a1, R, vectors, by_bias, A, scratch):  # type: ignore[no-untyped-def]
    """One step between rates w0, w1 and accelerations a0, a1 at its ends: increments, their derivatives by the
    biases, and the transition A (9, 9) of their errors."""
    turn, Jr, R1, H0, H1, H1t, Rg1 = (
        scratch[0], scratch[1], scratch[2], scratch[3], scratch[4], scratch[5], scratch[6],
    )  # fmt: skip
    Rg, angles = by_bias[0], scratch[7, 0]
    for i in range(3):
        angles[i] = 0.5 * (w0[i] + w1[i]) * dt
    _exp3(angles, turn, Jr)
    _matmul3(R, turn, R1)
    _minus_rotated_hat(R, a0, H0)
    _minus_rotated_hat(R1, a1, H1)
    for i in range(3):
        for j in range(3):
            # d(R1 a1) by the right tangent of R, through R1 = R turn
            H1t[i, j] = H1[i, 0] * turn[j, 0] + H1[i, 1] * turn[j, 1] + H1[i, 2] * turn[j, 2]
            # right tangent of R1 by the gyro bias: turn^T Rg - Jr dt
            carried = turn[0, i] * Rg[0, j] + turn[1, i] * Rg[1, j] + turn[2, i] * Rg[2, j]
            Rg1[i, j] = carried - Jr[i, j] * dt
            A[i, j] = turn[j, i]
            A[3 + i, j] = (H0[i, j] + H1t[i, j]) * dt / 2
            A[6 + i, j] = (2 * H0[i, j] + H1t[i, j]) * dt * dt / 6
        A[6 + i, 3 + i] = dt
    _move(dt, a0, a1, R, R1, vectors[0], vectors[1])
    _move_by_bias(dt, R, R1, H0, H1, Rg1, by_bias)
    for i in range(3):
        for j in range(3):
            R[i, j], Rg[i, j] = R1[i, j], Rg1[i, j]


@njit(error_model="numpy")
def _move(dt, a0, a1, R, R1, v, p):  # type: ignore[no-untyped-def]
    """Velocity and position, with a force that varies linearly."""
    for i in range(3):
        f0 = R[i, 0] * a0[0] + R[i, 1] * a0[1] + R[i, 2] * a0[2]
        f1 = R1[i, 0] * a1[0] + R1[i, 1] * a1[1] + R1[i, 2] * a1[2]
        p[i] += v[i] * dt + (2 * f0 + f1) * dt * dt / 6
        v[i] += (f0 + f1) * dt / 2


@njit(error_model="numpy")
def _move_by_bias(dt, R, R1, H0, H1, Rg1, by_bias):  # type: ignore[no-untyped-def]
    """Derivatives of velocity and position by both biases."""
    Rg, Vg, Va, Pg, Pa = by_bias[0], by_bias[1], by_bias[2], by_bias[3], by_bias[4]
    for i in range(3):
        for j in range(3):
            g0 = H0[i, 0] * Rg[0, j] + H0[i, 1] * Rg[1, j] + H0[i, 2] * Rg[2, j]
            g1 = H1[i, 0] * Rg1[0, j] + H1[i, 1] * Rg1[1, j] + H1[i, 2] * Rg1[2, j]
            Pg[i, j] += Vg[i, j] * dt + (2 * g0 + g1) * dt * dt / 6
            Pa[i, j] += Va[i, j] * dt - (2 * R[i, j] + R1[i, j]) * dt * dt / 6
            Vg[i, j] += (g0 + g1) * dt / 2
            Va[i, j] -= (R[i, j] + R1[i, j]) * dt / 2


@njit(error_model="numpy")
def _step_noise(noise, size, sample_step, B):  # type: ignore[no-untyped-def]
    """B (9,): what sensor noise adds in a step of this size (s); across a gap, what the signal may have done unseen."""
    gyro_bridge, accel_bridge = 0.0, 0.0
    if sample_step > noise[4]:
        # a piece of a bridge misses what the whole does, in proportion to its length
        gyro_bridge = noise[2] * sample_step**2 * size / 12
        accel_bridge = noise[3] * sample_step**2 * size / 12
    for i in range(3):
        B[i] = noise[0] * size + gyro_bridge
        B[3 + i] = noise[1] * size + accel_bridge
        B[6 + i] = (noise[1] * size + accel_bridge) * size * size / 3
