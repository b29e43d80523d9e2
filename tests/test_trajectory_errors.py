"""ATE, RPE and KITTI errors, against evo run as a program of its own."""

import json
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from rigwake.errors import InputError
from rigwake.evaluation.trajectory_errors import absolute_error, kitti_error, relative_error
from rigwake.geometry.se3 import SE3
from rigwake.readers.trajectories import read_trajectory
from rigwake.trajectory import Trajectory
from rigwake.writers.trajectory_writer import write_tum


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Trajectory, Trajectory]:
    """A winding truth and a drifting, scaled, noisy estimate of it, also as files."""
    folder = tmp_path_factory.mktemp("pair")
    rng = np.random.default_rng(0)
    step = np.concatenate([rng.normal(0, 0.02, (400, 3)), np.tile([1.0, 0, 0], (400, 1))], axis=1)
    noisy = step + rng.normal(0, 0.003, step.shape)
    trajectories = []
    for name, steps, scale in (("truth", step, 1.0), ("estimate", noisy, 1.3)):
        poses = [SE3.identity()]
        for increment in steps:
            poses.append(poses[-1].retract(increment * [1, 1, 1, scale, scale, scale]))
        matrices = np.stack([p.matrix for p in poses])
        trajectories.append(Trajectory(name, np.arange(401) * 10**8, SE3.from_matrix(matrices)))
        write_tum(trajectories[-1], folder / f"{name}.tum")
    return folder / "truth.tum", folder / "estimate.tum", *trajectories


def evo(program: str, *arguments: str | Path, home: Path) -> dict[str, float]:
    result = home / "result.zip"
    result.unlink(missing_ok=True)
    command = [
        str(Path(sys.executable).parent / program),
        *map(str, arguments),
        "--save_results",
        str(result),
    ]
    environment = {"HOME": str(home), "PATH": "/usr/bin:/bin"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    with zipfile.ZipFile(result) as archive:
        return json.loads(archive.read("stats.json"))


@pytest.mark.slow
@pytest.mark.parametrize(("flags", "kind"), [([], None), (["-a"], "se3"), (["-as"], "sim3")])
def test_ate_agrees_with_evo(pair, tmp_path: Path, flags: list[str], kind: str | None) -> None:
    truth_path, estimate_path, truth, estimate = pair
    theirs = evo("evo_ape", "tum", truth_path, estimate_path, *flags, home=tmp_path)
    ours = absolute_error(truth, estimate, alignment=kind)
    for mine, name in (
        (ours.rmse_m, "rmse"),
        (ours.mean_m, "mean"),
        (ours.median_m, "median"),
        (ours.max_m, "max"),
    ):
        assert mine == pytest.approx(theirs[name], rel=1e-6)
    angles = evo("evo_ape", "tum", truth_path, estimate_path, *flags, "-r", "angle_deg", home=tmp_path)
    assert ours.rotation_rmse_deg == pytest.approx(angles["rmse"], rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("step", [1, 10])
def test_rpe_agrees_with_evo(pair, tmp_path: Path, step: int) -> None:
    truth_path, estimate_path, truth, estimate = pair
    flags = ("-d", str(step), "-u", "f", "--all_pairs")
    theirs = evo("evo_rpe", "tum", truth_path, estimate_path, *flags, home=tmp_path)
    ours = relative_error(truth, estimate, step=step)
    assert ours.rmse_m == pytest.approx(theirs["rmse"], rel=1e-6)
    angles = evo("evo_rpe", "tum", truth_path, estimate_path, *flags, "-r", "angle_deg", home=tmp_path)
    assert ours.rotation_rmse_deg == pytest.approx(angles["rmse"], rel=1e-5)


def test_the_scale_is_found_and_a_copy_has_no_error(pair) -> None:
    _, _, truth, estimate = pair
    assert absolute_error(truth, estimate, alignment="sim3").scale == pytest.approx(1 / 1.3, rel=0.05)
    same = absolute_error(truth, truth)
    assert same.rmse_m < 1e-9
    assert same.rotation_rmse_deg < 1e-5


def test_kitti_error_of_a_stretched_copy(real_recordings: Path) -> None:
    truth = read_trajectory(real_recordings / "kitti_odometry/gt_poses/09.txt").trajectory
    stretched = Trajectory(
        "stretched",
        truth.timestamps_ns,
        SE3(truth.world_from_body.rotation, 1.02 * truth.world_from_body.translation),
    )
    found = kitti_error(truth, stretched)
    assert found.r_rel_deg_per_100m < 1e-5
    # the straight-line distance between the ends of a sub-sequence is at most its length
    assert 1.0 < found.t_rel_percent <= 2.03
    assert found.sequences > 500


def test_nothing_in_common_is_refused(pair) -> None:
    _, _, truth, estimate = pair
    shifted = Trajectory("late", estimate.timestamps_ns + 10**12, estimate.world_from_body)
    with pytest.raises(InputError, match="same clock"):
        absolute_error(truth, shifted)
    with pytest.raises(InputError, match="shorter"):
        kitti_error(truth.take(slice(0, 50)), estimate.take(slice(0, 50)))
