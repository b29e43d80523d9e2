"""Our solver beside pycolmap, gtsam and scipy on one synthetic rig problem, and how ours grows.

    python benchmarks/solver.py [--frames 400] [--landmarks 20000] [--growth 1,3,10,30] [--peers pycolmap,gtsam,scipy]

A rig of four fisheyes sails past landmarks; every landmark is seen for a few frames by one camera, and one in
ten by two. States and three of four extrinsics start off by 0.5 deg / 10 cm and 1 deg / 3 cm; every solver has
the same start and the first camera held; the gauge comes from GNSS positions (2 cm), for pycolmap from the true
first and last pose. CPU seconds are of this
process; other programs on the machine make them vary by some tens of percent. pycolmap and gtsam only see
what lies within 80 degrees of the axis, because both fail silently beyond 90.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import cv2  # noqa: F401  before pycolmap, which otherwise spoils its image reading
import numpy as np

from rigwake._types import Array
from rigwake.ba.solver.covariance import covariance_of
from rigwake.ba.solver.levenberg_marquardt import solve
from rigwake.ba.solver.rig_problem import (
    BundleCamera,
    Landmarks,
    Observations,
    PoseMeasurements,
    RigProblem,
    States,
)
from rigwake.cameras.models.kannala_brandt import KannalaBrandt4
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3

LENS = KannalaBrandt4((200.0, 200.0, 320.0, 240.0, -0.01, 0.006, -0.003, 0.0005), 640, 480)
FRAME_S, NOISE_PX, GNSS_STD, SEEN_ANGLE = 0.1, 0.3, 0.02, np.deg2rad(80.0)
OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def path(t: Array) -> SE3:
    zero = np.zeros_like(t)
    tilt = np.stack([0.05 * np.sin(1.9 * t), 0.04 * np.sin(2.3 * t + 1), zero], -1)
    rotation = so3.exp(np.stack([zero, zero, 0.3 * np.sin(0.3 * t)], -1)) @ so3.exp(tilt)
    return SE3(rotation, np.stack([2.0 * t, 3 * np.sin(0.2 * t), 0.2 * np.sin(1.7 * t)], -1))


def rig() -> list[SE3]:
    turns = [so3.exp([0, 0, k * np.pi / 2]) @ so3.exp([0, 0.2, 0]) for k in range(4)]
    return [SE3(turn @ OPTICAL, turn @ np.array([1.0, 0.05 * k, 0.5])) for k, turn in enumerate(turns)]


def make(frames: int, landmarks: int, seed: int = 0) -> tuple[RigProblem, RigProblem]:
    """The problem at its truth and at its start."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames) * FRAME_S
    poses, mounts = path(t), rig()
    born, side = rng.integers(0, frames, landmarks), rng.choice([-1.0, 1.0], landmarks)
    centre = poses.translation[born]
    along, across = (
        rng.uniform(-12, 12, landmarks),
        side * np.exp(rng.uniform(np.log(6), np.log(60), landmarks)),
    )
    points = centre + np.stack([along, across, rng.uniform(-1, 6, landmarks)], -1)
    rows = []
    for c, mount in enumerate(mounts):
        for age in range(8):
            k = born + age
            alive = np.flatnonzero((k < frames) & ((rng.integers(0, 4, landmarks) == c) | (age < 7)))
            world_from_cam = poses[k[alive]] * mount
            local = np.einsum(
                "nji,nj->ni", world_from_cam.rotation, points[alive] - world_from_cam.translation
            )
            angle = np.arctan2(np.linalg.norm(local[:, :2], axis=1), local[:, 2])
            seen = angle < SEEN_ANGLE
            pixels, _ = LENS.project(local[seen])
            rows.append((np.full(seen.sum(), c), k[alive][seen], alive[seen], pixels))
    camera, frame, mark = (np.concatenate([row[i] for row in rows]) for i in range(3))
    pixels = np.concatenate([row[3] for row in rows]) + rng.normal(0, NOISE_PX, (len(camera), 2))
    stamps = np.round(t * 1e9).astype(np.int64)
    cameras = tuple(
        BundleCamera(f"cam{c}", LENS, mount, free=frozenset({"rig_from_cam"} if c else ()))
        for c, mount in enumerate(mounts)
    )
    fixes = poses.translation + rng.normal(0, GNSS_STD, (frames, 3))
    loose = np.broadcast_to(np.diag([1e2] * 3 + [GNSS_STD] * 3) ** 2, (frames, 6, 6))
    measured = PoseMeasurements(np.arange(frames), SE3(poses.rotation, fixes), loose)
    seen_marks = Observations(camera, stamps[frame], mark, pixels, np.full(len(camera), NOISE_PX))
    truth = RigProblem(
        States(stamps, poses), cameras, Landmarks.from_points(points, centre), seen_marks, poses=measured
    )
    return truth, _start(truth, fixes, rng)


def _start(truth: RigProblem, fixes: Array, rng: np.random.Generator) -> RigProblem:
    n = len(truth.states)
    off = so3.exp(rng.normal(0, 0.005, (n, 3)))
    states = replace(truth.states, world_from_rig=SE3(truth.states.world_from_rig.rotation @ off, fixes))
    cameras = tuple(
        replace(
            c,
            rig_from_cam=c.rig_from_cam.retract(
                np.concatenate([rng.normal(0, 0.01, 3), rng.normal(0, 0.03, 3)]) * bool(c.free)
            ),
        )
        for c in truth.cameras
    )
    marks = replace(
        truth.landmarks,
        inverse_ranges=truth.landmarks.inverse_ranges * rng.uniform(0.9, 1.1, len(truth.landmarks)),
    )
    return replace(truth, states=states, cameras=cameras, landmarks=marks)


def errors(truth: RigProblem, mounts: list[SE3]) -> tuple[float, float]:
    """Largest error of the free extrinsics: degrees and millimetres."""
    off = np.array([a.rig_from_cam.local(b) for a, b in zip(truth.cameras, mounts, strict=True)])
    return (
        float(np.rad2deg(np.linalg.norm(off[:, :3], axis=1).max())),
        float(np.linalg.norm(off[:, 3:], axis=1).max() * 1e3),
    )


def ours(start: RigProblem) -> tuple[list[SE3], int]:
    solution = solve(start)
    return [camera.rig_from_cam for camera in solution.problem.cameras], solution.report.iterations


def by_gtsam(start: RigProblem, truth: RigProblem) -> tuple[list[SE3], int]:
    """gtsam's wheel has no projection factor with unknown extrinsics and a fisheye: it is given the true ones,
    a smaller problem than the others'."""
    import gtsam
    from gtsam.symbol_shorthand import L, X

    fx, fy, cx, cy, *k = LENS.values
    lens = gtsam.Cal3Fisheye(fx, fy, 0.0, cx, cy, *k)
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(2.0), gtsam.noiseModel.Isotropic.Sigma(2, NOISE_PX)
    )
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    fix = gtsam.noiseModel.Isotropic.Sigma(3, GNSS_STD)
    assert start.poses is not None
    for i, matrix in enumerate(start.states.world_from_rig.matrix):
        values.insert(X(i), gtsam.Pose3(matrix))
        graph.add(gtsam.GPSFactor(X(i), start.poses.world_from_rig.translation[i], fix))
    mounts = [gtsam.Pose3(camera.rig_from_cam.matrix) for camera in truth.cameras]
    loose = gtsam.noiseModel.Isotropic.Sigma(3, 1e3)
    for j, point in enumerate(start.landmarks.points_world):
        values.insert(L(j), point)
        graph.add(gtsam.PriorFactorPoint3(L(j), point, loose))
    seen = start.observations
    frames = np.searchsorted(start.states.timestamps_ns, seen.timestamps_ns)
    factor = gtsam.GenericProjectionFactorCal3Fisheye
    for c, i, j, pixel in zip(seen.camera_indices, frames, seen.landmark_indices, seen.pixels, strict=True):
        graph.add(factor(pixel, noise, X(i), L(j), lens, mounts[c]))
    settings = gtsam.LevenbergMarquardtParams()
    settings.setRelativeErrorTol(1e-6)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, settings)
    optimizer.optimize()
    return [camera.rig_from_cam for camera in truth.cameras], optimizer.iterations()


def by_scipy(start: RigProblem) -> tuple[list[SE3], int]:
    """scipy's trust region with our own residuals and sparse derivatives, no elimination."""
    from scipy.optimize import least_squares
    from scipy.sparse import csr_matrix

    from rigwake.ba.solver.levenberg_marquardt import Linearisation, linearised, structure_of
    from rigwake.ba.solver.parameter_layout import retract, tangent_bases
    from rigwake.ba.solver.rig_problem import SolverOptions

    options, structure = SolverOptions(loss="none"), structure_of(start)
    n, marks = structure.layout.n_columns, len(start.landmarks)
    bases = tangent_bases(start.landmarks.bearings_world)
    scale = np.repeat(np.array([[1.0, 1.0, 0.05]]), marks, axis=0).reshape(-1)

    def at(x: Array) -> Linearisation:
        moved = retract(start, structure.layout, x[:n], (x[n:] * scale).reshape(-1, 3), bases)
        return linearised(moved, structure, options)

    def residuals(x: Array) -> Array:
        linear = at(x)
        parts = [linear.observations.residuals, *(f.residuals for f in linear.factors)]
        return np.concatenate([part.reshape(-1) for part in parts])

    def derivatives(x: Array) -> csr_matrix:
        linear = at(x)
        o, (chain, columns) = linear.observations, linear.poses.chain(structure.layout)
        m = len(o.frames)
        owner = np.repeat(np.arange(marks), np.diff(o.landmark_starts))
        blocks = [(o.by_frame @ chain[o.frames], columns[o.frames])]
        blocks.append(
            (o.by_landmark * scale.reshape(-1, 3)[owner][:, None], n + 3 * owner[:, None] + np.arange(3))
        )
        values, rows, cols = [], [], []
        top = 2 * m
        for jacobian, at_columns in blocks:
            values.append(jacobian.reshape(-1))
            rows.append(np.broadcast_to(np.arange(2 * m).reshape(m, 2, 1), jacobian.shape).reshape(-1))
            cols.append(np.broadcast_to(at_columns[:, None], jacobian.shape).reshape(-1))
        for f in linear.factors:
            count = f.residuals.size
            values.append(f.jacobian.reshape(-1))
            rows.append(
                np.broadcast_to(
                    top + np.arange(count).reshape(*f.residuals.shape, 1), f.jacobian.shape
                ).reshape(-1)
            )
            cols.append(np.broadcast_to(f.columns[:, None], f.jacobian.shape).reshape(-1))
            top += count
        value, row, col = (np.concatenate(part) for part in (values, rows, cols))
        kept = col >= 0
        return csr_matrix((value[kept], (row[kept], col[kept])), shape=(top, n + 3 * marks))

    found = least_squares(
        residuals,
        np.zeros(n + 3 * marks),
        derivatives,
        method="trf",
        tr_solver="lsmr",
        ftol=1e-6,
        x_scale="jac",
    )
    moved = retract(start, structure.layout, found.x[:n], (found.x[n:] * scale).reshape(-1, 3), bases)
    return [camera.rig_from_cam for camera in moved.cameras], int(found.nfev)


def by_pycolmap(start: RigProblem, truth: RigProblem) -> tuple[list[SE3], int]:
    """COLMAP's bundle adjustment (ceres) of the same rig with refined sensor poses and position priors."""
    import pycolmap

    record = pycolmap.Reconstruction()
    sensors = [pycolmap.sensor_t(pycolmap.SensorType.CAMERA, c + 1) for c in range(len(start.cameras))]
    body = pycolmap.Rig(rig_id=1)
    mounts = [camera.rig_from_cam for camera in start.cameras]
    fx, fy, cx, cy, *k = LENS.values
    for c, mount in enumerate(mounts):
        lens = pycolmap.Camera(
            camera_id=c + 1,
            model="OPENCV_FISHEYE",
            width=LENS.width_px,
            height=LENS.height_px,
            params=[fx, fy, cx + 0.5, cy + 0.5, *k],
        )
        record.add_camera(lens)
        if c == 0:
            body.add_ref_sensor(sensors[c])
        else:
            body.add_sensor(sensors[c], pycolmap.Rigid3d((mount.inverse() * mounts[0]).matrix[:3]))
    record.add_rig(body)
    seen, n = start.observations, len(start.states)
    frame_of = np.searchsorted(start.states.timestamps_ns, seen.timestamps_ns)
    order = np.lexsort((np.arange(len(seen)), frame_of * 4 + seen.camera_indices))
    groups = np.split(order, np.flatnonzero(np.diff((frame_of * 4 + seen.camera_indices)[order])) + 1)
    # COLMAP takes no fixes here: the true first and last pose hold the gauge, scale included
    body_poses = start.states.world_from_rig[np.arange(n)]
    for end in (0, -1):
        body_poses.rotation[end] = truth.states.world_from_rig.rotation[end]
        body_poses.translation[end] = truth.states.world_from_rig.translation[end]
    world_from_first = body_poses * mounts[0]
    frames = [pycolmap.Frame(frame_id=i + 1, rig_id=1) for i in range(n)]
    images, elements = [], [[] for _ in range(len(start.landmarks))]
    for number, group in enumerate(groups, start=1):
        c, i = int(seen.camera_indices[group[0]]), int(frame_of[group[0]])
        points = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in seen.pixels[group] + 0.5])
        image = pycolmap.Image(name=f"{i}_{c}", points2D=points, camera_id=c + 1, image_id=number)
        image.frame_id = i + 1
        frames[i].add_data_id(image.data_id)
        images.append(image)
        for slot, row in enumerate(group):
            elements[seen.landmark_indices[row]].append((number, slot))
    for i, frame in enumerate(frames):
        frame.rig_from_world = pycolmap.Rigid3d(world_from_first[i].inverse().matrix[:3])
        record.add_frame(frame)
    for image in images:
        record.add_image(image)
        record.register_frame(image.frame_id) if not record.frame(image.frame_id).has_pose else None
    for point, track in zip(start.landmarks.points_world, elements, strict=True):
        if len(track) > 1:
            record.add_point3D(
                point, pycolmap.Track([pycolmap.TrackElement(*e) for e in track]), np.zeros(3, np.uint8)
            )
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = options.refine_principal_point = False
    options.refine_sensor_from_rig = True
    options.print_summary = False
    config = pycolmap.BundleAdjustmentConfig()
    for image in images:
        config.add_image(image.image_id)
    for c in range(len(start.cameras)):
        config.set_constant_cam_intrinsics(c + 1)
    config.set_constant_rig_from_world_pose(1)
    config.set_constant_rig_from_world_pose(n)
    summary = pycolmap.create_default_bundle_adjuster(options, config, record).solve()
    found = record.rig(1)
    poses = [mounts[0]]
    for sensor in sensors[1:]:
        cam_from_first = SE3.from_matrix(found.sensor_from_rig(sensor).matrix())
        poses.append(mounts[0] * cam_from_first.inverse())
    return poses, int(summary.num_residuals)


def timed(call: Callable[[], tuple[list[SE3], int]]) -> tuple[list[SE3], int, float, float]:
    cpu, wall = time.process_time(), time.perf_counter()
    mounts, count = call()
    return mounts, count, time.process_time() - cpu, time.perf_counter() - wall


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=400)
    parser.add_argument("--landmarks", type=int, default=20000)
    parser.add_argument("--growth", default="1,3,10,30")
    parser.add_argument("--peers", default="pycolmap,gtsam,scipy")
    args = parser.parse_args()
    solve(make(10, 100)[1])  # compile
    truth, start = make(args.frames, args.landmarks)
    print(
        f"4 cameras x {args.frames} frames, {args.landmarks} landmarks, {len(start.observations)} observations\n"
    )
    print("| solver | CPU s | wall s | x ours | worst rotation (deg) | worst position (mm) |")
    print("|---|---|---|---|---|---|")
    methods = {
        "rigwake": lambda: ours(start),
        "pycolmap": lambda: by_pycolmap(start, truth),
        "gtsam": lambda: by_gtsam(start, truth),
        "scipy": lambda: by_scipy(start),
    }
    reference = 0.0
    for name in ["rigwake", *(peer for peer in args.peers.split(",") if peer)]:
        mounts, _, cpu, wall = timed(methods[name])
        reference = reference or cpu
        degrees, millimetres = errors(truth, mounts)
        accuracy = "given | given" if name == "gtsam" else f"{degrees:.4f} | {millimetres:.2f}"
        print(f"| {name} | {cpu:.2f} | {wall:.2f} | {cpu / reference:.1f} | {accuracy} |", flush=True)
    cpu = time.process_time()
    covariance_of(start)
    print(f"\ncovariance of all extrinsics: {time.process_time() - cpu:.2f} CPU-s\n")
    print("| growth | observations | iterations | CPU s | time per observation, relative |")
    print("|---|---|---|---|---|")
    first = 0.0
    for factor in (int(x) for x in args.growth.split(",") if x):
        _, larger = make(args.frames // 4 * factor, args.landmarks // 4 * factor)
        _, iterations, cpu, _ = timed(lambda larger=larger: ours(larger))
        per_row = cpu / len(larger.observations)
        first = first or per_row
        print(
            f"| {factor}x | {len(larger.observations)} | {iterations} | {cpu:.2f} | {per_row / first:.2f} |"
        )


if __name__ == "__main__":
    main()
