"""Hand-eye on real data; the figures are those of `python benchmarks/handeye_real.py`."""

import runpy
from pathlib import Path

import numpy as np
import pytest

from rigwake.handeye.joint_calibration import calibrate_handeye

BENCHMARK = runpy.run_path(str(Path(__file__).parent.parent / "benchmarks" / "handeye_real.py"))


@pytest.fixture(scope="module")
def devices(real_recordings):
    return BENCHMARK["tango_trajectories"](real_recordings)


def test_three_pairwise_results_close_the_loop(devices):
    degrees, millimetres, clock_ms = BENCHMARK["pairwise_loop"](devices)
    assert degrees <= 0.015
    # one device's rate of turning is up to 1.3 % off: over arms of 0.5 to 1.4 m that leaves some mm
    assert millimetres < 3.0
    assert abs(clock_ms) < 1.0


@pytest.mark.parametrize(
    "names", [("caligula", "mars"), ("caligula", "nero"), ("mars", "nero")], ids="-".join
)
def test_halves_agree_within_the_printed_deviations(devices, names):
    agree = BENCHMARK["compare_halves"](devices[names[0]], [devices[names[1]]])
    assert np.abs(agree.sigmas[names[1]]).max() < 3.0
    assert abs(agree.clock_ms[names[1]]) < 5.0


def test_joint_solve_agrees_with_pairs(devices):
    joint = calibrate_handeye(devices["caligula"], [devices["mars"], devices["nero"]])
    for name in ("mars", "nero"):
        alone = calibrate_handeye(devices["caligula"], [devices[name]])
        difference = alone.ref_from_members[name].local(joint.ref_from_members[name])
        assert np.abs(difference / np.sqrt(np.diag(alone.members[name].covariance))).max() < 3


@pytest.mark.slow
def test_cameras_before_a_board_without_using_that_they_share_it(real_recordings):
    learnt = BENCHMARK["check_euroc"](real_recordings, None, pnp_covariances=False)
    assert learnt.from_direct[0] <= 0.06
    assert learnt.from_direct[1] <= 1.0
    known_fraction = BENCHMARK["check_euroc"](real_recordings, "poses", pnp_covariances=True)
    assert known_fraction.from_published[0] < 0.05
    assert known_fraction.from_published[1] < 0.5
    assert abs(known_fraction.clock_ms) < 0.1


@pytest.mark.slow
def test_odometries_of_different_sensors_err_by_what_they_say(real_recordings):
    folder = real_recordings / "handeye_real"
    within = np.array(
        [
            np.abs(error) <= 3 * std
            for name in BENCHMARK["PAIRS"]
            for error, std in BENCHMARK["pair_errors"](folder, name)
        ]
    )
    assert within[:, :3].mean() >= 0.95
    # 95 % of the translations are not reached: heights along a road, and one LiDAR whose frame may be another
    assert within[:, 3:].mean() >= 0.8
    error_mm, _, noise = BENCHMARK["starry_errors"](folder)
    assert "poses" in noise  # they do not drift, though their errors last for seconds
    assert np.abs(error_mm).max() <= 20
