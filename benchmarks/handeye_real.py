"""Hand-eye on real data: three devices without shared view, and a stereo camera whose answer is known.

    python benchmarks/handeye_real.py [FOLDER OF REAL RECORDINGS]

`tango_triplet`: three rigidly mounted visual-inertial devices with unsynchronised clocks. Without a truth, the
checks are the loop of the three pairwise results and the agreement of the two halves of the recording.
`euroc_aprilgrid`: two cameras before a board, a trajectory of each by PnP; hand-eye never uses that both see the
same board, and is compared with the transform taken frame by frame from the shared board.
"""

from __future__ import annotations

import gzip
import os
import sys
from dataclasses import dataclass, replace
from itertools import combinations, product
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from closed_forms import park_martin
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3, covariance_in_axes_of_a
from rigwake.handeye.handeye_problem import HandeyeOptions
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.handeye.motions import TrajectoryCurve
from rigwake.readers.trajectories import read_trajectory
from rigwake.trajectory import Trajectory

TANGO = {
    "caligula": "CALIGULA_20170405_195215",
    "mars": "MARS_20170405_195216",
    "nero": "NERO_20170405_195219",
}
EUROC_INTRINSICS = {  # published: fx fy cx cy, k1 k2 p1 p2
    "cam0": ([458.654, 457.296, 367.215, 248.375], [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]),
    "cam1": ([457.587, 456.134, 379.999, 255.238], [-0.28368365, 0.07451284, -0.00010473, -3.555e-05]),
}
EUROC_CAM0_FROM_CAM1 = SE3(  # published
    so3.nearest_rotation(
        [
            [0.999997256478, -0.002317135723, -0.000343393121],
            [0.002312067192, 0.999898048507, -0.014090668453],
            [0.000376008102, 0.014089835847, 0.999900662638],
        ]
    ),
    np.array([0.1100741378, -0.000156612054, 0.000889382785]),
)
MIN_CORNERS = 24
CORNER_STD_PX = 0.46  # residual of the fits


def tango_trajectories(recordings: Path) -> dict[str, Trajectory]:
    folder = recordings / "tango_triplet" / "TANGO_exCALIBur_1"
    return {
        name: read_trajectory(folder / f"{stem}.csv", name=name).trajectory for name, stem in TANGO.items()
    }


def degrees_and_mm(transform: SE3) -> tuple[float, float]:
    turn = np.rad2deg(np.linalg.norm(so3.log(transform.rotation)))
    return float(turn), float(1e3 * np.linalg.norm(transform.translation))


def pairwise_loop(trajectories: dict[str, Trajectory]) -> tuple[float, float, float]:
    """Degrees, millimetres and milliseconds by which three independent pairwise results do not close."""
    names = list(trajectories)
    loop, time_offset = SE3.identity(), 0.0
    for a, b in zip(names, names[1:] + names[:1], strict=True):
        result = calibrate_handeye(trajectories[a], [trajectories[b]])
        loop = loop * result.ref_from_members[b]
        time_offset += result.members[b].time_offset_s or 0.0
    return *degrees_and_mm(loop), 1e3 * time_offset


def naive_loops(trajectories: dict[str, Trajectory], stride: int) -> dict[str, tuple[float, float]]:
    """Degrees and millimetres of the loop by a closed form on motions over `stride` poses.

    Its translation takes the lever `I - R_A` from the rotations of one side; the key names whose, pair by pair.
    """
    found: dict[tuple[str, str], dict[str, SE3]] = {}
    names = list(trajectories)
    for a, b in zip(names, names[1:] + names[:1], strict=True):
        offset = calibrate_handeye(trajectories[a], [trajectories[b]]).members[b].time_offset_s or 0.0
        first, second = TrajectoryCurve.of(trajectories[a]), TrajectoryCurve.of(trajectories[b])
        there = first.times_s + (first.start_ns - second.start_ns) * 1e-9 - offset
        inside = (there >= 0) & (there <= second.times_s[-1])
        poses = [first.world_from_body[inside], second.at(there[inside]).world_from_body]
        A, B = (x[:-stride].inverse() * x[stride:] for x in poses)
        found[a, b] = {a: park_martin(A, B), b: park_martin(B, A).inverse()}
    loops = {}
    for whose in product(*found.values()):
        loop = SE3.identity()
        for solutions, name in zip(found.values(), whose, strict=True):
            loop = loop * solutions[name]
        loops[", ".join(whose)] = degrees_and_mm(loop)
    return loops


def halves(reference: Trajectory) -> tuple[Trajectory, Trajectory]:
    first, last = int(reference.timestamps_ns[0]), int(reference.timestamps_ns[-1])
    middle = (first + last) // 2
    return reference.between(first, middle), reference.between(middle, last)


@dataclass(frozen=True)
class HalvesAgree:
    """Per member: differences of the two halves about and along the axes of the reference, in sigmas."""

    sigmas: dict[str, np.ndarray]
    degrees_mm: dict[str, tuple[float, float]]
    clock_ms: dict[str, float]


def compare_halves(reference: Trajectory, members: list[Trajectory]) -> HalvesAgree:
    first, second = (calibrate_handeye(half, members) for half in halves(reference))
    sigmas, sizes, time_offsets = {}, {}, {}
    for name, X in first.ref_from_members.items():
        difference = X.local(second.ref_from_members[name])
        covariance = first.members[name].covariance + second.members[name].covariance
        turned = np.concatenate([X.rotation @ difference[:3], X.rotation @ difference[3:]])
        sigmas[name] = turned / np.sqrt(np.diag(covariance_in_axes_of_a(X, covariance)))
        sizes[name] = degrees_and_mm(SE3.exp(difference))
        offsets = [r.members[name].time_offset_s or 0.0 for r in (first, second)]
        time_offsets[name] = 1e3 * (offsets[1] - offsets[0])
    return HalvesAgree(sigmas, sizes, time_offsets)


def board_trajectory(recordings: Path, camera: str) -> Trajectory:
    """`board_from_cam` of every frame by iterative PnP with the published intrinsics."""
    path = recordings / "euroc_aprilgrid" / "imu_april" / f"{camera}.csv.gz"
    with gzip.open(path, "rt") as stream:
        stream.readline()
        text = stream.read()
    stamps = np.array([line.split(",", 1)[0] for line in text.splitlines()], dtype=np.int64)
    values = np.loadtxt(text.splitlines(), delimiter=",", usecols=(3, 4, 5, 6, 7))
    (fx, fy, cx, cy), distortion = EUROC_INTRINSICS[camera]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    kept, rotations, translations, covariances = [], [], [], []
    starts = np.flatnonzero(np.r_[True, np.diff(stamps) != 0])
    for block, stamp in zip(np.split(values, starts[1:]), stamps[starts], strict=True):
        if len(block) < MIN_CORNERS:
            continue
        found, turn, shift = cv2.solvePnP(
            block[:, 2:].copy(), block[:, :2].copy(), matrix, np.array(distortion)
        )
        if found:
            kept.append(stamp)
            rotations.append(so3.exp(turn.ravel()))
            translations.append(shift.ravel())
            covariances.append(pnp_covariance(block[:, 2:], turn, shift, matrix, np.array(distortion)))
    board_from_cam = SE3(np.array(rotations), np.array(translations)).inverse()
    return Trajectory(camera, np.array(kept), board_from_cam, np.array(covariances), "poses")


def pnp_covariance(
    points: np.ndarray, turn: np.ndarray, shift: np.ndarray, matrix: np.ndarray, distortion: np.ndarray
) -> np.ndarray:
    """Covariance of `board_from_cam`, right tangent d: `cam_from_board -> exp(-d) cam_from_board`."""
    _, jacobian = cv2.projectPoints(np.ascontiguousarray(points), turn, shift, matrix, distortion)
    by_turn, by_shift = jacobian[:, :3], jacobian[:, 3:6]
    by_rotation = by_shift @ so3.hat(shift.ravel()) - by_turn @ so3.left_jacobian_inverse(turn.ravel())
    J = np.hstack([by_rotation, -by_shift])
    return np.linalg.inv(J.T @ J) * CORNER_STD_PX**2


def direct_transform(first: Trajectory, second: Trajectory) -> SE3:
    """`first_from_second` from the shared board: mean over the frames that both see it in."""
    _, i, j = np.intersect1d(first.timestamps_ns, second.timestamps_ns, return_indices=True)
    each = first.world_from_body[i].inverse() * second.world_from_body[j]
    return SE3(so3.nearest_rotation(each.rotation.mean(axis=0)), each.translation.mean(axis=0))


@dataclass(frozen=True)
class EurocCheck:
    """Degrees and millimetres of hand-eye from the direct transform, and of both from the published one."""

    from_direct: tuple[float, float]
    from_published: tuple[float, float]
    direct_from_published: tuple[float, float]
    clock_ms: float


def check_euroc(recordings: Path, noise: str | None, *, pnp_covariances: bool) -> EurocCheck:
    cameras = [board_trajectory(recordings, name) for name in ("cam0", "cam1")]
    if not pnp_covariances:
        cameras = [replace(camera, covariances=None) for camera in cameras]
    result = calibrate_handeye(cameras[0], [cameras[1]], HandeyeOptions(noise=noise))
    found, direct = result.ref_from_members["cam1"], direct_transform(*cameras)
    return EurocCheck(
        degrees_and_mm(direct.inverse() * found),
        degrees_and_mm(EUROC_CAM0_FROM_CAM1.inverse() * found),
        degrees_and_mm(EUROC_CAM0_FROM_CAM1.inverse() * direct),
        1e3 * (result.members["cam1"].time_offset_s or 0.0),
    )


def main() -> None:
    beside = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
    recordings = Path(sys.argv[1] if len(sys.argv) > 1 else os.environ.get("RIGWAKE_DATA", beside))
    if not recordings.is_dir():
        print(f"no real recordings at {recordings}: name their folder, or set RIGWAKE_DATA")
        return
    devices = tango_trajectories(recordings)
    turn, shift, time_offset = pairwise_loop(devices)
    print("| what | measured | physical limit |\n|---|---|---|")
    print(
        f"| tango_triplet: three pairwise results around the loop | {turn:.4f} deg, {shift:.2f} mm, "
        f"{time_offset:+.2f} ms | 0 |"
    )
    for whose, (turn, shift) in naive_loops(devices, 25).items():
        print(
            f"| Park-Martin over 25 poses, levers by the rotations of {whose} | {turn:.4f} deg, {shift:.2f} mm | 0 |"
        )
    names = list(devices)
    joint = calibrate_handeye(devices[names[0]], [devices[n] for n in names[1:]])
    a, b = (joint.ref_from_members[n] for n in names[1:])
    closed = degrees_and_mm(a * (a.inverse() * b) * b.inverse())
    print(f"| the same, joint solve | {closed[0]:.1e} deg, {closed[1]:.1e} mm | 0 |")
    for a_name, b_name in combinations(devices, 2):
        agree = compare_halves(devices[a_name], [devices[b_name]])
        print(
            f"| {a_name}-{b_name}: halves | worst axis {np.abs(agree.sigmas[b_name]).max():.2f} sigma, "
            f"{agree.degrees_mm[b_name][0]:.3f} deg, {agree.degrees_mm[b_name][1]:.1f} mm, "
            f"{agree.clock_ms[b_name]:+.2f} ms | 3 sigma |"
        )
    for noise, covariances in (("poses", False), ("poses", True), (None, False)):
        check = check_euroc(recordings, noise, pnp_covariances=covariances)
        kind = f"noise {noise or 'estimated'}{', covariances of PnP' if covariances else ''}"
        print(
            f"| euroc_aprilgrid, {kind} | from the direct transform {check.from_direct[0]:.3f} deg, "
            f"{check.from_direct[1]:.2f} mm; from the published one {check.from_published[0]:.3f} deg, "
            f"{check.from_published[1]:.2f} mm; clock {check.clock_ms:+.3f} ms | direct from published "
            f"{check.direct_from_published[0]:.3f} deg, {check.direct_from_published[1]:.2f} mm |"
        )
    print_pairs(recordings / "handeye_real")


# reference, member, reference_from_member: two odometries said to be in the frame of one body; KITTI's rectified
# colour camera is 60 mm to the left of the grey one
PAIRS = {
    "hilti_Basement_1": ("svo", "hdl", SE3(np.diag([1.0, -1.0, -1.0]), np.zeros(3))),
    "hilti_Basement_4": ("svo", "hdl", SE3(np.eye(3), np.zeros(3))),
    "hilti_Construction_Site_1": ("svo", "hdl", SE3(np.eye(3), np.zeros(3))),
    "kitti_gray_colour": ("gray", "colour", SE3(np.eye(3), np.array([-0.06, 0.0, 0.0]))),
}


def pair_errors(folder: Path, name: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Errors (6,) of a pair, degrees and millimetres, and their deviations, either trajectory being the reference."""
    reference, member, known = PAIRS[name]
    both = {n: read_trajectory(folder / name / f"{n}.tum", name=n).trajectory for n in (reference, member)}
    found = []
    for one, other, true in ((reference, member, known), (member, reference, known.inverse())):
        camera = calibrate_handeye(both[one], [both[other]]).members[other]
        turned = np.rad2deg(so3.log(camera.rig_from_cam.rotation @ true.rotation.T))
        shifted = 1e3 * (camera.rig_from_cam.translation - true.translation)
        std = np.concatenate([camera.std_rotation_deg, 1e3 * np.asarray(camera.std_translation_m)])
        found.append((np.concatenate([turned, shifted]), std))
    return found


def starry_errors(folder: Path) -> tuple[np.ndarray, np.ndarray, str]:
    """Errors (3,) of the translation in millimetres from the published one, their deviations, the model of noise."""
    tx, ty, tz = np.loadtxt(folder / "starry" / "truth.txt", usecols=range(3))
    both = [read_trajectory(folder / "starry" / f"{n}.tum", name=n).trajectory for n in ("vehicle", "cam")]
    result = calibrate_handeye(both[0], [both[1]])
    error = result.ref_from_members["cam"].translation - np.array([tx, ty, tz])
    return 1e3 * error, 1e3 * result.members["cam"].std_translation_m, result.noise


def print_pairs(folder: Path) -> None:
    """Odometries of different sensors on one body: errors in deviations, over all axes both ways."""
    within = []
    for name in PAIRS:
        for way, (error, std) in zip(("", ", the other way"), pair_errors(folder, name), strict=True):
            told = np.isfinite(std)  # an axis that is said to be unobservable has no error
            within.append(np.where(told, np.abs(error) <= 3 * std, True))
            turned = ", ".join(f"{e:+.3f} ± {s:.3f}" for e, s in zip(error[:3], std[:3], strict=True))
            shifted = ", ".join(f"{e:+.0f} ± {s:.0f}" for e, s in zip(error[3:], std[3:], strict=True))
            print(f"| {name}{way} | {turned} deg; {shifted} mm | |")
    for words, axes in (("rotation", slice(0, 3)), ("translation", slice(3, 6))):
        good = np.array(within)[:, axes]
        print(f"| axes of {words} within 3 sigma | {good.sum()} of {good.size} | asked 95 % |")
    error, std, noise = starry_errors(folder)
    words = ", ".join(f"{e:+.1f} ± {s:.1f}" for e, s in zip(error, std, strict=True))
    print(f"| starry, {noise} | {words} mm from the published translation | asked 20 mm |")


if __name__ == "__main__":
    main()
