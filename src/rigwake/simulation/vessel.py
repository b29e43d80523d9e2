"""The boat's motion in continuous time: manoeuvres and waves become one spline, whose derivatives are exact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.signal import bilinear, lfilter, lfilter_zi

from rigwake._types import Array
from rigwake.errors import UsageError
from rigwake.geometry.se3 import SE3
from rigwake.simulation.scenario import Manoeuvre, Vessel
from rigwake.simulation.scene_layout import SceneLayout
from rigwake.simulation.waves import GRAVITY, SelfMaskResponse, WaveField, raft_motion

MARGIN_S = 3.0  # motion before the first and after the last instant: clocks and shutters look there
_PROFILE_HZ = 100
_KNOT_HZ = 20
_SMOOTHING_S = 2.0  # no boat changes speed or rate of turn at once
_CRUISE_MPS = 2.0


@dataclass(frozen=True, eq=False)
class VesselMotion:
    """Position and attitude of the rig frame as one quintic spline of time (s since the start).

    The spline's six columns are east, north, up (m), roll, pitch, yaw (rad), with
    `world_from_rig = Rz(yaw) Ry(pitch) Rx(roll)`. Defined `MARGIN_S` beyond [0, duration_s].
    """

    spline: BSpline
    duration_s: float

    def world_from_rig(self, times_s: Array) -> SE3:
        """The rig frame at times (N,)."""
        state = self.spline(np.asarray(times_s, dtype=np.float64))
        return SE3(rotation_from_euler(state[..., 3:]), state[..., :3])

    def velocity_world(self, times_s: Array, point_rig: Array) -> Array:
        """Velocity (N, 3) of a point fixed to the rig, in world axes, m/s."""
        state, rate = self.spline(times_s), self.spline(times_s, 1)
        omega, _ = _angular(state[..., 3:], rate[..., 3:], np.zeros_like(rate[..., 3:]))
        turning = np.cross(omega, point_rig)
        return np.asarray(
            rate[..., :3] + np.einsum("nij,nj->ni", rotation_from_euler(state[..., 3:]), turning)
        )

    def inertial(self, times_s: Array, rig_from_imu: SE3) -> tuple[Array, Array]:
        """Angular velocity (N, 3) and specific force (N, 3) of an ideal inertial unit, in its own axes.

        `f = R_wi^T (a - g)` with `a = p'' + R (alpha x l + omega x (omega x l))`: exact derivatives of the spline.
        """
        state, rate, second = (self.spline(times_s, order) for order in (0, 1, 2))
        omega, alpha = _angular(state[..., 3:], rate[..., 3:], second[..., 3:])
        lever = rig_from_imu.translation
        gravity_free = second[..., :3] + np.array([0, 0, GRAVITY])
        force = np.einsum("nji,nj->ni", rotation_from_euler(state[..., 3:]), gravity_free)
        force += np.cross(alpha, lever) + np.cross(omega, np.cross(omega, lever))
        return omega @ rig_from_imu.rotation, force @ rig_from_imu.rotation


def rotation_from_euler(roll_pitch_yaw: Array) -> Array:
    """`Rz(yaw) Ry(pitch) Rx(roll)`: (..., 3) -> (..., 3, 3)."""
    c, s = np.cos(roll_pitch_yaw), np.sin(roll_pitch_yaw)
    (cr, cp, cy), (sr, sp, sy) = np.moveaxis(c, -1, 0), np.moveaxis(s, -1, 0)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def _angular(angles: Array, rates: Array, seconds: Array) -> tuple[Array, Array]:
    """Angular velocity and acceleration (N, 3) in body axes from Euler angles and their derivatives."""
    c, s = np.cos(angles), np.sin(angles)
    (cr, cp, _), (sr, sp, _) = np.moveaxis(c, -1, 0), np.moveaxis(s, -1, 0)
    dr, dp, dy = np.moveaxis(rates, -1, 0)
    ddr, ddp, ddy = np.moveaxis(seconds, -1, 0)
    omega = np.stack([dr - dy * sp, dp * cr + dy * sr * cp, -dp * sr + dy * cr * cp], -1)
    alpha = np.stack(
        [
            ddr - ddy * sp - dy * dp * cp,
            ddp * cr - dp * dr * sr + ddy * sr * cp + dy * (dr * cr * cp - dp * sr * sp),
            -ddp * sr - dp * dr * cr + ddy * cr * cp - dy * (dr * sr * cp + dp * cr * sp),
        ],
        -1,
    )
    return omega, alpha


def build_motion(
    vessel: Vessel, duration_s: float, hull: SelfMaskResponse, layout: SceneLayout, sea: WaveField
) -> VesselMotion:
    """Sail the manoeuvres on this sea.

    Raises UsageError if the hull would come closer than `vessel.clearance_m` to the edge of the water.
    """
    times = np.arange(-MARGIN_S, duration_s + MARGIN_S + 1 / _PROFILE_HZ, 1 / _PROFILE_HZ)
    track = _place(_dead_reckon(vessel, times), vessel, hull, layout)
    every = _PROFILE_HZ // _KNOT_HZ
    times, track = times[::every], track[::every]
    excitation = vessel.response * raft_motion(sea, hull, times, track)
    heave, roll, pitch = _oscillate(excitation, hull).T
    east, north, yaw = track.T
    state = np.stack([east, north, heave, roll, pitch, yaw], 1)
    return VesselMotion(make_interp_spline(times, state, k=5), duration_s)


def _legs(manoeuvre: Manoeuvre, cruise_mps: float) -> list[tuple[float, float, float, float]]:
    """A manoeuvre as (duration, speed, sway, yaw rate) with constant values."""
    rate = np.deg2rad(manoeuvre.rate_deg_s)
    speed, sway = cruise_mps, manoeuvre.sway_mps
    if manoeuvre.type == "standstill":
        return [(manoeuvre.duration_s or 0.0, 0.0, 0.0, 0.0)]
    if manoeuvre.type == "dock":
        step = (manoeuvre.duration_s or 0.0) / 4
        return [(step, speed * f, sway, rate) for f in (0.75, 0.5, 0.25)] + [(step, 0.0, 0.0, 0.0)]
    if manoeuvre.type == "figure_eight":
        circle = 2 * np.pi / abs(rate)
        return [(circle, speed, sway, rate), (circle, speed, sway, -rate)]
    duration = manoeuvre.duration_s or np.deg2rad(manoeuvre.angle_deg or 0.0) / abs(rate)
    return [(duration, speed, sway, rate if manoeuvre.type == "turn" else 0.0)]


def _profile(vessel: Vessel, times_s: Array) -> Array:
    """(N, 3) speed ahead, speed to port, yaw rate; the manoeuvres start again when they are through."""
    legs: list[tuple[float, float, float, float]] = []
    cruise = _CRUISE_MPS
    for manoeuvre in vessel.manoeuvres:
        cruise = cruise if manoeuvre.speed_mps is None else manoeuvre.speed_mps
        legs += _legs(manoeuvre, cruise)
    table = np.array(legs)
    ends = np.cumsum(table[:, 0])
    leg = np.searchsorted(ends, np.mod(np.maximum(times_s, 0), ends[-1]), side="right")
    steps = table[np.minimum(leg, len(table) - 1), 1:]
    window = np.hanning(int(_SMOOTHING_S * _PROFILE_HZ) | 1)
    pad = len(window) // 2
    padded = np.pad(steps, ((pad, pad), (0, 0)), mode="edge")
    smooth = np.stack([np.convolve(c, window / window.sum(), mode="valid") for c in padded.T], 1)
    smooth[:, 1] -= vessel.slip_m * smooth[:, 2]  # the hull is carried outwards in a turn
    return smooth


def _dead_reckon(vessel: Vessel, times_s: Array) -> Array:
    """(N, 3) x, y, yaw from the origin, heading along x at time 0 (trapezoidal rule)."""
    profile = _profile(vessel, times_s)
    yaw = _integrate(profile[:, 2])
    yaw -= np.interp(0.0, times_s, yaw)
    vx = profile[:, 0] * np.cos(yaw) - profile[:, 1] * np.sin(yaw)
    vy = profile[:, 0] * np.sin(yaw) + profile[:, 1] * np.cos(yaw)
    plan = np.stack([_integrate(vx), _integrate(vy)], 1)
    start = [np.interp(0.0, times_s, column) for column in plan.T]
    return np.column_stack([plan - start, yaw])


def _integrate(values: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2) / _PROFILE_HZ])


def _moved(track: Array, east: float, north: float, heading: float) -> Array:
    c, s = np.cos(heading), np.sin(heading)
    plan = track[:, :2] @ np.array([[c, s], [-s, c]]) + [east, north]
    return np.column_stack([plan, track[:, 2] + heading])


def _corners(track: Array, hull: SelfMaskResponse) -> Array:
    """(N, 4, 2) corners of the hull's rectangle in plan."""
    c, s = np.cos(track[:, 2]), np.sin(track[:, 2])
    ahead = np.stack([c, s], 1)[:, None] * hull.length_m / 2
    aside = np.stack([-s, c], 1)[:, None] * hull.beam_m / 2
    signs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    return np.asarray(
        track[:, None, :2] + signs[None, :, :1] * ahead + signs[None, :, 1:] * aside, dtype=np.float64
    )


def _place(track: Array, vessel: Vessel, hull: SelfMaskResponse, layout: SceneLayout) -> Array:
    """The track moved to its start: the one asked for, or the one with the most room around it."""
    if vessel.start is not None:
        start = vessel.start
        placed = _moved(track, start.east_m, start.north_m, np.deg2rad(start.heading_deg))
    else:
        every = track[:: _PROFILE_HZ // 4]
        east, north, heading = max(
            (_centre(every, heading, hull) for heading in np.linspace(0, 2 * np.pi, 36, endpoint=False)),
            key=lambda start: float(layout.clearance(_corners(_moved(every, *start), hull)).min()),
        )
        placed = _moved(track, east, north, heading)
    room = layout.clearance(_corners(placed, hull)).min(axis=1)
    worst = int(np.argmin(room))
    if room[worst] < vessel.clearance_m:
        when = max(worst / _PROFILE_HZ - MARGIN_S, 0)
        raise UsageError(
            f"vessel.manoeuvres: the boat comes to {room[worst]:.1f} m from the edge of the water "
            f"(vessel.clearance_m is {vessel.clearance_m:g}) {when:.0f} s after the start.",
            consequence="It would sail through the quay, so nothing was simulated.",
            remedy="Enlarge scene.size_m, move vessel.start (or leave it out), or shorten the legs.",
        )
    return placed


def _centre(track: Array, heading: float, hull: SelfMaskResponse) -> tuple[float, float, float]:
    """The start (east, north, heading) that puts the middle of the turned track at the origin."""
    corners = _corners(_moved(track, 0.0, 0.0, heading), hull)
    east, north = -(corners.min((0, 1)) + corners.max((0, 1))) / 2
    return float(east), float(north), heading


def _oscillate(excitation: Array, hull: SelfMaskResponse) -> Array:
    """Damped second-order response (N, 3) of heave, roll and pitch to the surface's plane."""
    response = np.empty_like(excitation)
    for column, (period, damping) in enumerate(zip(hull.period_s, hull.damping, strict=True)):
        natural = 2 * np.pi / period
        b, a = bilinear([natural**2], [1.0, 2 * damping * natural, natural**2], fs=_KNOT_HZ)
        values = excitation[:, column]
        at_rest = lfilter_zi(b, a) * values[0]
        response[:, column], _ = lfilter(b, a, values, zi=at_rest)
    return response
