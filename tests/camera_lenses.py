"""Lenses of every model, narrow and wide, for the tests of cameras."""

import numpy as np

from rigwake.cameras.models.lens import Lens
from rigwake.cameras.registry import camera_from_params


def lens(model: str, params: list[float], fov_deg: float | None = None) -> Lens:
    limit = None if fov_deg is None else np.deg2rad(fov_deg / 2)
    made = camera_from_params(model, params, 640, 480, limit)
    assert isinstance(made, Lens)
    return made


_SYMMETRIC = [0.95, 0.01, -0.02, 0.003, -0.0004]
_ASYMMETRIC = [0.01, 0.002, 0.001, 0.3, 0.2, 0.1, 0.4]

LENSES = {
    "pinhole": lens("pinhole", [458, 457, 367, 248, 0.3, -0.28, 0.07, 2e-4, 1.8e-5, 0.01]),
    "pinhole folding": lens("pinhole", [458, 457, 367, 248, 0, -0.3, 0.05, 0, 0, 0]),
    "rational": lens("rational", [458, 457, 367, 248, 0.3, 0.28, 0.07, 2e-4, 1.8e-5, 0.01, 0.5, 0.1, 0.01]),
    "kb4 195": lens("kb4", [200.4, 201, 322.6, 236.9, -0.0115, 0.0062, -0.0034, 0.0005], 195),
    "kb4 ideal": lens("kb4", [200, 200, 320, 240, 0, 0, 0, 0]),
    "kb4 folding": lens("kb4", [200, 200, 320, 240, -0.05, -0.01, 0, 0]),
    "kb23 195": lens("kb23", [200.4, 201, 322.6, 236.9, *_SYMMETRIC, *_ASYMMETRIC, *_ASYMMETRIC], 195),
    "mei 195": lens("mei", [400, 401, 320, 240, 1.4, -0.05, 0.01, 1e-3, -2e-3, 0.002], 195),
    "mei xi < 1": lens("mei", [300, 301, 320, 240, 0.9, -0.05, 0.01, 1e-3, -2e-3, 0]),
    "scaramuzza 195": lens("scaramuzza", [320, 240, 1.001, 0.002, -0.003, -200, 0, 1.8e-3, -1e-6, 3e-9], 195),
    "scaramuzza degree 6": lens(
        "scaramuzza", [320, 240, 1, 0, 0, -200, 0.01, 1.7e-3, 1e-7, 2e-9, 1e-13, 1e-15], 195
    ),
    "eucm 195": lens("eucm", [200, 201, 320, 240, 0.6, 1.1], 195),
    "eucm alpha < 1/2": lens("eucm", [200, 201, 320, 240, 0.3, 1.1], 195),
    "ds 195": lens("ds", [200, 201, 320, 240, -0.2, 0.6], 195),
    "ds xi > 0": lens("ds", [200, 201, 320, 240, 0.3, 0.4], 195),
    "fov 195": lens("fov", [200, 201, 320, 240, 0.93], 195),
}


def rays_within(max_angle: float, count: int, seed: int = 0) -> np.ndarray:
    """(count, 3) unit vectors at angles uniform in (0, max_angle) off the axis."""
    rng = np.random.default_rng(seed)
    theta, phi = rng.uniform(0, max_angle, count), rng.uniform(-np.pi, np.pi, count)
    return np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def reach_of(camera: Lens) -> float:
    """The angle up to which tests look: the lens's end, or where pixels run off towards infinity, twice
    the image's width beside it."""
    theta = np.linspace(0, camera.max_angle, 2000)
    rays = np.column_stack([np.sin(theta), 0 * theta, np.cos(theta)])
    pixels, valid = camera.project(rays)
    with np.errstate(invalid="ignore"):
        near = valid & (np.abs(pixels - pixels[0]).max(axis=1) < 3 * camera.width_px)
    return float(theta[near].max())
