"""What every stretch of a recording would tell about every parameter of the rig: one information matrix each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rigwake._types import Array, Indices
from rigwake.ba.solver.covariance import covariance_of
from rigwake.ba.solver.parameter_layout import OwnedParameter
from rigwake.ba.solver.rig_problem import RigProblem, SolverOptions
from rigwake.errors import RigwakeError
from rigwake.sections.expected_motion import ExpectedMotion
from rigwake.sections.predicted_problem import ForecastSensors, TrackingForecast, predicted_problem

# residuals mean nothing here: nothing is down-weighted
_PLAIN = SolverOptions(loss_scale=1e9, gnss_loss_scale=1e9)
_DELAY_STD_S, _CLOCK_STD_S = 0.1, 1.0
_LEAST_FRACTION = 1e-9  # of a direction's information that is left when nothing else is known


@dataclass(frozen=True, eq=False)
class StretchInformation:
    """Information about the rig by stretch.

    spans_ns: (S, 2) begin and end of the stretches, rig clock. parameters: columns of each camera's `rig_from_cam`
    (6, tangent in camera axes) and `time_offset`, of the antenna's `position_rig` and `time_offset`. matrices:
    (S, k, k), positive semidefinite, with states, biases and landmarks unknown. prior: (k, k).
    """

    spans_ns: Indices
    parameters: dict[OwnedParameter, slice]
    matrices: Array
    prior: Array

    def __len__(self) -> int:
        return len(self.spans_ns)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras whose place is unknown."""
        return tuple(owner for owner, parameter in self.parameters if parameter == "rig_from_cam")

    def of(self, stretches: Indices | Array) -> Array:
        """(k, k) information of these stretches together."""
        return np.asarray(self.prior + self.matrices[stretches].sum(axis=0))


def stretch_spans(first_ns: int, last_ns: int, length_s: float) -> Indices:
    """(S, 2) equal stretches of about this length that fill a span."""
    count = max(round((last_ns - first_ns) * 1e-9 / length_s), 1)
    bounds = np.linspace(first_ns, last_ns, count + 1).astype(np.int64)
    return np.stack([bounds[:-1], bounds[1:]], axis=1)


def stretch_information(
    motion: ExpectedMotion,
    sensors: ForecastSensors,
    forecast: TrackingForecast,
    spans_ns: Indices,
    texture: Array,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StretchInformation:
    """Predict the information of every stretch. texture: (S, C), 0 to 1 (`predicted_problem`)."""
    parameters = _parameters(sensors)
    size = max((columns.stop for columns in parameters.values()), default=0)
    matrices = np.zeros((len(spans_ns), size, size))
    for row, span in enumerate(spans_ns.tolist()):
        if texture[row].any():
            problem = predicted_problem(motion, sensors, forecast, (span[0], span[1]), texture[row], row)
            matrices[row] = information_about(problem, parameters, size)
        progress(row + 1, len(spans_ns))
    prior = np.zeros((size, size))
    for (owner, parameter), columns in parameters.items():
        if parameter == "time_offset":
            std = _DELAY_STD_S if owner == "antenna" else _CLOCK_STD_S
            prior[columns, columns] = std**-2
    return StretchInformation(spans_ns, parameters, matrices, prior)


def _parameters(sensors: ForecastSensors) -> dict[OwnedParameter, slice]:
    widths: list[tuple[OwnedParameter, int]] = []
    for number, name in enumerate(sensors.models):
        if sensors.imu is not None or number > 0:
            widths += [((name, "rig_from_cam"), 6), ((name, "time_offset"), 1)]
    if sensors.gnss is not None:
        widths += [(("antenna", "position_rig"), 3)]
        widths += [(("antenna", "time_offset"), 1)] if sensors.imu is not None else []
    ends = np.cumsum([width for _, width in widths]).tolist()
    return {key: slice(end - width, end) for (key, width), end in zip(widths, ends, strict=True)}


def information_about(problem: RigProblem, parameters: dict[OwnedParameter, slice], size: int) -> Array:
    """The problem's information about the parameters, what else it shares (errors of the receiver) marginalised."""
    if not len(problem.observations):
        return np.zeros((size, size))
    try:
        found = covariance_of(problem, _PLAIN)
    except RigwakeError:  # states that nothing ties to anything: the stretch tells nothing
        return np.zeros((size, size))
    start = found.layout.n_state_columns
    places: list[Indices] = []
    wanted: list[Indices] = []
    for key, columns in parameters.items():
        block = found.layout.shared.get(key)
        if block is not None:
            places.append(np.arange(block.start - start, block.stop - start))
            wanted.append(np.arange(columns.start, columns.stop))
    own, into = np.concatenate(places), np.concatenate(wanted)
    others = np.setdiff1d(np.arange(len(found.information)), own)
    matrix = found.information[np.ix_(own, own)]
    if len(others):
        cross = found.information[np.ix_(own, others)]
        matrix = (
            matrix
            - cross @ np.linalg.pinv(found.information[np.ix_(others, others)], hermitian=True) @ cross.T
        )
    return _embedded(_positive(matrix), into, size)


def _positive(matrix: Array) -> Array:
    """Without the small negative or meaningless eigenvalues that rounding leaves."""
    scale = np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny ** 0.25))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    values = np.where(values > _LEAST_FRACTION, values, 0.0)
    half = scale[:, None] * vectors * np.sqrt(values)
    return np.asarray(half @ half.T)


def _embedded(matrix: Array, columns: Indices, size: int) -> Array:
    whole = np.zeros((size, size))
    whole[np.ix_(columns, columns)] = matrix
    return whole
