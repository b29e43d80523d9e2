"""Loops on all cores: how many there are changes nothing, and ranges are fair and apart."""

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ba_rigs import Wanted, free_cameras, started_off, true_problem
from rigwake import parallel
from rigwake.ba.solver import envelope, normal, schur
from rigwake.ba.solver.levenberg_marquardt import solve
from rigwake.ba.solver.rig_problem import RigProblem, SolverOptions


def rig(imu: bool) -> RigProblem:
    truth = free_cameras(true_problem(Wanted(seconds=8.0, landmarks=60, imu=imu)), "rig_from_cam")
    return started_off(truth, 0)


def solved(problem: RigProblem, workers: int, least: float, monkeypatch: pytest.MonkeyPatch) -> np.ndarray:
    """All states and mountings with so many threads and ranges that small."""
    with ThreadPoolExecutor(workers) as pool, monkeypatch.context() as patch:
        patch.setattr(parallel, "_threads", lambda: pool)
        patch.setattr(schur, "_LEAST_OBSERVATIONS", least)
        patch.setattr(schur, "_LEAST_MEETINGS", least)
        patch.setattr(envelope, "_LEAST_PRODUCTS", least)
        found = solve(problem, SolverOptions(max_iterations=4)).problem
    parts = [found.states.world_from_rig.matrix] + [c.rig_from_cam.matrix for c in found.cameras]
    return np.concatenate([part.ravel() for part in parts])


@pytest.mark.parametrize("imu", [True, False])
def test_threads_change_nothing(imu: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = rig(imu)
    alone = solved(problem, 1, 100.0, monkeypatch)
    assert np.array_equal(alone, solved(problem, 4, 100.0, monkeypatch))
    assert np.allclose(alone, solved(problem, 1, np.inf, monkeypatch), rtol=0, atol=1e-7)


@settings(max_examples=50)
@given(st.lists(st.integers(0, 100), min_size=1, max_size=60), st.integers(1, 200))
def test_ranges_cover_everything_once_and_are_worth_it(costs: list[int], least: int) -> None:
    bounds = parallel.ranges(np.array(costs), least)
    assert bounds[0] == 0
    assert bounds[-1] == len(costs)
    assert (np.diff(bounds) > 0).all()
    seen: list[int] = []
    parallel.over_ranges(bounds, lambda first, last: seen.extend(range(first, last)))
    assert sorted(seen) == list(range(len(costs)))
    assert len(bounds) - 1 <= max(sum(costs) // least, 1)


def test_results_come_in_order_and_loops_may_be_nested() -> None:
    bounds = np.arange(6)

    def total(item: int) -> int:
        parts = np.zeros(5, dtype=np.int64)
        parallel.over_ranges(bounds, lambda first, last: parts.__setitem__(first, item * last))
        return int(parts.sum()) + sum(parallel.in_order(abs, [item]))

    assert list(parallel.in_order(total, range(40))) == [16 * item for item in range(40)]


def test_an_error_on_a_thread_reaches_the_caller() -> None:
    with pytest.raises(ZeroDivisionError):
        list(parallel.in_order(lambda item: 1 // item, [1, 0, 2]))
    with pytest.raises(ZeroDivisionError):
        parallel.over_ranges(np.arange(4), lambda first, last: first // (first - 1))


@settings(max_examples=50)
@given(st.lists(st.integers(-2, 2), min_size=1, max_size=40), st.integers(1, 2), st.integers(1, 12))
def test_ranges_of_frames_share_no_state(jitter: list[int], neighbours: int, parts: int) -> None:
    first = np.clip(np.arange(len(jitter)) // 3 + jitter, 0, None)
    states = first[:, None] + np.arange(neighbours)
    bounds = np.unique(np.linspace(0, len(states), parts + 1).astype(np.int64))
    apart = normal._apart(bounds, states)
    assert apart[0] == 0
    assert apart[-1] == len(states)
    owned = [set(states[a:b].ravel()) for a, b in pairwise(apart)]
    assert sum(map(len, owned)) == len(set().union(*owned))


def test_a_solve_ends_once_the_shared_parameters_rest() -> None:
    problem = rig(imu=True)
    exact = solve(problem, SolverOptions(tolerance=1e-12))
    early = solve(problem, SolverOptions(tolerance=1e-12, shared_tolerance=0.1))
    assert early.report.converged
    assert early.report.iterations < exact.report.iterations
    for mine, best in zip(early.problem.cameras, exact.problem.cameras, strict=True):
        assert np.linalg.norm(best.rig_from_cam.local(mine.rig_from_cam)) < 1e-3
    assert early.report.reason.startswith("the shared parameters")
