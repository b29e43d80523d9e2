"""One fused pass from the cameras' pictures to the view: no intermediate pictures.

In every cell of 8 x 8 pixels the lookup is bilinear, plus the curvature along and down where the view bends; positions
are 32-bit fixed point (16 bits of fraction), stepped by forward differences. So a pixel costs a few additions, its
bilinear taps, and one weighting per camera that shows it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rigwake._kernels import njit
from rigwake._types import Floats, Image
from rigwake.parallel import over_ranges, ranges
from rigwake.views.lookup import STEP, CoarseLookup


def compose(
    stack: NDArray[np.uint8],
    lookup: CoarseLookup,
    usable: NDArray[np.uint8],
    gains: Floats | None = None,
    shading: Floats | None = None,
    out: Image | None = None,
) -> Image:
    """(H, W, 3) BGR view of a stack of pictures; black where no camera shows anything.

    stack: (C, Hmax, Wmax, 3) uint8, C-contiguous. usable: (C, Hmax, Wmax), 1 where a pixel may be shown.
    gains: (C, 3) factors per camera and channel. shading: (C, R, K) factors at the nodes of the lookup that undo
    vignetting. out: written to if given.
    """
    if out is None:
        out = np.empty((lookup.height_px, lookup.width_px, 3), dtype=np.uint8)
    cameras, rows, columns = lookup.weights.shape
    factors = np.ones((cameras, 3), np.float32) if gains is None else np.asarray(gains, np.float32)
    node_gain = np.ones((1, 1, 1), np.float32) if shading is None else np.asarray(shading, np.float32)
    plain = gains is None and shading is None
    view = out

    def work(first: int, last: int) -> None:
        _compose_rows(
            stack,
            lookup.pixels,
            lookup.bends,
            lookup.weights,
            usable,
            factors,
            node_gain,
            plain,
            view,
            first,
            last,
        )

    over_ranges(ranges(np.full(rows - 1, columns, dtype=np.int64), 20 * columns), work)
    return out


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _corner_state(pixels, weights, c, i, j, height, width):  # type: ignore[no-untyped-def]
    """0: the camera shows nothing in the cell; 1: it lies inside the image altogether; 2: only partly, or unsure."""
    w = max(weights[c, i, j], weights[c, i, j + 1], weights[c, i + 1, j], weights[c, i + 1, j + 1])
    if w <= 0.0:
        return 0
    state = 1
    for a in range(2):
        for b in range(2):
            u, v = pixels[c, i + a, j + b, 0], pixels[c, i + a, j + b, 1]
            if not (u > -16000.0 and u < 32000.0 and v > -16000.0 and v < 32000.0):
                return 0
            if u < 1.0 or v < 1.0 or u > width - 3.0 or v > height - 3.0:
                state = 2
            if weights[c, i + a, j + b] <= 0.0:
                state = 2
    return state


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _compose_rows(stack, pixels, bends, weights, usable, gains, shading, plain, out, first, last):  # type: ignore[no-untyped-def]
    cameras, source_height, source_width = stack.shape[0], stack.shape[1], stack.shape[2]
    height, width = out.shape[0], out.shape[1]
    columns = weights.shape[2]
    flat = stack.reshape(-1)
    flat_usable = usable.reshape(-1)
    stride = source_width * 3
    total = np.empty((STEP * STEP, 4), np.float32)
    for i in range(first, last):
        v0, v1 = i * STEP, min(i * STEP + STEP, height)
        for j in range(columns - 1):
            u0, u1 = j * STEP, min(j * STEP + STEP, width)
            shown, alone, state = 0, -1, 0
            for c in range(cameras):
                s = _corner_state(pixels, weights, c, i, j, source_height, source_width)
                if s > 0:
                    shown += 1
                    alone = c
                    state = max(state, s)
            if shown == 0:
                for v in range(v0, v1):
                    for u in range(u0, u1):
                        out[v, u, 0] = out[v, u, 1] = out[v, u, 2] = 0
                continue
            if shown == 1 and state == 1:
                _one_camera(
                    flat, pixels, bends, gains, shading, plain, out, alone, i, j, v0, v1, u0, u1,
                    alone * source_height * stride, stride,
                )  # fmt: skip
                continue
            for k in range(STEP * STEP):
                total[k, 0] = total[k, 1] = total[k, 2] = total[k, 3] = 0.0
            for c in range(cameras):
                s = _corner_state(pixels, weights, c, i, j, source_height, source_width)
                if s > 0:
                    _blend_camera(
                        flat, flat_usable, pixels, bends, weights, gains, shading, plain, total, c, i, j, v1 - v0,
                        u1 - u0, source_height, source_width, s == 2,
                    )  # fmt: skip
            for v in range(v0, v1):
                for u in range(u0, u1):
                    k = (v - v0) * STEP + u - u0
                    w = total[k, 3]
                    scale = np.float32(1.0) / w if w > 0.0 else np.float32(0.0)
                    for ch in range(3):
                        out[v, u, ch] = min(int(total[k, ch] * scale + np.float32(0.5)), 255)


@njit(nogil=True, error_model="numpy", boundscheck=False, inline="always")
def _fixed(pixels, bends, c, i, j, axis):  # type: ignore[no-untyped-def]
    """Fixed-point position at the cell's corner, its steps along a row and down a column, the twist, and the
    curvatures along and down: `p(k, m) = p00 + k a + m d + k m t + (ca k (k - 8) + cd m (m - 8)) / 128`."""
    p00, p01 = pixels[c, i, j, axis], pixels[c, i, j + 1, axis]
    p10, p11 = pixels[c, i + 1, j, axis], pixels[c, i + 1, j + 1, axis]
    start = np.int32(round(p00 * 65536.0))
    along = np.int32(round((p01 - p00) * 8192.0))
    down = np.int32(round((p10 - p00) * 8192.0))
    twist = np.int32(round((p11 - p10 - p01 + p00) * 1024.0))
    bend_along, bend_down = np.int32(0), np.int32(0)
    if bends.shape[0] > 0:
        bend_along = np.int32(round(bends[c, i, j, axis] * 1024.0))
        bend_down = np.int32(round(bends[c, i, j, axis + 2] * 512.0))
    return start, along, down, twist, bend_along, bend_down


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _one_camera(  # type: ignore[no-untyped-def]
    flat, pixels, bends, gains, shading, plain, out, c, i, j, v0, v1, u0, u1, base, stride
):  # fmt: skip
    """A cell that one camera shows alone."""
    x0, xa, xd, xt, xb, xc = _fixed(pixels, bends, c, i, j, 0)
    y0, ya, yd, yt, yb, yc = _fixed(pixels, bends, c, i, j, 1)
    s0, sa, sd, st = np.float32(1), np.float32(0), np.float32(0), np.float32(0)
    if not plain and shading.shape[0] > 1:
        s0 = shading[c, i, j]
        sa = (shading[c, i, j + 1] - s0) / np.float32(8)
        sd = (shading[c, i + 1, j] - s0) / np.float32(8)
        st = (shading[c, i + 1, j + 1] - shading[c, i + 1, j] - shading[c, i, j + 1] + s0) / np.float32(64)
    g0, g1, g2 = gains[c, 0] * 256.0, gains[c, 1] * 256.0, gains[c, 2] * 256.0
    for v in range(v0, v1):
        k = np.int32(v - v0)
        x, dx = x0 + k * xd + xc * (k * (k - 8)), xa + k * xt - ((7 * xb) >> 1)
        y, dy = y0 + k * yd + yc * (k * (k - 8)), ya + k * yt - ((7 * yb) >> 1)
        f0, f1, f2 = np.int32((s0 + k * sd) * g0), np.int32((s0 + k * sd) * g1), np.int32((s0 + k * sd) * g2)
        ds = sa + k * st
        d0, d1, d2 = np.int32(ds * g0), np.int32(ds * g1), np.int32(ds * g2)
        for u in range(u0, u1):
            at = base + (y >> 16) * stride + (x >> 16) * 3
            fx, fy = (x >> 11) & 31, (y >> 11) & 31
            w11 = fx * fy
            w01, w10 = (fx << 5) - w11, (fy << 5) - w11
            w00 = 1024 - w01 - w10 - w11
            below = at + stride
            b = flat[at] * w00 + flat[at + 3] * w01 + flat[below] * w10 + flat[below + 3] * w11
            g = flat[at + 1] * w00 + flat[at + 4] * w01 + flat[below + 1] * w10 + flat[below + 4] * w11
            r = flat[at + 2] * w00 + flat[at + 5] * w01 + flat[below + 2] * w10 + flat[below + 5] * w11
            if plain:
                out[v, u, 0] = (b + 512) >> 10
                out[v, u, 1] = (g + 512) >> 10
                out[v, u, 2] = (r + 512) >> 10
            else:
                out[v, u, 0] = min((b * f0 + 131072) >> 18, 255)
                out[v, u, 1] = min((g * f1 + 131072) >> 18, 255)
                out[v, u, 2] = min((r * f2 + 131072) >> 18, 255)
                f0 += d0
                f1 += d1
                f2 += d2
            x += dx
            y += dy
            dx += xb
            dy += yb


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _blend_camera(  # type: ignore[no-untyped-def]
    flat, usable, pixels, bends, weights, gains, shading, plain, total, c, i, j, rows, columns, height, width, partly
):  # fmt: skip
    """Add one camera's part of a cell to the weighted sums."""
    x0, xa, xd, xt, xb, xc = _fixed(pixels, bends, c, i, j, 0)
    y0, ya, yd, yt, yb, yc = _fixed(pixels, bends, c, i, j, 1)
    w0 = weights[c, i, j]
    wa, wd = weights[c, i, j + 1] - w0, weights[c, i + 1, j] - w0
    wt = weights[c, i + 1, j + 1] - weights[c, i + 1, j] - wa
    s0, sa, sd, st = np.float32(1), np.float32(0), np.float32(0), np.float32(0)
    if not plain and shading.shape[0] > 1:
        s0 = shading[c, i, j]
        sa, sd = shading[c, i, j + 1] - s0, shading[c, i + 1, j] - s0
        st = shading[c, i + 1, j + 1] - shading[c, i + 1, j] - sa
    eighth = np.float32(0.125)
    base, stride = c * height * width, width * 3
    for k in range(rows):
        x, dx = x0 + k * xd + xc * (k * (k - 8)), xa + k * xt - ((7 * xb) >> 1)
        y, dy = y0 + k * yd + yc * (k * (k - 8)), ya + k * yt - ((7 * yb) >> 1)
        down = np.float32(k) * eighth
        for m in range(columns):
            ix, iy = x >> 16, y >> 16
            fx, fy = (x >> 11) & 31, (y >> 11) & 31
            x += dx
            y += dy
            dx += xb
            dy += yb
            if partly and (
                ix < 0 or iy < 0 or ix >= width - 1 or iy >= height - 1 or usable[base + iy * width + ix] == 0
            ):
                continue
            right = np.float32(m) * eighth
            w = w0 + right * wa + down * (wd + right * wt)
            if w <= 0.0:
                continue
            s = w * (s0 + right * sa + down * (sd + right * st)) * np.float32(1 / 1024)
            w11 = fx * fy
            w01, w10 = (fx << 5) - w11, (fy << 5) - w11
            w00 = 1024 - w01 - w10 - w11
            at = base * 3 + iy * stride + ix * 3
            below = at + stride
            n = k * STEP + m
            for ch in range(3):
                tap = (
                    flat[at + ch] * w00 + flat[at + ch + 3] * w01
                    + flat[below + ch] * w10 + flat[below + ch + 3] * w11
                )  # fmt: skip
                total[n, ch] += np.float32(tap) * s * gains[c, ch]
            total[n, 3] += w
