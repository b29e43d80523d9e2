"""How a receiver really errs: white noise, and errors that last, learnt from the fixes within bounds.

A receiver's stated covariance is the size of its whole error, most of which lasts for half a minute or more: five
fixes a second are far from five measurements. White noise is what third differences show; what the covariance says
beyond that, or what the residuals show beyond it, is a Gauss-Markov process whose values are unknowns at nodes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigwake._robust import MAD_TO_STD
from rigwake._types import Array, Indices
from rigwake.ba.solver.linear_factors import fixes_inside
from rigwake.ba.solver.parameter_layout import layout_of
from rigwake.ba.solver.rig_problem import LastingErrors, RigProblem
from rigwake.ba.solver.state_motion import nearest_states, rig_at, seconds_since_start

_LEAST_STD, _MOST_STD = 0.003, 30.0  # metres, of white noise and of lasting errors
_LEAST_TAU_S, _USUAL_TAU_S, _MOST_TAU_S = 10.0, 40.0, 300.0
_NODES_PER_TAU, _MOST_NODES = 8.0, 48
_FEWEST = 20
_WORTH_MODELLING = 0.7  # of the white noise
_BIN_S = 4.0


def with_receiver_errors(problem: RigProblem) -> RigProblem:
    """The problem before its first solution: white noise and lasting errors as fixes and their covariance say."""
    gnss = problem.gnss
    if gnss is None or problem.imu is None or len(gnss.timestamps_ns) < _FEWEST:
        return problem
    white = white_noise(gnss.timestamps_ns, gnss.position_enu)
    stated = np.sqrt(np.median(np.einsum("nii->ni", gnss.covariances), axis=0))
    white = np.clip(np.minimum(white, stated), _LEAST_STD, _MOST_STD)
    lasting = np.sqrt(np.maximum(stated**2 - white**2, 0.0))
    return _modelled(problem, white, lasting, _USUAL_TAU_S)


def with_learnt_receiver_errors(problem: RigProblem) -> RigProblem:
    """The problem between rounds: noise and lasting errors raised to what the residuals show."""
    gnss = problem.gnss
    if gnss is None or problem.imu is None or len(gnss.timestamps_ns) < _FEWEST:
        return problem
    stamps, off = antenna_off(problem)
    if len(off) < _FEWEST:
        return problem
    now = problem.antenna.errors
    shown = np.clip(white_noise(stamps, off), _LEAST_STD, _MOST_STD)
    used = np.sqrt(np.median(np.einsum("nii->ni", gnss.covariances), axis=0))
    if now is not None:  # a part of the variance stands for what nodes cannot follow
        used = np.sqrt(np.maximum(used**2 - _between_nodes(now, stamps) ** 2, _LEAST_STD**2))
    white = np.maximum(used, shown)
    lasting = np.maximum(np.zeros(3) if now is None else now.std, _lasting(stamps, off, white))
    tau = _USUAL_TAU_S if now is None else now.correlation_s
    return _modelled(
        problem, white, np.minimum(lasting, _MOST_STD), _correlation_s(stamps, off, white, lasting, tau)
    )


def white_noise(stamps: Indices, values: Array) -> Array:
    """(3,) robust standard deviation of what changes from fix to fix, by third differences over regular steps."""
    steps = np.diff(stamps)
    regular = np.abs(steps - np.median(steps)) < 0.2 * np.median(steps)
    run = regular[:-2] & regular[1:-1] & regular[2:]
    third = np.diff(values, n=3, axis=0)[run]
    if len(third) < 8:
        return np.full(3, _LEAST_STD)
    return np.asarray(MAD_TO_STD * np.median(np.abs(third), axis=0) / np.sqrt(20.0))


def antenna_off(problem: RigProblem) -> tuple[Indices, Array]:
    """Stamps and positions of the estimated antenna less the fixes, ENU; lasting errors are still in them."""
    gnss, antenna = problem.gnss, problem.antenna
    assert gnss is not None
    kept, _ = fixes_inside(problem)
    times = seconds_since_start(problem, gnss.timestamps_ns[kept]) + antenna.time_offset_s
    rig = rig_at(problem, layout_of(problem), times, nearest_states(problem, times), moving=True)
    return gnss.timestamps_ns[kept], rig.world_from_body * antenna.position_rig - gnss.position_enu[kept]


def _lasting(stamps: Indices, off: Array, white: Array) -> Array:
    """(3,) standard deviation of the residuals' means over four seconds, beyond what white noise leaves in them."""
    _, group = np.unique((stamps - stamps[0]) // round(_BIN_S * 1e9), return_inverse=True)
    counts = np.bincount(group)
    means = np.stack([np.bincount(group, off[:, k]) for k in range(3)], axis=1) / counts[:, None]
    means = means[counts >= 3]
    if len(means) < 4:
        return np.zeros(3)
    spread = MAD_TO_STD * np.median(np.abs(means - np.median(means, axis=0)), axis=0)
    usual = float(np.median(counts[counts >= 3]))
    return np.sqrt(np.maximum(spread**2 - 2.0 * white**2 / usual, 0.0))


def _correlation_s(stamps: Indices, off: Array, white: Array, lasting: Array, before: float) -> float:
    """Correlation time from how much the residuals' means change over four seconds, against how large they are."""
    if not (lasting > 0).any():
        return before
    bins, group = np.unique((stamps - stamps[0]) // round(_BIN_S * 1e9), return_inverse=True)
    counts = np.bincount(group)
    means = np.stack([np.bincount(group, off[:, k]) for k in range(3)], axis=1) / counts[:, None]
    changes = np.diff(means, axis=0)[np.diff(bins) == 1]  # over a gap they have had longer
    if len(changes) < 5:
        return before
    change = np.mean(changes**2, axis=0) - 2 * white**2 / np.median(counts)
    chosen = lasting > _WORTH_MODELLING * white
    if not chosen.any():
        return before
    ratio = float(np.median(np.maximum(change[chosen], 1e-12) / (2 * lasting[chosen] ** 2)))
    longest_first = np.geomspace(_MOST_TAU_S, _LEAST_TAU_S, 400)
    return float(np.interp(ratio, _change_of_means(longest_first), longest_first))


def _change_of_means(tau_s: Array) -> Array:
    """Half the mean square of the change from one four-second mean of the process to the next, over its variance.

    Means change by less than the process does: 2/3 of it where it lasts for much longer than they.
    """
    bins = _BIN_S / tau_s
    lost = -np.expm1(-bins)  # of the correlation, over one bin
    return np.asarray((2 * (bins - lost) - lost**2) / bins**2)


def _between_nodes(errors: LastingErrors, stamps: Indices) -> Array:
    """(3,) what linear interpolation between nodes leaves of the process, counted as if it were new in every fix.

    A bridge of the process between nodes a time d apart has a mean variance of `s^2 d / (3 tau)`, less what a straight
    line follows: half of it; the fixes between two nodes share it.
    """
    nodes = errors.timestamps_ns
    if len(nodes) < 2:
        return np.zeros(3)
    spacing = float(np.median(np.diff(nodes))) * 1e-9
    shared = max(spacing / max(float(np.median(np.diff(stamps))) * 1e-9, 1e-3), 1.0)
    return errors.std * np.sqrt(spacing / (6 * errors.correlation_s) * shared)


def _modelled(problem: RigProblem, white: Array, lasting: Array, tau_s: float) -> RigProblem:
    """The problem with this noise; errors that are small beside the white noise are counted in it."""
    gnss, antenna = problem.gnss, problem.antenna
    assert gnss is not None
    if not (lasting > _WORTH_MODELLING * white).any():
        variance = np.broadcast_to(np.diag(white**2 + lasting**2), gnss.covariances.shape).copy()
        return replace(
            problem, gnss=replace(gnss, covariances=variance), antenna=replace(antenna, errors=None)
        )
    first, last = int(gnss.timestamps_ns[0]), int(gnss.timestamps_ns[-1])
    seconds = (last - first) * 1e-9
    count = int(np.clip(np.ceil(seconds * _NODES_PER_TAU / tau_s) + 1, 2, _MOST_NODES))
    nodes = np.linspace(first, last, count).astype(np.int64)
    values = np.zeros((count, 3))
    if (before := antenna.errors) is not None:
        at = before.timestamps_ns
        values = np.stack([np.interp(nodes, at, before.values_enu[:, k]) for k in range(3)], axis=1)
    errors = LastingErrors(nodes, values, np.maximum(lasting, 0.1 * white), tau_s)
    variance = white**2 + _between_nodes(errors, gnss.timestamps_ns) ** 2
    covariances = np.broadcast_to(np.diag(variance), gnss.covariances.shape).copy()
    return replace(
        problem, gnss=replace(gnss, covariances=covariances), antenna=replace(antenna, errors=errors)
    )
