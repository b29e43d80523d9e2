"""Corners where two blurred edges cross, of chessboards and AprilGrids, by least squares on grey values.

What is fitted is `offset + contrast * erf(s / b) * erf(t / b)`: s and t are the distances from two lines through the
corner, b is the blur, which is learnt at every corner, so that sharp and soft pictures are treated alike. Refinement by
gradients (`cornerSubPix`) takes differences of pixels for gradients; where a picture is sharper than its pixels these
are wrong, and alike over a whole view.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from rigwake._types import Array

_WINDOW_OF_ROOM = 0.45  # half the window, whose corners reach further, as a fraction of the room
_HALF_PX = (2, 7)
_ROUNDS = 12
_BLUR_PX = (0.289, 3.0)  # from what the area of a pixel blurs by itself
_START_BLUR_PX = 0.5
_MOST_UNEXPLAINED = 0.12  # of the grey values' spread: a corner of a single dark square leaves more
_FADE = 0.6  # standard deviation of the weights, as a fraction of half the window: edges are straight near the corner
_BLUR, _OFFSET, _CONTRAST = 4, 5, 6  # after the corner (2) and the directions of the two normals


class _SaddleFit(NamedTuple):
    params: Array  # (N, 7)
    jacobian: Array  # (N, K, 7), weighted
    residuals: Array  # (N, K), weighted


def fitted_saddles(image: NDArray[np.uint8], start: Array, normals: Sequence[Array], room_px: float) -> Array:
    """(N, 2) corners, given as `start` (N, 2) to a pixel or better; NaN where the window leaves the image or where no
    two edges cross.

    normals: of both edges, angles (N,) in the image to some 20 degrees. room_px: how far from the corner nothing but
    its two edges is seen.
    """
    half = int(np.clip(round(_WINDOW_OF_ROOM * room_px), *_HALF_PX))
    nearest = np.round(start).astype(np.int64)
    steps = np.arange(-half, half + 1)
    window = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    size = np.array(image.shape[1::-1])
    inside = np.all((nearest >= half) & (nearest < size - half), axis=1)
    pixels = (nearest[:, None] + window).clip(0, size - 1)
    values = image[pixels[..., 1], pixels[..., 0]].astype(np.float64)
    weights = np.exp(-(window**2).sum(axis=1) / (2 * _FADE * half) ** 2)
    fit = _fit(values, window.astype(np.float64), weights, start - nearest, normals)
    means = (values @ weights**2 / (weights**2).sum())[:, None]
    spread = (((values - means) * weights) ** 2).sum(axis=1)
    good = inside & ((fit.residuals**2).sum(axis=1) < _MOST_UNEXPLAINED * spread)
    return np.where(good[:, None], nearest + fit.params[:, :2], np.nan)


def normals_of_grid(grid: Array) -> list[Array]:
    """Of the edges that cross at the corners (rows, columns, 2) of a chessboard: angles (N,) along rows and columns."""
    return [
        np.arctan2(along[..., 1], along[..., 0]).ravel() + np.pi / 2
        for along in (np.gradient(grid, axis=1), np.gradient(grid, axis=0))
    ]


def _fit(values: Array, window: Array, weights: Array, start: Array, normals: Sequence[Array]) -> _SaddleFit:
    """Every corner in its window, by damped Gauss-Newton steps, each corner by itself."""
    count = len(values)
    params = np.column_stack(
        [start, *normals, np.full(count, _START_BLUR_PX), np.zeros(count), np.ones(count)]
    )
    shape = _saddle_fit(params, values, window, weights).jacobian[..., [_OFFSET, _CONTRAST]]
    normal = np.einsum("nki,nkj->nij", shape, shape) + 1e-9 * np.eye(2)
    towards = np.einsum("nki,nk->ni", shape, weights * values)
    params[:, _OFFSET:] = np.linalg.solve(normal, towards[..., None])[..., 0]
    fit = _saddle_fit(params, values, window, weights)
    damping = np.full(count, 1e-3)
    for _ in range(_ROUNDS):
        normal = np.einsum("nki,nkj->nij", fit.jacobian, fit.jacobian)
        diagonal = np.einsum("nii->ni", normal)
        normal = normal + (damping[:, None] * diagonal + 1e-9)[:, :, None] * np.eye(7)
        towards = np.einsum("nki,nk->ni", fit.jacobian, fit.residuals)
        tried = fit.params + np.linalg.solve(normal, towards[..., None])[..., 0]
        tried[:, _BLUR] = tried[:, _BLUR].clip(*_BLUR_PX)
        new = _saddle_fit(tried, values, window, weights)
        better = (new.residuals**2).sum(axis=1) < (fit.residuals**2).sum(axis=1)
        fit = _SaddleFit(
            np.where(better[:, None], new.params, fit.params),
            np.where(better[:, None, None], new.jacobian, fit.jacobian),
            np.where(better[:, None], new.residuals, fit.residuals),
        )
        damping = np.where(better, damping / 5, damping * 5)
    return fit


def _saddle_fit(params: Array, values: Array, window: Array, weights: Array) -> _SaddleFit:
    blur, contrast = params[:, _BLUR, None], params[:, _CONTRAST, None]
    away = window[None] - params[:, None, :2]
    edges, slopes, normals, along = [], [], [], []
    for angle in (params[:, 2], params[:, 3]):
        normal = np.column_stack([np.cos(angle), np.sin(angle)])[:, None]
        scaled = (away * normal).sum(axis=2) / blur
        edges.append(erf(scaled / np.sqrt(2)))
        slopes.append(np.sqrt(2 / np.pi) * np.exp(-(scaled**2) / 2) / blur)
        normals.append(normal)
        along.append((scaled, (away * normal[..., ::-1] * [-1, 1]).sum(axis=2)))
    first, second = slopes[0] * edges[1], edges[0] * slopes[1]
    product = edges[0] * edges[1]
    columns = [
        -contrast * (first * normals[0][..., 0] + second * normals[1][..., 0]),
        -contrast * (first * normals[0][..., 1] + second * normals[1][..., 1]),
        contrast * first * along[0][1],
        contrast * second * along[1][1],
        -contrast * (first * along[0][0] + second * along[1][0]),
        np.ones_like(product),
        product,
    ]
    residuals = values - params[:, _OFFSET, None] - contrast * product
    return _SaddleFit(params, np.stack(columns, axis=-1) * weights[None, :, None], residuals * weights)
