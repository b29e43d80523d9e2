"""Cholesky of a symmetric matrix with an envelope: a band of varying width, in tiles, by BLAS.

Rows of tiles reach from the first tile that couples with them to the diagonal, and so does their factor
(no fill outside the envelope). States in time order give a narrow one: as wide as landmarks live long.

Source: George and Liu, *Computer Solution of Large Sparse Positive Definite Systems* (1981), chapter 4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dpotrf

from rigwake._types import Array, Indices
from rigwake.parallel import over_ranges, ranges

_LEAST_PRODUCTS = 2e7  # multiplications that are worth a thread


class NotPositiveDefiniteError(ArithmeticError):
    """The matrix has a direction without information; caught by the solver, which damps more."""


@dataclass(frozen=True, eq=False)
class Envelope:
    """Shape: `n` rows in tiles of `tile` rows; tile row i spans tile columns `first[i]..i`, row-major in
    `values` from `offsets[i]` on."""

    n: int
    tile: int
    first: Indices
    offsets: Indices

    @classmethod
    def of_first_columns(cls, first_columns: Indices, unit: int, tile_rows: int = 96) -> Envelope:
        """From the first coupled column (n,) of each row; tiles hold whole units of `unit` rows."""
        n, tile = len(first_columns), max(unit, tile_rows // unit * unit)
        starts = np.arange(0, n, tile)
        first = np.minimum.reduceat(first_columns, starts) // tile if n else np.zeros(0, dtype=np.int64)
        heights = np.minimum(tile, n - starts)
        widths = starts + heights - first * tile
        offsets = np.concatenate([[0], np.cumsum(heights * widths)])
        return cls(n, tile, first.astype(np.int64), offsets.astype(np.int64))

    def rows(self, values: Array, i: int) -> Array:
        """Tile row i as a matrix (height, width): a view."""
        height = min(self.tile, self.n - i * self.tile)
        return values[self.offsets[i] : self.offsets[i + 1]].reshape(height, -1)

    def diagonal(self) -> Indices:
        """(n,) positions of the diagonal in `values`."""
        row = np.arange(self.n)
        i = row // self.tile
        height = np.minimum(self.tile, self.n - i * self.tile)
        width = i * self.tile + height - self.first[i] * self.tile
        return self.offsets[i] + (row - i * self.tile) * width + row - self.first[i] * self.tile


@dataclass(frozen=True, eq=False)
class Factor:
    """Lower Cholesky factor L in the shape of its matrix."""

    shape: Envelope
    values: Array

    def forward(self, right: Array) -> Array:
        """`L^-1 right` for right (n, k)."""
        out, tile = np.array(right, dtype=np.float64), self.shape.tile
        for i in range(len(self.shape.first)):
            row = self.shape.rows(self.values, i)
            start, begin = i * tile, self.shape.first[i] * tile
            height = len(row)
            if begin < start:
                out[start : start + height] -= row[:, : start - begin] @ out[begin:start]
            out[start : start + height] = _solve_lower(row[:, start - begin :], out[start : start + height])
        return out

    def backward(self, right: Array) -> Array:
        """`L^-T right` for right (n, k)."""
        out, tile = np.array(right, dtype=np.float64), self.shape.tile
        for i in reversed(range(len(self.shape.first))):
            row = self.shape.rows(self.values, i)
            start, begin = i * tile, self.shape.first[i] * tile
            height = len(row)
            solved = _solve_lower(row[:, start - begin :], out[start : start + height], transposed=True)
            out[start : start + height] = solved
            if begin < start:
                out[begin:start] -= row[:, : start - begin].T @ solved
        return out


def _solve_lower(L: Array, right: Array, transposed: bool = False) -> Array:
    # L is row-major: as Fortran sees it, the upper triangle of its transpose
    return np.asarray(dtrsm(1.0, L.T, right, lower=0, trans_a=0 if transposed else 1))


def cholesky(shape: Envelope, matrix: Array) -> Factor:
    """Factor of the matrix whose lower envelope is `matrix`; raises NotPositiveDefiniteError."""
    factor = Factor(shape, matrix.copy())
    for j in range(len(shape.first)):
        tiles = j + np.flatnonzero(shape.first[j:] <= j)
        _subtract_earlier(factor, j, tiles)
        corner, *below = [_tile(factor, int(i), j) for i in tiles]
        lower, info = dpotrf(corner.T, lower=0, clean=1)
        if info != 0 or not np.isfinite(lower).all():
            raise NotPositiveDefiniteError(f"pivot {info} of tile {j}")
        corner[:] = lower.T
        if below:
            solved = _solve_lower(corner, np.concatenate(below).T).T
            starts = np.cumsum([len(block) for block in below])[:-1]
            for block, rows in zip(below, np.split(solved, starts), strict=True):
                block[:] = rows
    return factor


def _tile(factor: Factor, i: int, j: int) -> Array:
    """Tile (i, j): a view."""
    shape = factor.shape
    left = (j - shape.first[i]) * shape.tile
    return shape.rows(factor.values, i)[:, left : left + shape.tile]


def _subtract_earlier(factor: Factor, j: int, tiles: Indices) -> None:
    """Subtract from each of the `tiles` of column j what the columns before it account for."""
    shape, first = factor.shape, factor.shape.first
    from_tiles = np.maximum(first[tiles], first[j])
    widths = (j - from_tiles) * shape.tile

    def work(begin: int, end: int) -> None:
        own = shape.rows(factor.values, j)
        for k in range(begin, end):
            if widths[k]:
                i, skipped, theirs = tiles[k], from_tiles[k] - first[tiles[k]], from_tiles[k] - first[j]
                row = shape.rows(factor.values, i)[:, skipped * shape.tile :]
                block = _tile(factor, i, j)
                block -= row[:, : widths[k]] @ own[:, theirs * shape.tile :][:, : widths[k]].T

    over_ranges(ranges(widths * float(shape.tile**2), _LEAST_PRODUCTS), work)
