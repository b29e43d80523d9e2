"""Trajectory files of other tools: every order of columns, unit of time and form of number gives the same motion."""

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from rigwake.errors import TrajectoryError, UsageError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.readers.held_positions import without_held_positions
from rigwake.readers.trajectories import read_trajectory
from rigwake.readers.trajectory_frames import in_house_frames
from rigwake.trajectory import Trajectory

COUNT = 120
START_NS = 1_700_000_000_000_000_000
STAMPS = START_NS + 100_000_000 * np.arange(COUNT)


def motion() -> SE3:
    """A boat that turns left and right at 2 m/s while it rolls, x to the bow; as a camera that looks to port."""
    t = np.arange(COUNT) * 0.1
    heading = 1.5 * np.sin(0.5 * t)
    roll = 0.1 * np.sin(1.7 * t)
    turn = so3.exp(np.outer(heading, [0, 0, 1])) @ so3.exp(np.outer(roll, [1, 0, 0]))
    steps = 0.2 * np.stack([np.cos(heading), np.sin(heading), 0.02 * np.cos(t)], axis=1)
    mounting = so3.exp(np.array([-1.2, 0.4, 0.7]))
    return SE3(turn @ mounting, np.cumsum(steps, axis=0))


POSES = motion()
XYZ, WXYZ = POSES.translation, POSES.quat_wxyz
XYZW = np.roll(WXYZ, -1, axis=1)
MATRIX = POSES.matrix[:, :3].reshape(-1, 12)


def lines(*columns: object, separator: str = " ", end: str = "", form: str = ".9f") -> str:
    """Rows of stamps (lists of text) and arrays of numbers."""
    rows = []
    for at in range(COUNT):
        cells = []
        for column in columns:
            value = column[at]  # type: ignore[index]
            cells += [value] if isinstance(value, str) else [f"{x:{form}}" for x in np.atleast_1d(value)]
        rows.append(separator.join(cells) + end)
    return "\n".join(rows) + "\n"


def stamps(form: Callable[[int], str]) -> list[str]:
    return [form(int(t)) for t in STAMPS]


SECONDS = stamps(lambda t: f"{t // 10**9}.{t % 10**9:09d}")
UNITS = {
    "s": SECONDS,
    "s of TUM": stamps(lambda t: f"{t / 1e9:.4f}"),
    "ms": stamps(lambda t: f"{t // 10**6}"),
    "ms with a point": stamps(lambda t: f"{t / 1e6:.3f}"),
    "us": stamps(lambda t: f"{t // 1000}"),
    "ns": stamps(str),
    "ns.000000 of ORB-SLAM3": stamps(lambda t: f"{t}.000000"),
    "ns of savetxt": stamps(lambda t: f"{float(t):.18e}"),
    "s of savetxt": stamps(lambda t: f"{t / 1e9:.18e}"),
    "us of savetxt": stamps(lambda t: f"{t / 1e3:.18e}"),
}
RELATIVE = {
    "s": stamps(lambda t: f"{(t - START_NS) / 1e9:.3f}"),
    "ms": stamps(lambda t: f"{(t - START_NS) // 10**6}"),
    "us": stamps(lambda t: f"{(t - START_NS) // 1000}"),
    "ns": stamps(lambda t: f"{t - START_NS}"),
}


def same_motion(path: Path, text: str, tolerance_ns: float = 1000.0, **options: str) -> list[str]:
    """Asserts that the file holds the motion (stamps as a whole may be shifted); returns what was said."""
    path.write_text(text, encoding="utf-8")
    file = read_trajectory(path, **options)
    read = file.trajectory
    assert len(read) == COUNT
    since_start = read.timestamps_ns - read.timestamps_ns[0]
    assert np.abs(since_start - (STAMPS - STAMPS[0])).max() <= tolerance_ns
    np.testing.assert_allclose(read.world_from_body.rotation, POSES.rotation, atol=2e-5)
    np.testing.assert_allclose(read.world_from_body.translation, POSES.translation, atol=2e-5)
    return [finding.message for finding in file.findings]


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("separator", [" ", "\t", ";"])
def test_stamps_of_any_unit_without_a_header(tmp_path: Path, unit: str, separator: str) -> None:
    text = lines(UNITS[unit], XYZ, XYZW, separator=separator)
    assert same_motion(tmp_path / "a.txt", text, 200_000 if unit == "s of TUM" else 1000) == []
    assert abs(int(read_trajectory(tmp_path / "a.txt").trajectory.timestamps_ns[0]) - START_NS) < 200_000


@pytest.mark.parametrize("unit", RELATIVE)
@pytest.mark.parametrize("period_ms", [5, 33, 100, 1000])
def test_stamps_since_the_start(tmp_path: Path, unit: str, period_ms: int) -> None:
    factor = {"s": 1e-3, "ms": 1, "us": 1e3, "ns": 1e6}[unit]
    form = (lambda v: f"{v:.3f}") if unit == "s" else (lambda v: f"{v:.0f}")
    text = lines([form(k * period_ms * factor) for k in range(COUNT)], XYZ, XYZW)
    (tmp_path / "a.txt").write_text(text)
    read = read_trajectory(tmp_path / "a.txt").trajectory
    assert np.median(np.diff(read.timestamps_ns)) == period_ms * 10**6


HEADERS = {
    "w first": ("timestamp tx ty tz qw qx qy qz", (XYZ, WXYZ)),
    "w last": ("timestamp tx ty tz qx qy qz qw", (XYZ, XYZW)),
    "rotation first": ("t qx qy qz qw x y z", (XYZW, XYZ)),
    "underscores": ("time_s p_x p_y p_z q_w q_x q_y q_z", (XYZ, WXYZ)),
    "evo": ("timestamp x y z q_x q_y q_z q_w", (XYZ, XYZW)),
    "okvis": ("timestamp p_WS_W_x p_WS_W_y p_WS_W_z q_WS_x q_WS_y q_WS_z q_WS_w", (XYZ, XYZW)),
    "plotjuggler": (
        "__time /o/pose/position/x /o/pose/position/y /o/pose/position/z "
        "/o/pose/orientation/x /o/pose/orientation/y /o/pose/orientation/z /o/pose/orientation/w",
        (XYZ, XYZW),
    ),
    "px4": ("timestamp position[0] position[1] position[2] q[0] q[1] q[2] q[3]", (XYZ, WXYZ)),
    "matrix": ("t r11 r12 r13 r21 r22 r23 r31 r32 r33 x y z", (POSES.rotation.reshape(-1, 9), XYZ)),
}


@pytest.mark.parametrize("header", HEADERS)
@pytest.mark.parametrize("lead", ["# ", "#", "% ", "%", "", "// "])
@pytest.mark.parametrize("separator", [" ", ",", "; "])
def test_headers_say_the_order_commented_or_not(
    tmp_path: Path, header: str, lead: str, separator: str
) -> None:
    names, columns = HEADERS[header]
    text = "# made by a tool\n" + lead + names.replace(" ", separator) + "\n"
    assert same_motion(tmp_path / "a.csv", text + lines(SECONDS, *columns, separator=separator)) == []


def test_units_of_a_header_and_columns_of_no_use(tmp_path: Path) -> None:
    extra = np.random.default_rng(0).normal(size=(COUNT, 3))
    header = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],"
    header += "v_RS_R_z [m s^-1],q_RS_x [],q_RS_y [],q_RS_z [],q_RS_w []\n"
    assert same_motion(tmp_path / "a.csv", header + lines(UNITS["ns"], XYZ, extra, XYZW, separator=",")) == []
    header = "time [ms],x [mm],y [mm],z [mm],qw,qx,qy,qz\n"
    assert same_motion(tmp_path / "b.csv", header + lines(UNITS["ms"], 1e3 * XYZ, WXYZ, separator=",")) == []
    header = "header.stamp.sec,header.stamp.nanosec,x,y,z,qx,qy,qz,qw\n"
    parts = stamps(lambda t: str(t // 10**9)), stamps(lambda t: str(t % 10**9))
    assert same_motion(tmp_path / "c.csv", header + lines(*parts, XYZ, XYZW, separator=",")) == []
    wrong = "time [s],x,y,z,qw,qx,qy,qz\n" + lines(UNITS["ns"], XYZ, WXYZ, separator=",")
    assert "size of ns" in same_motion(tmp_path / "d.csv", wrong)[0]


DATES = stamps(
    lambda t: datetime.fromtimestamp(t // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%S") + f".{t % 10**9:09d}Z"
)
OTHERS = {
    "OpenVINS": "# timestamp(s) tx ty tz qx qy qz qw Pr11 Pr12\n"
    + lines(SECONDS, XYZ, XYZW, np.ones((COUNT, 2))),
    "VINS-Fusion": lines(UNITS["ns"], XYZ, WXYZ, np.ones((COUNT, 3)), separator=",", end=","),
    "VINS-Mono loop": lines(UNITS["ns"], XYZ, WXYZ, separator=",", end=","),
    "EuRoC truth": lines(UNITS["ns"], XYZ, WXYZ, np.full((COUNT, 9), 0.1), separator=","),
    "rostopic echo -p": "%time,field.header.seq,field.header.stamp,field.header.frame_id,"
    + ",".join(f"field.pose.pose.position.{a}" for a in "xyz")
    + ","
    + ",".join(f"field.pose.pose.orientation.{a}" for a in "xyzw")
    + ",field.twist.twist.linear.x\n"
    + lines(
        stamps(lambda t: str(t + 5_000_000)),
        [str(k) for k in range(COUNT)],
        UNITS["ns"],
        ["odom"] * COUNT,
        XYZ,
        XYZW,
        np.ones(COUNT),
        separator=",",
    ),
    "ros2 topic echo --csv": lines(
        stamps(lambda t: str(t // 10**9)),
        stamps(lambda t: str(t % 10**9)),
        ["map"] * COUNT,
        XYZ,
        XYZW,
        separator=",",
    ),
    "index and TUM": lines([str(k) for k in range(COUNT)], SECONDS, XYZ, XYZW),
    "stamp and 3 x 4": lines(SECONDS, MATRIX),
    "stamp and 4 x 4": lines(SECONDS, MATRIX, np.tile([0.0, 0, 0, 1], (COUNT, 1))),
    "index and 3 x 4": lines([str(k) for k in range(COUNT)], MATRIX),
    "3 x 4": lines(MATRIX),
    "4 x 4": lines(MATRIX, np.tile([0.0, 0, 0, 1], (COUNT, 1))),
    "no stamps": lines(XYZ, XYZW),
    "decimal commas": "t;x;y;z;qw;qx;qy;qz\n" + lines(SECONDS, XYZ, WXYZ, separator=";").replace(".", ","),
    "decimal commas between spaces": lines(SECONDS, XYZ, XYZW).replace(".", ","),
    "dates": "time,x,y,z,qx,qy,qz,qw\n" + lines(DATES, XYZ, XYZW, separator=","),
    "dates with a space and no zone": "time;x;y;z;qx;qy;qz;qw\n"
    + lines([d.replace("T", " ").rstrip("Z") for d in DATES], XYZ, XYZW, separator=";"),
    "dates of another zone": "time,x,y,z,qx,qy,qz,qw\n"
    + lines([d.replace("Z", "+00:00") for d in DATES], XYZ, XYZW, separator=","),
    "i j k real": "timestamp,pose_x,pose_y,pose_z,rotation_i,rotation_j,rotation_k,rotation_real\n"
    + lines(SECONDS, XYZ, XYZW, separator=","),
    "Open3D, four lines each": "".join(
        f"{k} {k} {k + 1}\n" + "\n".join(" ".join(f"{x:.9f}" for x in row) for row in m) + "\n"
        for k, m in enumerate(POSES.matrix)
    ),
    "exponents": lines(SECONDS, XYZ, XYZW, form=".12e"),
}


@pytest.mark.parametrize("tool", OTHERS)
def test_columns_of_other_tools(tmp_path: Path, tool: str) -> None:
    said = same_motion(tmp_path / "a.txt", OTHERS[tool])
    without_times = tool in ("index and 3 x 4", "3 x 4", "4 x 4", "no stamps")
    without_times |= tool.startswith("Open3D")
    assert [("10 Hz" in message) for message in said] == [True] * without_times


def test_the_text_may_be_utf_16_or_hold_a_byte_order_mark(tmp_path: Path) -> None:
    text = "# timestamp tx ty tz qx qy qz qw\n" + lines(SECONDS, XYZ, XYZW)
    for encoding in ("utf-16", "utf-8-sig"):
        (tmp_path / "a.txt").write_text(text, encoding=encoding)
        assert len(read_trajectory(tmp_path / "a.txt").trajectory) == COUNT
    (tmp_path / "a.txt").write_bytes(("# angles in °\n" + text).encode("latin-1"))
    assert len(read_trajectory(tmp_path / "a.txt").trajectory) == COUNT


@pytest.mark.parametrize("separator", [",", " "])
def test_the_motion_tells_the_order_where_the_dialect_is_wrong(tmp_path: Path, separator: str) -> None:
    """Nanoseconds and commas are qw first, all else qw last: a file against that is read by its motion, and said."""
    against = XYZW if separator == "," else WXYZ
    said = same_motion(tmp_path / "a.txt", lines(UNITS["ns"], XYZ, against, separator=separator))
    assert "qw is taken to stand" in said[0]
    order = "t x y z qx qy qz qw" if separator == "," else "t,x,y,z,qw,qx,qy,qz"
    assert (
        same_motion(tmp_path / "a.txt", lines(UNITS["ns"], XYZ, against, separator=separator), columns=order)
        == []
    )


def test_columns_named_by_the_user(tmp_path: Path) -> None:
    text = lines(SECONDS, np.ones(COUNT), WXYZ, XYZ)
    assert same_motion(tmp_path / "a.txt", text, columns="t _ qw qx qy qz x y z") == []
    with pytest.raises(TrajectoryError, match="0 columns for qz"):
        read_trajectory(tmp_path / "a.txt", columns="t _ qw qx qy x y z")
    with pytest.raises(TrajectoryError, match="rows have 9"):
        read_trajectory(tmp_path / "a.txt", columns="t _ _ qw qx qy qz x y z")


def test_roll_pitch_yaw_need_a_unit(tmp_path: Path) -> None:
    R = POSES.rotation
    pitch = -np.arcsin(R[:, 2, 0])
    roll, yaw = np.arctan2(R[:, 2, 1], R[:, 2, 2]), np.arctan2(R[:, 1, 0], R[:, 0, 0])
    angles = np.stack([roll, pitch, yaw], axis=1)
    for unit, values in (("deg", np.degrees(angles)), ("rad", angles)):
        header = f"t,x,y,z,roll_{unit},pitch_{unit},yaw_{unit}\n"
        assert same_motion(tmp_path / "a.csv", header + lines(SECONDS, XYZ, values, separator=",")) == []
    header = "t,x,y,z,roll,pitch,yaw\n"
    same_motion(tmp_path / "b.csv", header + lines(SECONDS, XYZ, np.degrees(angles), separator=","))
    (tmp_path / "c.csv").write_text(header + lines(SECONDS, XYZ, angles, separator=","))
    with pytest.raises(TrajectoryError, match="radians or degrees"):
        read_trajectory(tmp_path / "c.csv")


@pytest.mark.parametrize(
    "bad", ["0 0 0 0 0 0 0", "1 2 3 0 0 0 0", "nan nan nan nan nan nan nan", "1 2 3 0 0 0 inf"]
)
@pytest.mark.parametrize("where", [slice(0, 20), slice(50, 70), slice(20, 110)])
def test_rows_without_a_pose_are_left_out_and_said(tmp_path: Path, bad: str, where: slice) -> None:
    rows = lines(SECONDS, XYZ, XYZW).splitlines()
    for at in range(COUNT)[where]:
        rows[at] = f"{SECONDS[at]} {bad}"
    (tmp_path / "a.txt").write_text("\n".join(rows))
    file = read_trajectory(tmp_path / "a.txt")
    lost = len(range(COUNT)[where])
    assert len(file.trajectory) == COUNT - lost
    (message,) = [finding.message for finding in file.findings]
    assert message.startswith(f"{lost} rows")
    assert ("longest gap is 9.1 s" in message) == (lost > COUNT / 2)


@pytest.mark.parametrize("repeats", [2, 3, 5])
def test_held_positions_are_found(repeats: int) -> None:
    held = SE3(POSES.rotation, POSES.translation[np.arange(COUNT) // repeats * repeats])
    thinned, findings = without_held_positions(Trajectory("ins", STAMPS, held))
    assert len(thinned) == COUNT // repeats
    np.testing.assert_array_equal(thinned.world_from_body.translation, POSES.translation[::repeats])
    assert f"{COUNT - COUNT // repeats} of {COUNT} positions" in findings[0].message


def test_a_body_at_rest_holds_no_positions() -> None:
    at_rest = np.where(np.arange(COUNT)[:, None] < 60, POSES.translation[:1], POSES.translation)
    resting = Trajectory("ins", STAMPS, SE3(POSES.rotation, at_rest))
    assert without_held_positions(resting) == (resting, ())
    moving = Trajectory("ins", STAMPS, POSES)
    assert without_held_positions(moving) == (moving, ())


def test_frames_are_turned_into_ours() -> None:
    enu = Trajectory("a", STAMPS, POSES)
    inverse = Trajectory("a", STAMPS, POSES.inverse())
    mirror = np.diag([1.0, -1.0, 1.0])
    left = Trajectory("a", STAMPS, SE3(mirror @ POSES.rotation @ mirror, POSES.translation @ mirror))
    ned_from_enu = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    frd_from_flu = np.diag([1.0, -1, -1])
    ned_poses = SE3(ned_from_enu @ POSES.rotation @ frd_from_flu.T, POSES.translation @ ned_from_enu.T)
    ned = Trajectory("a", STAMPS, ned_poses)
    for written, meaning in ((enu, "enu"), (inverse, "inverse"), (left, "left-handed"), (ned, "ned")):
        turned = in_house_frames(written, meaning)
        np.testing.assert_allclose(turned.world_from_body.matrix, POSES.matrix, atol=1e-12)
    with pytest.raises(UsageError, match="unknown"):
        in_house_frames(enu, "nwu")


def test_mirrored_matrices_are_named(tmp_path: Path) -> None:
    mirrored = (POSES.matrix[:, :3] * np.array([1.0, 1.0, -1.0, 1.0])).reshape(-1, 12)
    (tmp_path / "a.txt").write_text(lines(mirrored))
    with pytest.raises(TrajectoryError, match="mirrored"):
        read_trajectory(tmp_path / "a.txt")


@pytest.mark.parametrize(
    ("cell", "message"),
    [("nan", "no covariance"), ("-1", "no covariance"), ("1e300", "no covariance"), ("x", "line 3")],
)
def test_covariances_beside_a_file_must_be_some(tmp_path: Path, cell: str, message: str) -> None:
    (tmp_path / "a.tum").write_text(lines(SECONDS, XYZ, XYZW))
    good = ["1" if i == j else "0" for i in range(6) for j in range(i, 6)]
    rows = [",".join([str(t), "0", *good]) for t in STAMPS]
    rows[2] = ",".join([str(STAMPS[2]), "0", cell, *good[1:]])
    (tmp_path / "a.cov.csv").write_text("\n".join(rows))
    with pytest.raises(TrajectoryError, match=message):
        read_trajectory(tmp_path / "a.tum")
