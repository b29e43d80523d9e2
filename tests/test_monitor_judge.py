"""Detection, blame and states on simulated tracks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from monitor_worlds import Watch, figure_eights, watch
from rigwake.errors import UsageError
from rigwake.monitor.innovations import belief_of
from rigwake.monitor.judge import Judgement
from rigwake.monitor.score import BlockScores
from rigwake.monitor.states import CameraState, Standing, next_standing, recalibrated, recalibrating
from rigwake.monitor.thresholds import Thresholds
from rigwake.simulation.track_stream import MountFault

pytestmark = pytest.mark.xdist_group("watch")
AT_S = 43.0


def states_of(judgement: Judgement, camera: str) -> list[CameraState]:
    k = judgement.scores.cameras.index(camera)
    return [row[k] for row in judgement.standings]


@pytest.fixture(scope="module")
def quiet() -> Watch:
    return figure_eights()[0]


@pytest.fixture(scope="module")
def quiet_scores() -> BlockScores:
    return figure_eights()[1]


def shifted(scores: BlockScores, camera: str, from_block: int, step: np.ndarray) -> BlockScores:
    """The same blocks as if a camera had changed by a small step (7,) from a block on: scores are linear in it."""
    k = scores.cameras.index(camera)
    g = scores.g.copy()
    g[from_block:] += scores.H[from_block:, :, 7 * k : 7 * k + 7] @ step
    return replace(scores, g=g)


def test_no_alarm_without_a_change(quiet: Watch, quiet_scores: BlockScores) -> None:
    judgement = quiet.judge(quiet_scores)
    assert not judgement.alarms
    assert all(state is CameraState.OK for state in judgement.standings[-1])


@pytest.mark.parametrize("camera", ["front", "left", "back", "right"])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_tenth_of_a_degree_is_found_and_blamed(
    quiet: Watch, quiet_scores: BlockScores, camera: str, axis: int
) -> None:
    step = np.zeros(7)
    step[axis] = np.deg2rad(0.1)
    judgement = quiet.judge(shifted(quiet_scores, camera, 4, step))
    assert [alarm.camera for alarm in judgement.alarms] == [camera]
    assert judgement.alarms[0].block <= 6
    change = judgement.alarms[0].change
    assert change is not None
    assert change.kind == "step"
    assert change.block == 4
    assert abs(change.size_deg - 0.1) < 0.02
    assert states_of(judgement, camera)[-1] is CameraState.DRIFTED
    others = {
        state for name in judgement.scores.cameras if name != camera for state in states_of(judgement, name)
    }
    assert CameraState.DRIFTED not in others


@pytest.mark.slow
def test_half_a_degree_about_the_vertical_of_simulated_tracks() -> None:
    world = watch("eights", 80.0, seed=7, fault=MountFault("left", AT_S, turned_rad=np.deg2rad([0, 0, 0.5])))
    judgement = world.judge()
    assert [alarm.camera for alarm in judgement.alarms] == ["left"]
    assert (judgement.alarms[0].block + 1) * 10 - AT_S <= 20


@pytest.mark.slow
def test_a_clock_that_jumps_is_not_a_camera_that_moved() -> None:
    judgement = watch("eights", 80.0, seed=7, fault=MountFault("left", AT_S, late_s=0.02)).judge()
    best = judgement.alarms[0].explanations[0]
    assert (best.cause, best.camera) == ("clock", "left")
    assert "clock" in judgement.alarms[0].words
    assert CameraState.DRIFTED not in {s for row in judgement.standings for s in row}
    assert states_of(judgement, "left")[-1] is CameraState.SUSPECT


@pytest.mark.slow
def test_a_drop_on_the_lens_is_not_a_camera_that_moved() -> None:
    def drop(pixels: np.ndarray, times_s: np.ndarray) -> np.ndarray:
        away = pixels - np.array([150.0, 200.0])
        far = np.linalg.norm(away, axis=1, keepdims=True)
        return pixels + np.where(far < 70, away * 0.25 * (1 - far / 70), 0)

    judgement = watch("eights", 80.0, seed=7, fault=MountFault("left", AT_S, pixels=drop)).judge()
    assert "drop" in judgement.alarms[0].words
    assert CameraState.DRIFTED not in {s for row in judgement.standings for s in row}


def test_an_imu_that_turned_is_blamed_on_no_camera(quiet: Watch, quiet_scores: BlockScores) -> None:
    turned = np.deg2rad([0.4, 0.3, 0.0])
    scores = quiet_scores
    for name, camera in quiet.calibration.cameras.items():
        place = camera.rig_from_cam.translation
        scores = shifted(scores, name, 4, np.concatenate([-turned, -np.cross(turned, place), [0.0]]))
    judgement = quiet.judge(scores)
    assert judgement.alarms[0].explanations[0].cause == "imu"
    np.testing.assert_allclose(judgement.alarms[0].explanations[0].value, turned, atol=np.deg2rad(0.15))
    assert CameraState.DRIFTED not in {s for row in judgement.standings for s in row}


def test_a_slow_ramp_is_called_one(quiet: Watch, quiet_scores: BlockScores) -> None:
    """0.6 deg per hour over a quarter: normal matrices as measured, scores drawn from what they predict."""
    rng, deg_per_hour, blocks = np.random.default_rng(2), 0.6, 90
    picked = rng.integers(1, len(quiet_scores), blocks)
    scores = quiet_scores.take(picked)
    scores = replace(scores, starts_ns=quiet_scores.starts_ns[0] + np.arange(blocks) * 10**10)
    g = np.empty_like(scores.g)
    rate = np.deg2rad(deg_per_hour) / 360
    for k in range(blocks):
        values, vectors = np.linalg.eigh(scores.H[k])
        g[k] = vectors @ (np.sqrt(np.maximum(values, 0)) * rng.standard_normal(len(values)))
        step = np.zeros(7)
        step[1] = rate * (k + 0.5)
        g[k] += scores.H[k][:, 7:14] @ step
    judgement = quiet.judge(replace(scores, g=g))
    (alarm,) = (a for a in judgement.alarms if a.camera)
    assert alarm.camera == "left"
    assert alarm.block * deg_per_hour / 360 < 0.2
    assert alarm.change is not None
    assert alarm.change.kind == "ramp"
    assert abs(alarm.change.rate_deg_per_hour - deg_per_hour) < 0.3 * deg_per_hour


def test_straight_on_calm_water_is_never_ok() -> None:
    judgement = watch("straight", 60.0, hs_m=0.02, cameras=2).judge()
    assert CameraState.OK not in {s for row in judgement.standings for s in row}


def test_states() -> None:
    thresholds = Thresholds()
    ok = Standing(CameraState.OK)

    def after(
        before: Standing, statistic: float, *, blamed: bool = False, observable: bool = True
    ) -> Standing:
        return next_standing(before, statistic, blamed=blamed, observable=observable, thresholds=thresholds)

    assert after(ok, thresholds.suspect + 1).state is CameraState.SUSPECT
    assert after(ok, thresholds.alarm + 1).state is CameraState.SUSPECT  # nobody is blamed yet
    drifted = after(ok, thresholds.alarm + 1, blamed=True)  # a large step skips the suspicion
    assert drifted.state is CameraState.DRIFTED
    assert after(drifted, 0.0) == drifted
    suspect = Standing(CameraState.SUSPECT)
    for _ in range(thresholds.calm_blocks - 1):
        suspect = after(suspect, thresholds.calm - 1)
        assert suspect.state is CameraState.SUSPECT
    assert after(suspect, thresholds.calm - 1).state is CameraState.OK
    assert after(ok, 0.0, observable=False).state is CameraState.UNOBSERVABLE
    assert recalibrating(drifted.state) is CameraState.RECALIBRATING
    assert recalibrated(recalibrating(drifted.state)) is CameraState.OK
    for state in (CameraState.OK, CameraState.UNOBSERVABLE):  # nothing to recalibrate
        assert recalibrating(state) is state


def test_thresholds_must_rise() -> None:
    with pytest.raises(UsageError, match="rise"):
        Thresholds(alarm=10.0, suspect=20.0)


def test_belief_counts_what_a_calibration_does_not_know(quiet: Watch) -> None:
    belief = belief_of(quiet.calibration, ("front", "left"), Thresholds())
    assert belief.covariance.shape == (14, 14)
    assert np.sqrt(belief.covariance[3, 3]) < 0.01
    loose = replace(
        quiet.calibration.cameras["front"], time_offset_std_s=None, covariance=np.full((6, 6), np.nan)
    )
    changed = replace(quiet.calibration, cameras={**quiet.calibration.cameras, "front": loose})
    belief = belief_of(changed, ("front", "left"), Thresholds())
    assert np.sqrt(belief.covariance[3, 3]) > 0.5
    assert np.isfinite(belief.covariance).all()
