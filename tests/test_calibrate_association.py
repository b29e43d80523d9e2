"""Landmarks associated across cameras: what a bent warp does to a registration, and where searches are proposed."""

import numpy as np

from rigwake._types import Array
from rigwake.tracking.interpolation import spline_coefficients
from rigwake.tracking.references import PatchShape, make_references, registration_bias
from rigwake.tracking.registration import register

SIZE = 40
CENTRE = np.array([SIZE / 2.0, SIZE / 2.0])


def texture(points: Array, rng: np.random.Generator) -> Array:
    """Grey levels of a random smooth picture at points (..., 2)."""
    waves, phases = rng.normal(0, 0.35, (40, 2)), rng.uniform(0, 2 * np.pi, 40)
    return 128 + 12 * np.sin(points @ waves.T + phases).sum(axis=-1)


def bent_back(pixels: Array, warp: Array, bend: Array) -> Array:
    """Offsets x in the source with `warp x + b(x) = pixels`, by iteration that is good near the centre."""
    x = pixels @ np.linalg.inv(warp).T
    for _ in range(30):
        quadratic = np.stack([x[..., 0] ** 2 / 2, x[..., 0] * x[..., 1], x[..., 1] ** 2 / 2], axis=-1)
        x = np.clip((pixels - quadratic @ bend.T) @ np.linalg.inv(warp).T, -25, 25)
    return x


def test_a_bent_warp_draws_a_registration_as_far_as_it_is_said_to() -> None:
    rng, shape = np.random.default_rng(0), PatchShape.disc(8)
    grid = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), axis=-1) - CENTRE
    off, said = [], []
    for seed in range(30):
        warp = np.eye(2) + rng.normal(0, 0.08, (2, 2))
        bend = rng.normal(0, 0.004, (2, 3))
        source = texture(grid, np.random.default_rng(seed))
        target = texture(bent_back(grid, warp, bend), np.random.default_rng(seed))
        coefficients = [spline_coefficients(np.clip(i, 0, 255).astype(np.uint8)) for i in (source, target)]
        references, good = make_references(coefficients[0], CENTRE[None], shape)
        found = register(coefficients[1], references, shape, CENTRE[None], warp[None], warp_prior_std=1.0)
        assert good.all()
        assert found.found.all()
        off.append(found.pixels[0] - CENTRE)
        said.append(registration_bias(references, warp[None], bend[None])[0])
    off_px, said_px = np.array(off), np.array(said)
    assert np.sqrt(np.mean(off_px**2)) > 0.05
    assert np.sqrt(np.mean((off_px - said_px) ** 2)) < 0.25 * np.sqrt(np.mean(off_px**2))
    assert np.isclose((off_px * said_px).sum() / (said_px**2).sum(), 1.0, atol=0.1)


def test_nothing_is_drawn_without_a_bend() -> None:
    shape = PatchShape.disc(8)
    grid = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), axis=-1) - CENTRE
    picture = np.clip(texture(grid, np.random.default_rng(1)), 0, 255).astype(np.uint8)
    references, _ = make_references(spline_coefficients(picture), CENTRE[None], shape)
    assert np.all(registration_bias(references, np.eye(2)[None], np.zeros((1, 2, 3))) == 0)
