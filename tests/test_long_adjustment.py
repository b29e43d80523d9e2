"""Adjusting long recordings: bounded memory changes no result, and time grows with the length alone."""

import numpy as np
import pytest

from ba_rigs import Wanted, free_cameras, true_problem
from calibration_worlds import first_values, measurements, sail
from rigwake.ba.rig import search_proposals
from rigwake.ba.rig.assemble_problem import assemble_problem
from rigwake.ba.rig.rig_values import AdjustmentOptions
from rigwake.ba.rig.search_proposals import AssociationOptions, propose_searches
from rigwake.ba.solver import clusters, normal
from rigwake.ba.solver.covariance import covariance_of
from rigwake.ba.solver.rig_problem import RigProblem
from rigwake.errors import UsageError


@pytest.fixture(scope="module")
def rig() -> RigProblem:
    """Two cameras with everything free that is shared, lenses included."""
    problem = true_problem(Wanted(cameras=2, landmarks=120, seconds=6.0))
    return free_cameras(problem, "rig_from_cam", "time_offset", "intrinsics")


def test_portions_of_frames_give_the_same_information(
    rig: RigProblem, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = covariance_of(rig, clustered=True)
    monkeypatch.setattr(normal, "_PORTION", 2500)  # a handful of frames at a time
    monkeypatch.setattr(clusters, "_CHUNK", 100)
    parts = covariance_of(rig, clustered=True)
    scale = np.outer(whole.scale, whole.scale)
    assert np.abs((parts.information - whole.information) * scale).max() < 1e-9
    rows = whole.rows_of("cam0", "rig_from_cam")
    assert np.allclose(parts.of(rows)[0], whole.of(rows)[0], rtol=1e-6, atol=1e-14)


def test_a_sample_of_landmarks_tells_how_their_scores_scatter(
    rig: RigProblem, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = covariance_of(rig).rows_of("cam0", "rig_from_cam")
    whole = np.sqrt(np.diag(covariance_of(rig, clustered=True).of(rows)[0]))
    monkeypatch.setattr(clusters, "_MOST", len(rig.observations) // 2)
    monkeypatch.setattr(clusters, "_SAMPLED", 20)
    sampled = np.sqrt(np.diag(covariance_of(rig, clustered=True).of(rows)[0]))
    assert np.abs(np.log(sampled / whole)).max() < 0.4


def test_landmarks_are_looked_for_within_reach_alone(
    rig: RigProblem, monkeypatch: pytest.MonkeyPatch
) -> None:
    usable = {c.name: np.ones((480, 640), bool) for c in rig.cameras}
    seen = rig.observations
    early = seen.take(seen.timestamps_ns < rig.states.timestamps_ns[len(rig.states) // 3])
    problem = RigProblem(
        rig.states, rig.cameras, rig.landmarks, early, imu=rig.imu, gnss=rig.gnss, antenna=rig.antenna
    )
    kept = np.flatnonzero(np.bincount(early.landmark_indices, minlength=len(rig.landmarks)) > 0)
    renumbered = np.searchsorted(kept, early.landmark_indices)
    problem = RigProblem(
        rig.states,
        rig.cameras,
        rig.landmarks.take(kept),
        type(early)(early.camera_indices, early.timestamps_ns, renumbered, early.pixels, early.std_px),
        imu=rig.imu,
        gnss=rig.gnss,
        antenna=rig.antenna,
    )
    stamps = {
        c.name: np.unique(seen.timestamps_ns[seen.camera_indices == k]) for k, c in enumerate(rig.cameras)
    }
    options = AssociationOptions(min_gap_s=0.5)

    def farthest() -> int:
        searches = propose_searches(problem, stamps, usable, options)
        first = np.full(len(kept), np.iinfo(np.int64).max)
        np.minimum.at(first, renumbered, early.timestamps_ns)
        at, since = (
            np.searchsorted(rig.states.timestamps_ns, s) for s in (searches.stamps, first[searches.landmarks])
        )
        return int((at - since).max(initial=0))

    unbounded = farthest()
    assert unbounded > 5
    reach = unbounded - 2
    monkeypatch.setattr(search_proposals, "_REACH_COLUMNS", reach * (15 if rig.imu is not None else 6))
    assert 0 < farthest() <= reach


def test_tracks_are_bounded_in_all() -> None:
    world = sail(("front", "left"), features=40, duration_s=12)
    counts = [
        len(
            assemble_problem(
                measurements(world), first_values(world), AdjustmentOptions(most_tracks=most)
            ).problem.landmarks
        )
        for most in (80_000, 300)
    ]
    assert counts[1] <= 300 < counts[0]
    with pytest.raises(UsageError, match="most_tracks"):
        AdjustmentOptions(most_tracks=0)
