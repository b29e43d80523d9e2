"""Charts as inline SVG: themed by the page's CSS, sharp in print, readable without scripts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from markupsafe import Markup, escape

from rigwake._types import Array
from rigwake.report.reduce import ImageMap

WIDTH, HEIGHT = 480.0, 220.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 54.0, 26.0, 26.0, 42.0
CLOUD_REACH = 1.0
_SHADES = 12
COLOURS = 8
"""Length of the palette; series beyond it differ by dashes as well."""


@dataclass(frozen=True, eq=False)
class Series:
    """A line: x, y (N,), NaN breaks it; upper: the other edge of a band above the line; colour: of the palette;
    is_dots: points that are not joined."""

    label: str
    x: Array
    y: Array
    colour: int = 0
    upper: Array | None = None
    is_dots: bool = False


def ticks(low: float, high: float, about: int = 5) -> list[float]:
    """Round values inside an interval."""
    span = high - low
    if not np.isfinite(span) or span <= 0:
        return [low]
    raw = span / about
    power = 10.0 ** np.floor(np.log10(raw))
    step = float(min((m * power for m in (1, 2, 2.5, 5, 10)), key=lambda s: abs(s - raw)))
    first = np.ceil(low / step - 1e-9)
    return [float(k * step) + 0.0 for k in np.arange(first, np.floor(high / step + 1e-9) + 1)]


def axis_text(value: float) -> str:
    """A number as it stands at an axis."""
    return f"{value + 0.0:.6g}".replace("-", "−")


def line_chart(
    title: str, x_label: str, y_label: str, series: Sequence[Series], from_zero: bool = True
) -> Markup:
    """Lines over a common axis; the title names the chart for those who cannot see it."""
    drawn = [s for s in series if np.isfinite(s.y).any()]
    if not drawn:
        return Markup("")
    x_low, x_high = _range([s.x for s in drawn])
    x_low = 0.0 if 0 < x_low < 0.05 * x_high else x_low
    y_low, y_high = _range([v for s in drawn for v in (s.y, s.upper) if v is not None])
    y_low = min(0.0, y_low) if from_zero else y_low
    pad = 0.06 * (y_high - y_low or 1.0)
    y_high, y_low = y_high + pad, y_low if from_zero and y_low == 0 else y_low - pad
    sx = (WIDTH - _LEFT - _RIGHT) / ((x_high - x_low) or 1.0)
    sy = (HEIGHT - _TOP - _BOTTOM) / (y_high - y_low)

    def at(x: Array, y: Array) -> list[str]:
        u, v = _LEFT + (x - x_low) * sx, HEIGHT - _BOTTOM - (y - y_low) * sy
        return [f"{a:.1f},{b:.1f}" for a, b in zip(u.tolist(), v.tolist(), strict=True)]

    parts = []
    for y in ticks(y_low, y_high):
        v = HEIGHT - _BOTTOM - (y - y_low) * sy
        parts.append(f'<path class="grid" d="M{_LEFT:.1f},{v:.1f}H{WIDTH - _RIGHT:.1f}"/>')
        parts.append(
            f'<text class="tick" x="{_LEFT - 6:.1f}" y="{v + 4:.1f}" text-anchor="end">{axis_text(y)}</text>'
        )
    for x in ticks(x_low, x_high):
        u = _LEFT + (x - x_low) * sx
        parts.append(
            f'<text class="tick" x="{u:.1f}" y="{HEIGHT - _BOTTOM + 16:.1f}" text-anchor="middle">{axis_text(x)}</text>'
        )
    for one in drawn:
        parts += _line(one, at)
    parts.append(
        f'<text class="axis" x="{(WIDTH + _LEFT) / 2:.1f}" y="{HEIGHT - 6:.1f}" '
        f'text-anchor="middle">{escape(x_label)}</text>'
        f'<text class="axis" x="4" y="14">{escape(y_label)}</text>'
    )
    return svg(title, WIDTH, HEIGHT, parts, "chart")


def _range(values: Sequence[Array]) -> tuple[float, float]:
    finite = np.concatenate([v[np.isfinite(v)] for v in values])
    return float(finite.min()), float(finite.max())


def _line(series: Series, at) -> list[str]:  # type: ignore[no-untyped-def]
    """The line, broken where there is no number, and its band."""
    css = f"c{series.colour % COLOURS}{' dashed' if series.colour >= COLOURS else ''}"
    known = np.isfinite(series.y) & np.isfinite(series.x)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    parts = []
    if series.is_dots:
        dots = "".join(f"M{point}h0" for point in at(series.x[known], series.y[known]))
        return [f'<path class="dots {css}" d="{dots}"/>']
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        x, y = series.x[start:end], series.y[start:end]
        if series.upper is not None:
            outline = at(x, series.upper[start:end]) + at(x, y)[::-1]
            parts.append(f'<polygon class="band {css}" points="{" ".join(outline)}"/>')
        points = at(x, y)
        if len(points) == 1:
            u, v = points[0].split(",")
            parts.append(f'<circle class="dot {css}" cx="{u}" cy="{v}" r="2.5"/>')
        else:
            parts.append(f'<polyline class="line {css}" points="{" ".join(points)}"/>')
    return parts


def image_map(title: str, data: ImageMap, colour: int) -> Markup:
    """Coverage as shaded cells, mean residuals as arrows whose scale is stated beside them."""
    rows, columns = data.counts.shape
    width, height = 300.0, 300.0 * data.height_px / data.width_px
    du, dv = width / columns, height / rows
    most = max(float(data.counts.max()), 1.0)
    parts = [f'<rect class="frame" width="{width:.1f}" height="{height:.1f}"/>']
    # one element per shade: thousands of them make a page slow
    shades = np.ceil(_SHADES * np.sqrt(data.counts / most)).astype(int)
    for shade in np.unique(shades[shades > 0]).tolist():
        cells = "".join(
            f"M{c * du:.1f},{r * dv:.1f}h{du:.2f}v{dv:.2f}h{-du:.2f}z"
            for r, c in zip(*np.nonzero(shades == shade), strict=True)
        )
        opacity = f'fill-opacity="{0.12 + 0.6 * shade / _SHADES:.2f}"'
        parts.append(f'<path class="cell c{colour % COLOURS}" {opacity} d="{cells}"/>')
    if data.mean_px is not None:
        parts += _arrows(data.mean_px, du, dv)
    return svg(title, width, height, parts, "map")


def arrow_scale(data: ImageMap) -> float:
    """Pixels of residual that an arrow as long as a cell stands for."""
    if data.mean_px is None:
        return 0.0
    size = np.linalg.norm(data.mean_px, axis=-1)
    return float(np.nanquantile(size, 0.95)) if np.isfinite(size).any() else 0.0


def _arrows(mean_px: Array, du: float, dv: float) -> list[str]:
    scale = arrow_scale(ImageMap(1, 1, np.zeros((1, 1)), mean_px)) or 1.0
    lines, tails = [], []
    for r, c in zip(*np.nonzero(np.isfinite(mean_px).all(axis=-1)), strict=True):
        u, v = mean_px[r, c] / scale * min(du, dv)
        start = f"M{(c + 0.5) * du:.1f},{(r + 0.5) * dv:.1f}"
        lines.append(f"{start}l{u:.2f},{v:.2f}")
        tails.append(f"{start}h0")
    return [f'<path class="arrow" d="{"".join(lines)}"/>', f'<path class="tail" d="{"".join(tails)}"/>']


def top_view(title: str, paths: Sequence[Series], unit: str = "m", cloud: Sequence[Series] = ()) -> Markup:
    """Paths seen from above at one scale, over a grid whose lines are named in `unit`; squares mark the starts.

    cloud: points below the paths; what lies further out than `CLOUD_REACH` times the paths' extent is left out.
    """
    drawn = [s for s in paths if np.isfinite(s.y).any()]
    if not drawn:
        return Markup("")
    (x_low, x_high), (y_low, y_high) = _range([s.x for s in drawn]), _range([s.y for s in drawn])
    near = [_near(s, (x_low, x_high), (y_low, y_high)) for s in cloud]
    (x_low, x_high), (y_low, y_high) = (
        _range([s.x for s in (*drawn, *near)]),
        _range([s.y for s in (*drawn, *near)]),
    )
    span = max(x_high - x_low, y_high - y_low, 1e-6)
    width, left, margin, bottom = 460.0, 44.0, 14.0, 40.0
    scale = (width - left - margin) / span
    height = (y_high - y_low) * scale + 2 * margin + bottom

    def at(x: Array, y: Array) -> list[str]:
        u, v = left + (x - x_low) * scale, height - margin - bottom - (y - y_low) * scale
        return [f"{a:.1f},{b:.1f}" for a, b in zip(u.tolist(), v.tolist(), strict=True)]

    parts = []
    for x in _multiples(x_low, x_high, span):
        u, label = left + (x - x_low) * scale, f'text-anchor="middle">{axis_text(x)}</text>'
        parts.append(f'<path class="grid" d="M{u:.1f},{margin:.1f}V{height - bottom:.1f}"/>')
        parts.append(f'<text class="tick" x="{u:.1f}" y="{height - bottom + 15:.1f}" {label}')
    for y in _multiples(y_low, y_high, span):
        v, label = height - margin - bottom - (y - y_low) * scale, f'text-anchor="end">{axis_text(y)}</text>'
        parts.append(f'<path class="grid" d="M{left:.1f},{v:.1f}H{width - margin:.1f}"/>')
        parts.append(f'<text class="tick" x="{left - 5:.1f}" y="{v + 4:.1f}" {label}')
    for series in near:
        dots = "".join(f"M{point}h0" for point in at(series.x, series.y))
        parts.append(f'<path class="cloud c{series.colour % COLOURS}" d="{dots}"/>')
    for series in drawn:
        parts += _line(series, at)
        u_, v_ = at(series.x[:1], series.y[:1])[0].split(",")
        parts.append(
            f'<rect class="dot c{series.colour % COLOURS}" x="{float(u_) - 4:.1f}" y="{float(v_) - 4:.1f}" '
            'width="8" height="8"/>'
        )
    words = f"{x_high - x_low:.3g} {unit} across, {y_high - y_low:.3g} {unit} along"
    parts.append(
        f'<text class="axis" x="{(width + left) / 2:.1f}" y="{height - 6:.1f}" text-anchor="middle">'
        f"{escape(words)}</text>"
    )
    return svg(title, width, height, parts, "map")


def _multiples(low: float, high: float, span: float) -> list[float]:
    """Inside an interval, the multiples of the step that suits a `span`."""
    marks = ticks(0.0, span)
    step = marks[1] if len(marks) > 1 else span
    return [float(k * step) for k in np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1)]


def _near(cloud: Series, x: tuple[float, float], y: tuple[float, float]) -> Series:
    """The points of a cloud about a box."""
    reach = CLOUD_REACH * max(x[1] - x[0], y[1] - y[0])
    inside = (cloud.x > x[0] - reach) & (cloud.x < x[1] + reach)
    inside &= (cloud.y > y[0] - reach) & (cloud.y < y[1] + reach)
    return replace(cloud, x=cloud.x[inside], y=cloud.y[inside])


def svg(title: str, width: float, height: float, parts: Sequence[str], css: str) -> Markup:
    """A drawing whose elements are `parts`. css: `chart` or `map`, which differ in their largest width."""
    head = (
        f'<svg class="{css}" viewBox="0 0 {width:.1f} {height:.1f}" role="img" aria-label="{escape(title)}">'
    )
    return Markup(head + "".join(parts) + "</svg>")
