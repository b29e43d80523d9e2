"""Throughput of every camera model on one core, against OpenCV where it has the model.

CPU time, median of 7 runs, 1 000 000 points within 80 degrees (60 for pinholes) of the axis.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import cv2
import numpy as np

from rigwake.cameras.models.lens import Lens
from rigwake.cameras.registry import camera_from_params

COUNT = 1_000_000
MODELS: dict[str, list[float]] = {
    "pinhole": [458, 457, 367, 248, 0, -0.28, 0.07, 2e-4, 1.8e-5, 0],
    "rational": [458, 457, 367, 248, 0, 0.28, 0.07, 2e-4, 1.8e-5, 0.01, 0.5, 0.1, 0.01],
    "kb4": [200.4, 201, 322.6, 236.9, -0.0115, 0.0062, -0.0034, 0.0005],
    "kb23": [
        200.4,
        201,
        322.6,
        236.9,
        0.95,
        0.01,
        -0.02,
        0.003,
        -4e-4,
        *[0.01, 0, 0, 0.3, 0.2, 0.1, 0.4] * 2,
    ],
    "mei": [400, 401, 320, 240, 1.4, -0.05, 0.01, 1e-3, -2e-3, 0],
    "scaramuzza": [320, 240, 1.001, 0.002, -0.003, -200, 0, 1.8e-3, -1e-6, 3e-9],
    "eucm": [200, 201, 320, 240, 0.6, 1.1],
    "ds": [200, 201, 320, 240, -0.2, 0.6],
    "fov": [200, 201, 320, 240, 0.93],
}


def cpu_seconds(work: Callable[[], object], repeats: int = 7) -> float:
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return float(np.median(times))


def rays(max_angle: float) -> np.ndarray:
    rng = np.random.default_rng(0)
    theta, phi = rng.uniform(0, max_angle, COUNT), rng.uniform(-np.pi, np.pi, COUNT)
    return np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def opencv_times(camera: Lens, points: np.ndarray, pixels: np.ndarray) -> tuple[float, float] | None:
    """Projection with Jacobian and undistortion of the same points by OpenCV, if it has the model."""
    p, zero = camera.params, np.zeros(3)
    K = np.array([[p[0], 0, p[2]], [0, p[1], p[3]], [0, 0, 1.0]])
    batch, seen = points[:, None], pixels[:, None]
    if camera.model == "kb4":
        return (
            cpu_seconds(lambda: cv2.fisheye.projectPoints(batch, zero, zero, K, p[4:])),
            cpu_seconds(lambda: cv2.fisheye.undistortPoints(seen, K, p[4:])),
        )
    if camera.model in ("pinhole", "rational"):
        return (
            cpu_seconds(lambda: cv2.projectPoints(batch, zero, zero, K, p[5:])),
            cpu_seconds(lambda: cv2.undistortPoints(seen, K, p[5:])),
        )
    if camera.model == "mei":
        D, xi = p[5:9], np.array([p[4]])
        return (
            cpu_seconds(lambda: cv2.omnidir.projectPoints(batch, zero, zero, K, float(p[4]), D)),
            cpu_seconds(lambda: cv2.omnidir.undistortPoints(seen, K, D, xi, np.eye(3))),
        )
    return None


def main() -> None:
    cv2.setNumThreads(1)
    print(
        "| model | project + Jacobians, ns | OpenCV, ns | ratio | project, ns | unproject, ns | OpenCV, ns |"
    )
    print("|---|---|---|---|---|---|---|")
    for model, params in MODELS.items():
        camera = camera_from_params(model, params, 640, 480)
        assert isinstance(camera, Lens)
        points = rays(np.deg2rad(60 if "skew" in camera.param_names else 80))
        pixels, _ = camera.project(points)
        with_jacobians = cpu_seconds(lambda c=camera, x=points: c.project_with_jacobians(x))
        plain = cpu_seconds(lambda c=camera, x=points: c.project(x))
        inverse = cpu_seconds(lambda c=camera, x=pixels: c.unproject(x))
        peer = opencv_times(camera, points, pixels)
        ns = 1e9 / COUNT
        theirs = ("–", "–", "–")
        if peer is not None:
            theirs = (f"{peer[0] * ns:.0f}", f"{with_jacobians / peer[0]:.2f}", f"{peer[1] * ns:.0f}")
        print(
            f"| {model} | {with_jacobians * ns:.0f} | {theirs[0]} | {theirs[1]} | {plain * ns:.0f} "
            f"| {inverse * ns:.0f} | {theirs[2]} |"
        )


if __name__ == "__main__":
    main()
