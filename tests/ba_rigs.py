"""Small synthetic rigs for tests of the solver: smooth motion, landmarks all around, exact pixels plus noise."""

from dataclasses import dataclass, replace

import numpy as np

from rigwake._types import Array
from rigwake.ba.solver.rig_problem import (
    Antenna,
    BundleCamera,
    InertialStates,
    Landmarks,
    Observations,
    RigProblem,
    States,
)
from rigwake.cameras.models.kannala_brandt import KannalaBrandt4
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.recording import GnssStream, ImuStream

GRAVITY = np.array([0.0, 0.0, -9.81])
START_NS = 1_700_000_000_000_000_000
FISHEYE = KannalaBrandt4(
    (200.0, 200.0, 320.0, 240.0, -0.01, 0.006, -0.003, 0.0005), 640, 480, np.deg2rad(97.5)
)
GYRO_NOISE, ACCEL_NOISE, GYRO_WALK, ACCEL_WALK = 2e-4, 2e-3, 2e-5, 3e-4


@dataclass(frozen=True)
class Path:
    """A boat on waves: circling, rolling, pitching and heaving; everything analytic."""

    waves: float = 1.0
    yaw_rate: float = 0.25

    def euler(self, t: Array) -> tuple[Array, Array, Array]:
        roll = self.waves * (0.05 * np.sin(1.9 * t) + 0.02 * np.sin(3.1 * t + 1))
        pitch = self.waves * (0.03 * np.sin(2.3 * t + 0.5) + 0.02 * np.cos(1.3 * t))
        return roll, pitch, self.yaw_rate * t + 0.3 * np.sin(0.4 * t)

    def position(self, t: Array) -> Array:
        return np.stack(
            [
                8 * np.sin(0.25 * t),
                -8 * np.cos(0.25 * t) + 0.5 * np.sin(0.7 * t),
                0.15 * self.waves * np.sin(1.7 * t),
            ],
            -1,
        )

    def world_from_rig(self, t: Array) -> SE3:
        roll, pitch, yaw = self.euler(t)
        zero = np.zeros_like(t)
        rotation = (
            so3.exp(np.stack([zero, zero, yaw], -1))
            @ so3.exp(np.stack([zero, pitch, zero], -1))
            @ so3.exp(np.stack([roll, zero, zero], -1))
        )
        return SE3(rotation, self.position(t))

    def velocity(self, t: Array) -> Array:
        h = 1e-4
        return (self.position(t + h) - self.position(t - h)) / (2 * h)

    def imu(self, t: Array) -> tuple[Array, Array]:
        """Angular rate and specific force in rig axes."""
        h = 1e-3
        here = self.world_from_rig(t).rotation
        before, after = self.world_from_rig(t - h).rotation, self.world_from_rig(t + h).rotation
        rate = so3.log(np.swapaxes(before, -1, -2) @ after) / (2 * h)
        acceleration = (self.position(t + h) - 2 * self.position(t) + self.position(t - h)) / h**2
        return rate, np.einsum("nji,nj->ni", here, acceleration - GRAVITY)


def stamps(t: Array) -> Array:
    return START_NS + np.round(t * 1e9).astype(np.int64)


def rig_from_cams(n: int) -> list[SE3]:
    """Cameras around the rig, 1 m out, looking outwards and 15 degrees down."""
    optical = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    found = []
    for k in range(n):
        yaw = so3.exp([0, 0, 2 * np.pi * k / n + 0.02 * k])
        down = so3.exp([0, np.deg2rad(15), 0])
        found.append(SE3(yaw @ down @ optical, yaw @ np.array([1.0, 0.03 * k, 0.6])))
    return found


@dataclass(frozen=True)
class Wanted:
    """What to simulate."""

    cameras: int = 4
    seconds: float = 20.0
    state_hz: float = 5.0
    landmarks: int = 300
    noise_px: float = 0.3
    gnss_std: float | None = 0.02
    imu: bool = True
    offsets_s: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    line_delay_s: float = 0.0
    arm: tuple[float, float, float] = (-0.4, 0.2, 1.1)
    waves: float = 1.0
    far: float = 300.0
    seed: int = 0


def true_problem(wanted: Wanted) -> RigProblem:
    """A problem at its true values, with noisy measurements; every camera parameter held."""
    rng = np.random.default_rng(wanted.seed)
    path = Path(wanted.waves)
    t = np.arange(0, wanted.seconds + 1e-9, 1 / wanted.state_hz)
    poses = path.world_from_rig(t)
    offsets = np.resize(wanted.offsets_s, wanted.cameras)
    cameras = tuple(
        BundleCamera(f"cam{k}", FISHEYE, pose, offset, wanted.line_delay_s, 240.0)
        for k, (pose, offset) in enumerate(zip(rig_from_cams(wanted.cameras), offsets, strict=True))
    )
    ranges = np.exp(rng.uniform(np.log(5), np.log(wanted.far), wanted.landmarks))
    azimuth = rng.uniform(-np.pi, np.pi, wanted.landmarks)
    points = np.stack(
        [
            (8 + ranges) * np.cos(azimuth),
            (8 + ranges) * np.sin(azimuth),
            rng.uniform(-1, 12, wanted.landmarks),
        ],
        -1,
    )
    inner = States(stamps(t), poses)
    gyro_bias, accel_bias = np.array([2e-3, -3e-3, 1e-3]), np.array([0.05, -0.02, 0.03])
    imu = _imu(path, wanted, gyro_bias, accel_bias, rng) if wanted.imu else None
    if imu is not None:
        ones = np.ones((len(t), 1))
        inner = replace(inner, inertial=InertialStates(path.velocity(t), ones * gyro_bias, ones * accel_bias))
    observations = _observe(path, wanted, cameras, t, points, rng)
    return RigProblem(
        inner,
        cameras,
        Landmarks.from_points(points, np.zeros(3)),
        observations,
        imu=imu,
        gnss=_gnss(path, wanted, rng) if wanted.gnss_std else None,
        antenna=Antenna(np.array(wanted.arm)),
    )


def _imu(
    path: Path, wanted: Wanted, gyro_bias: Array, accel_bias: Array, rng: np.random.Generator
) -> ImuStream:
    t = np.arange(-0.2003, wanted.seconds + 0.2, 0.01)
    gyro, accel = path.imu(t)
    gyro = gyro + gyro_bias + rng.normal(0, GYRO_NOISE * 10, gyro.shape)
    accel = accel + accel_bias + rng.normal(0, ACCEL_NOISE * 10, accel.shape)
    gyro += np.cumsum(rng.normal(0, GYRO_WALK * 0.1, gyro.shape), axis=0)
    accel += np.cumsum(rng.normal(0, ACCEL_WALK * 0.1, accel.shape), axis=0)
    return ImuStream("imu", stamps(t), gyro, accel, "", "", GYRO_NOISE, ACCEL_NOISE, GYRO_WALK, ACCEL_WALK)


def _gnss(path: Path, wanted: Wanted, rng: np.random.Generator) -> GnssStream:
    t = np.arange(0.013, wanted.seconds, 0.2)
    assert wanted.gnss_std is not None
    fixes = path.world_from_rig(t) * np.array(wanted.arm) + rng.normal(0, wanted.gnss_std, (len(t), 3))
    covariances = np.broadcast_to(np.eye(3) * wanted.gnss_std**2, (len(t), 3, 3))
    return GnssStream("gnss", stamps(t), fixes, covariances, (57.0, 11.0, 0.0))


def _observe(
    path: Path,
    wanted: Wanted,
    cameras: tuple[BundleCamera, ...],
    t: Array,
    points: Array,
    rng: np.random.Generator,
) -> Observations:
    rows = []
    for c, camera in enumerate(cameras):
        for time in t:
            delay = np.zeros(len(points))
            for _ in range(3 if camera.line_delay_s else 1):
                poses = path.world_from_rig(time + camera.time_offset_s + delay) * camera.rig_from_cam
                local = np.einsum("nji,nj->ni", poses.rotation, points - poses.translation)
                pixels, valid = camera.model.project(local)
                delay = np.where(valid, (pixels[:, 1] - camera.reference_row_px) * camera.line_delay_s, 0.0)
            inside = valid & np.all((pixels >= 0) & (pixels < (640, 480)), axis=1)
            for k in np.flatnonzero(inside):
                rows.append((c, stamps(time), k, *pixels[k]))
    table = np.array(rows, dtype=object)
    integers = table[:, :3].astype(np.int64)
    pixels = table[:, 3:].astype(np.float64)
    noisy = pixels + rng.normal(0, wanted.noise_px, pixels.shape) if wanted.noise_px else pixels
    std = np.full(len(noisy), wanted.noise_px or 1.0)
    return Observations(integers[:, 0], integers[:, 1], integers[:, 2], noisy, std)


def free_cameras(problem: RigProblem, *parameters: str) -> RigProblem:
    """The same problem with these parameters of every camera free."""
    cameras = tuple(replace(camera, free=frozenset(parameters)) for camera in problem.cameras)
    return replace(problem, cameras=cameras)


def started_off(
    problem: RigProblem, seed: int, rotation: float = 0.035, translation: float = 0.05
) -> RigProblem:
    """The problem with its free values off: extrinsics by 2 degrees and 5 cm, time offsets forgotten, states by
    half a degree and 10 cm, landmarks by a tenth of their range."""
    rng = np.random.default_rng(1000 + seed)
    cameras = []
    for camera in problem.cameras:
        if "rig_from_cam" in camera.free:
            off = np.concatenate([rng.normal(0, rotation, 3), rng.normal(0, translation, 3)])
            camera = replace(camera, rig_from_cam=camera.rig_from_cam.retract(off))
        if "time_offset" in camera.free:
            camera = replace(camera, time_offset_s=0.0)
        if "line_delay" in camera.free:
            camera = replace(camera, line_delay_s=0.0)
        cameras.append(camera)
    n = len(problem.states)
    off = np.concatenate([rng.normal(0, 0.01, (n, 3)), rng.normal(0, 0.1, (n, 3))], axis=1)
    if problem.states.fixed is not None:
        off[problem.states.fixed] = 0.0
    states = replace(problem.states, world_from_rig=problem.states.world_from_rig.retract(off))
    if states.inertial is not None:
        zeros = np.zeros((n, 3))
        velocity = states.inertial.velocity_world + rng.normal(0, 0.2, (n, 3))
        states = replace(states, inertial=InertialStates(velocity, zeros, zeros))
    marks = replace(
        problem.landmarks,
        inverse_ranges=problem.landmarks.inverse_ranges
        * (1 + rng.uniform(-0.1, 0.1, len(problem.landmarks))),
    )
    return replace(problem, cameras=tuple(cameras), states=states, landmarks=marks)
