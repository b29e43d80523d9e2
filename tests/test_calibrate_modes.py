"""Every combination of sensors, and motions that cannot tell: from tracks to verdicts, without pictures."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from calibration_worlds import (
    STANDSTILL,
    STILL_WATER,
    STRAIGHT,
    Calibrated,
    calibrated,
    own_odometry,
    sail,
    true_odometry,
    with_clocks,
)
from rigwake.ba.solver.rig_problem import VectorPrior
from rigwake.errors import UnobservableError
from rigwake.geometry.se3 import SE3
from rigwake.pipeline.prior import Baseline, RigPrior, load_prior
from rigwake.simulation.tracks_only import SimulatedTracks
from rigwake.trajectory import Trajectory

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def world() -> SimulatedTracks:
    return sail()


@pytest.fixture(scope="module")
def odometry(world: SimulatedTracks) -> dict[str, Trajectory]:
    return own_odometry(world)


def assert_honest(found: Calibrated, most_deg: float, most_m: float) -> None:
    """Errors below the bounds, and as large as assumed: NEES below its 99.9 % quantile (22.5 for 6 axes)."""
    for name, error in found.errors.cameras.items():
        assert error.rotation_error_deg <= most_deg
        assert np.nan_to_num(error.translation_error_norm_m) <= most_m
        assert error.nees is None or error.nees < 22.5, name


def offset_front_left(world: SimulatedTracks) -> float:
    rig = world.recording.true_rig
    assert rig is not None
    front, left = (rig.camera(name).rig_from_cam.translation for name in ("front", "left"))
    return float(np.linalg.norm(front - left))


@pytest.mark.parametrize(
    ("settings", "scale", "reference"),
    [
        ((), "gnss", "imu"),
        (("gnss=false",), "imu", "imu"),
        (("imu=false",), "gnss", "left"),
        (("reference=left",), "gnss", "left"),
    ],
)
def test_with_what_is_at_hand(
    world: SimulatedTracks,
    odometry: dict[str, Trajectory],
    settings: tuple[str, ...],
    scale: str,
    reference: str,
) -> None:
    found = calibrated(world, *settings, trajectories=odometry)
    assert found.scale_source == scale
    assert found.calibration.reference in (reference, "front" if reference == "left" else reference)
    assert all(camera.is_observable for camera in found.calibration.cameras.values())
    assert_honest(found, 0.1, 0.15)


def test_cameras_alone_give_rotations_and_say_what_is_missing(
    world: SimulatedTracks, odometry: dict[str, Trajectory]
) -> None:
    found = calibrated(world, "imu=false", "gnss=false", trajectories=odometry)
    (other,) = (c for n, c in found.calibration.cameras.items() if n != found.calibration.reference)
    assert other.observable_axes.tolist() == [True] * 3 + [False] * 3
    assert "scale" in other.unobservable[0].words
    assert_honest(found, 0.1, 0.0)


def test_a_foreign_metric_odometry_gives_the_scale(world: SimulatedTracks) -> None:
    found = calibrated(world, "imu=false", "gnss=false", trajectories=true_odometry(world, metric=True))
    assert found.scale_source == "trajectory"
    assert_honest(found, 0.1, 0.15)


def test_a_known_baseline_gives_the_scale(world: SimulatedTracks, odometry: dict[str, Trajectory]) -> None:
    known = Baseline("front", "left", offset_front_left(world), 0.005)
    found = calibrated(
        world, "imu=false", "gnss=false", trajectories=odometry, prior=RigPrior(baselines=(known,))
    )
    assert found.scale_source == "baseline"
    assert_honest(found, 0.1, 0.15)


def test_a_baseline_is_a_measurement_beside_the_sensors(
    world: SimulatedTracks, odometry: dict[str, Trajectory]
) -> None:
    known = Baseline("front", "left", offset_front_left(world), 1e-4)
    found = calibrated(
        world,
        trajectories=odometry,
        prior=RigPrior(baselines=(known,), antenna=VectorPrior.from_std(np.zeros(3), np.full(3, 5.0))),
    )
    front, left = (found.calibration.cameras[name].rig_from_cam.translation for name in ("front", "left"))
    assert np.linalg.norm(front - left) == pytest.approx(known.distance_m, abs=1e-3)


def test_a_prior_off_by_20_degrees_and_half_a_metre_leaves_the_optimum_where_it_is(
    world: SimulatedTracks, odometry: dict[str, Trajectory], tmp_path: Path
) -> None:
    without = calibrated(world, trajectories=odometry)
    off = SE3.exp(np.array([*np.deg2rad([12.0, 12.0, 10.6]), 0.3, -0.3, 0.26]))
    entries = {}
    for name, camera in without.truth.cameras.items():
        wrong = camera.rig_from_cam * off
        entries[name] = {
            "rig_from_cam": {
                "quat_wxyz": wrong.quat_wxyz.tolist(),
                "translation_m": wrong.translation.tolist(),
            },
            "std": {"rotation_deg": [20.0] * 3, "translation_m": [0.5] * 3},
        }
    file = tmp_path / "tape.yaml"
    file.write_text(yaml.safe_dump({"cameras": entries}))
    known_fraction = calibrated(world, trajectories=odometry, prior=load_prior(file))
    for name, camera in known_fraction.calibration.cameras.items():
        moved = without.calibration.cameras[name].rig_from_cam.local(camera.rig_from_cam)
        assert np.abs(np.linalg.solve(np.linalg.cholesky(camera.covariance), moved)).max() < 0.5


def test_clocks_20_ms_apart_are_found(world: SimulatedTracks) -> None:
    found = calibrated(with_clocks(world, {"front": 20.0, "left": -20.0}))
    assert found.calibration.cameras["front"].time_offset_s == pytest.approx(0.020, abs=1e-3)
    assert found.calibration.cameras["left"].time_offset_s == pytest.approx(-0.020, abs=1e-3)
    assert_honest(found, 0.1, 0.15)


def test_satellite_noise_of_a_metre_does_not_reach_the_rig(odometry: dict[str, Trajectory]) -> None:
    assert_honest(calibrated(sail(gnss={"white_std_m": 1.0}), trajectories=odometry), 0.1, 0.15)


def test_a_camera_without_motion_is_named_and_the_others_are_calibrated() -> None:
    world = sail(("front", "left", "back"))
    odometry = own_odometry(world)
    short = odometry["back"].take(np.arange(4))
    found = calibrated(world, trajectories={**odometry, "back": short})
    assert "back" in found.failed
    assert set(found.calibration.cameras) == {"front", "left"}


@pytest.mark.parametrize("boat", [STRAIGHT, STANDSTILL])
def test_motion_without_turns_is_refused_with_what_is_missing(boat: dict[str, object]) -> None:
    world = sail(vessel=boat, sea=STILL_WATER, scene={"size_m": [150, 110]})
    with pytest.raises(UnobservableError) as caught:
        calibrated(world)
    assert caught.value.exit_code == 3
    assert caught.value.remedy


def test_calm_water_never_tells_a_vertical_offset_that_is_wrong() -> None:
    found = calibrated(sail(sea=STILL_WATER))
    for error in found.errors.cameras.values():
        camera = found.calibration.cameras[error.name]
        assert not camera.observable_axes[5]
        known = np.isfinite(error.translation_error_m)
        assert (np.abs(error.translation_error_m[known]) < 3 * camera.std_translation_m[known]).all()
        if camera.observable_axes[:3].all():
            assert error.rotation_error_deg < 3 * np.linalg.norm(camera.std_rotation_deg)
