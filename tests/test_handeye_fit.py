"""Hand-eye is refused where the trajectories cannot be one rigid body, with the reason; good ones are not."""

import json
from dataclasses import replace

import numpy as np
import pytest

from handeye_scenes import PORT, drifting, planar, straight, trajectory, wavy
from rigwake.cli.main import main
from rigwake.errors import RigwakeError
from rigwake.geometry.se3 import SE3
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.plausibility.handeye_fit import check_handeye, explain_failure
from rigwake.plausibility.values import SensorCheck, refuse
from rigwake.trajectory import Trajectory

TIMES = np.arange(400) * 0.1
FLIP = np.diag([1.0, -1.0, 1.0])


def pair(motion=wavy) -> tuple[Trajectory, Trajectory]:
    rng = np.random.default_rng(0)
    poses = (drifting(p, 1e-3, 5e-3, rng) for p in (motion(TIMES), motion(TIMES) * PORT))
    rig, port = (trajectory(n, p, TIMES) for n, p in zip(("rig", "port"), poses, strict=True))
    return rig, port


def checked(rig: Trajectory, port: Trajectory) -> SensorCheck:
    return check_handeye(rig, [port], calibrate_handeye(rig, [port]))[0]


@pytest.mark.parametrize("motion", [wavy, planar, straight])
def test_good_pairs_agree(motion) -> None:
    check = checked(*pair(motion))
    assert check.agrees
    assert check.statistic < 0.06


WRONGS = {
    "inverse": lambda p: p.inverse(),
    "in another order": lambda p: SE3.from_quat_wxyz(p.quat_wxyz[:, [1, 2, 3, 0]], p.translation),
    "left-handed": lambda p: SE3(FLIP @ p.rotation @ FLIP, p.translation @ FLIP),
    "in a left-handed world": lambda p: SE3(p.rotation, p.translation @ FLIP),
    "millimetres": lambda p: SE3(p.rotation, 1e3 * p.translation),
}


@pytest.mark.parametrize("name", WRONGS)
def test_what_people_confuse_is_named(name: str) -> None:
    rig, port = pair()
    wrong = replace(port, world_from_body=WRONGS[name](port.world_from_body))
    try:
        check = checked(rig, wrong)
        said = "" if check.agrees else check.hypothesis
    except RigwakeError as error:  # refused already; what is said of it names the cause all the same
        said = str(explain_failure(rig, [wrong], error))
    assert name in said


def test_unrelated_trajectories_are_no_rig() -> None:
    rig, _ = pair()
    other = trajectory("port", wavy(1.37 * TIMES + 11) * PORT, TIMES)
    with pytest.raises(RigwakeError) as raised:
        refuse((checked(rig, other),))
    assert "nothing to do with" in str(explain_failure(rig, [other], raised.value)) or "left" in str(
        raised.value
    )


def test_the_command_refuses_and_says_why(tmp_path, monkeypatch, capsys) -> None:
    files = []
    for name, poses in (("rig", wavy(TIMES)), ("port", (wavy(TIMES) * PORT).inverse())):
        q = poses.quat_wxyz
        rows = np.column_stack([TIMES, poses.translation, q[:, 1:], q[:, 0]])
        np.savetxt(tmp_path / f"{name}.tum", rows, fmt="%.9f")
        files.append(str(tmp_path / f"{name}.tum"))
    monkeypatch.setattr("sys.argv", ["rigwake", "handeye", *files, "-o", str(tmp_path / "c.yaml")])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    assert "inverse" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "c.yaml").exists()
    good = tmp_path / "good.tum"
    poses = wavy(TIMES) * PORT
    np.savetxt(
        good, np.column_stack([TIMES, poses.translation, poses.quat_wxyz[:, [1, 2, 3, 0]]]), fmt="%.9f"
    )
    monkeypatch.setattr(
        "sys.argv", ["rigwake", "handeye", files[0], str(good), "--json", str(tmp_path / "o.json")]
    )
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    assert json.loads((tmp_path / "o.json").read_text())["sensor_checks"][0]["agrees"]
