import gzip
from pathlib import Path

import numpy as np
import pytest

from rigwake.errors import InputError, TrajectoryError
from rigwake.geometry.se3 import SE3
from rigwake.readers.trajectories import read_trajectory
from rigwake.trajectory import Trajectory
from rigwake.writers.trajectory_writer import write_tum

ROWS = [f"{1000 + i}.5 {i} 0 0 0 0 0 1" for i in range(5)]


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def random_trajectory(n: int = 20, **fields) -> Trajectory:
    rng = np.random.default_rng(3)
    stamps = 1_404_733_405_732_800_001 + np.cumsum(rng.integers(1, 10**9, n))
    return Trajectory("front", stamps, SE3.exp(rng.normal(size=(n, 6))), **fields)


def test_tum_round_trip_is_exact_in_time(tmp_path: Path) -> None:
    L = np.random.default_rng(0).normal(size=(20, 6, 6))
    written = random_trajectory(
        covariances=L @ np.swapaxes(L, 1, 2),
        covariance_kind="poses",
        is_metric=False,
        segment_ids=np.repeat([0, 1], 10),
    )
    write_tum(written, tmp_path / "front.tum")
    file = read_trajectory(tmp_path / "front.tum")
    read = file.trajectory
    assert file.format == "tum"
    assert file.findings == ()
    np.testing.assert_array_equal(read.timestamps_ns, written.timestamps_ns)
    np.testing.assert_allclose(read.world_from_body.matrix, written.world_from_body.matrix, atol=1e-10)
    np.testing.assert_allclose(read.covariances, written.covariances, rtol=1e-8)
    np.testing.assert_array_equal(read.segment_ids, written.segment_ids)
    assert (read.name, read.covariance_kind, read.is_metric) == ("front", "poses", False)


def test_segments_without_covariances_survive(tmp_path: Path) -> None:
    write_tum(random_trajectory(segment_ids=np.repeat([0, 3], 10)), tmp_path / "a.tum")
    read = read_trajectory(tmp_path / "a.tum").trajectory
    assert read.covariances is None
    assert list(np.unique(read.segment_ids)) == [0, 3]
    write_tum(random_trajectory(), tmp_path / "a.tum")
    assert not (tmp_path / "a.cov.csv").exists()


def test_sidecar_of_another_file_is_ignored_and_reported(tmp_path: Path) -> None:
    write_tum(random_trajectory(segment_ids=np.repeat([0, 3], 10)), tmp_path / "a.tum")
    write(tmp_path / "a.tum", "\n".join(ROWS))
    file = read_trajectory(tmp_path / "a.tum")
    assert file.trajectory.covariances is None
    assert "a.cov.csv ignored" in file.findings[0].message


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("\n".join(ROWS), "tum"),
        ("\n".join(row.replace(" ", ", ") for row in ROWS), "tum"),
        ("# a comment\n\n" + "\n".join(ROWS), "tum"),
        ("\n".join("1 0 0 0 0 1 0 0 0 0 1 0" for _ in ROWS), "kitti"),
        ("\n".join(f"14047334057328000{i:02},0,0,0,1,0,0,0" for i in range(5)), "euroc"),
        ("t,qx,qy,qz,qw,x,y,z\n" + "\n".join(f"{i},0,0,0,1,{i},0,0" for i in range(5)), "csv"),
        ("timestamp_ns;tx;ty;tz;qw;qx;qy;qz\n" + "\n".join(f"{i};0;0;0;1;0;0;0" for i in range(5)), "csv"),
    ],
)
def test_formats_are_sniffed(tmp_path: Path, text: str, expected: str) -> None:
    file = read_trajectory(write(tmp_path / "some.txt", text))
    assert file.format == expected
    assert len(file.trajectory) == 5


def test_csv_units_and_columns(tmp_path: Path) -> None:
    seconds = "time [s],x,y,z,qw,qx,qy,qz,extra\n0.25,1,2,3,0,1,0,0,9\n0.5,1,2,3,0,1,0,0,9\n"
    read = read_trajectory(write(tmp_path / "a.csv", seconds)).trajectory
    np.testing.assert_array_equal(read.timestamps_ns, [250_000_000, 500_000_000])
    np.testing.assert_allclose(read.world_from_body.translation[0], [1, 2, 3])
    np.testing.assert_allclose(read.world_from_body.rotation[0], np.diag([1, -1, -1]), atol=1e-15)
    nanoseconds = (
        "time,x,y,z,qw,qx,qy,qz\n1404733405732800001,1,2,3,1,0,0,0\n1404733405732800002,1,2,3,1,0,0,0\n"
    )
    read = read_trajectory(write(tmp_path / "b.csv", nanoseconds)).trajectory
    assert read.timestamps_ns[0] == 1404733405732800001


def test_kitti_times(tmp_path: Path) -> None:
    poses = write(tmp_path / "poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    nominal = read_trajectory(poses)
    assert "nominal" in nominal.findings[0].message
    write(tmp_path / "times.txt", "0.0\n1.25\n2.5\n")
    read = read_trajectory(poses)
    assert read.findings == ()
    np.testing.assert_array_equal(read.trajectory.timestamps_ns, [0, 1_250_000_000, 2_500_000_000])
    with pytest.raises(TrajectoryError, match="2 stamps"):
        read_trajectory(poses, times=write(tmp_path / "other.txt", "0\n1\n"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no poses"),
        ("# only a comment\n", "holds no poses"),
        (ROWS[0], "1 usable pose"),
        ("\n".join([ROWS[0], ROWS[0]]), "1 usable pose"),
        ("\n".join([*ROWS, "1006.5 1 2 3"]), "line 6: 4 columns where 8"),
        ("\n".join([*ROWS, "1006.5 1 2 3 a 0 0 1"]), "line 6: not a number"),
        ("\n".join([*ROWS, "1006.5 1 2 3 0 0 0 0.5"]), "line 6: a quaternion of norm 0.5"),
        ("\n".join([*ROWS, "1006.5 1 2 3 0 0 0 2"]), "line 6: a quaternion of norm 2"),
        ("\n".join([ROWS[0], *["1 nan 0 0 0 0 0 1"] * 3]), "most rows"),
        ("1 2 3\n4 5 6", "3 columns fit no known"),
        ("a,b,c\n1,2,3", "0 columns for stamp"),
        ("t,x,y,z,qw,qx,qy,qz", "header but no poses"),
        ("t,x,x,y,z,qw,qx,qy,qz\n1,1,1,1,1,1,0,0,0", "2 columns for x"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1", "line 2: 11 columns where KITTI has 12"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n2 0 0 0 0 1 0 0 0 0 1 0", "line 2: the 3 x 3 block"),
        ("1e400 0 0 0 0 0 0 1\n2e400 0 0 0 0 0 0 1", "NaN or infinite"),
        ("1e30 0 0 0 0 0 0 1\n2e30 0 0 0 0 0 0 1", "64 bits"),
    ],
)
def test_broken_files_are_named_with_their_line(tmp_path: Path, text: str, message: str) -> None:
    path = write(tmp_path / "broken.tum", text)
    with pytest.raises(TrajectoryError, match=message) as caught:
        read_trajectory(path)
    assert "broken.tum" in str(caught.value)


def test_missing_and_binary_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no file"):
        read_trajectory(tmp_path / "nothing.tum")
    (tmp_path / "binary.tum").write_bytes(gzip.compress(b"\xff" * 100))
    with pytest.raises(TrajectoryError, match="not a readable text file"):
        read_trajectory(tmp_path / "binary.tum")


def test_what_can_be_repaired_is_repaired_and_reported(tmp_path: Path) -> None:
    rows = [ROWS[2], ROWS[0], ROWS[1], ROWS[1], "1009.5 nan 0 0 0 0 0 1", "1010.5 5 0 0 0 0 0 1.05"]
    file = read_trajectory(write(tmp_path / "a.tum", "\n".join(rows)))
    np.testing.assert_array_equal(
        file.trajectory.timestamps_ns, np.array([1000.5, 1001.5, 1002.5, 1010.5]) * 1e9
    )
    messages = " | ".join(finding.message for finding in file.findings)
    for words in ("lines 5", "1 quaternions", "went back 1 times", "1 duplicate"):
        assert words in messages


def test_real_files(real_recordings: Path) -> None:
    tango = sorted((real_recordings / "tango_triplet").rglob("*.csv"))
    assert len(tango) == 3
    for path in tango:
        file = read_trajectory(path)
        assert file.format == "tum"
        assert 2350 < len(file.trajectory) < 2800
        assert 60 < file.trajectory.duration_s < 90
    truth = read_trajectory(real_recordings / "euroc_v101_micro/GT/V1_01_easy.csv")
    assert truth.format == "euroc"
    assert truth.trajectory.timestamps_ns[0] == 1403715273262142976
    kitti = read_trajectory(real_recordings / "kitti_odometry/gt_poses/03.txt")
    assert (kitti.format, len(kitti.trajectory)) == ("kitti", 801)
    assert read_trajectory(real_recordings / "harbour_a/truth_base.tum").format == "tum"
