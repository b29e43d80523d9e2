"""Residuals and biases of IMU and GNSS over time, as charts with what stands behind them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from rigwake.report.adjustment_file import AdjustmentRecord, SensorSeries
from rigwake.report.charts import Series, line_chart

RIG_AXES = ("x", "y", "z")
ENU_AXES = ("east", "north", "up")


@dataclass(frozen=True)
class SensorChart:
    """A chart, its caption, and the names of its three lines, in the palette's order."""

    chart: Markup
    caption: str
    axes: tuple[str, ...]


def sensor_charts(record: AdjustmentRecord) -> dict[str, list[SensorChart]]:
    """By sensor, `IMU` and `GNSS`; empty where the adjustment had none."""
    imu = [
        _residuals("Turn between states less the gyroscope's", record.imu_turn, 1e3, "mrad", RIG_AXES),
        _residuals(
            "Change of velocity between states less the accelerometer's",
            record.imu_speed,
            1e3,
            "mm/s",
            RIG_AXES,
        ),
        _lines("Bias of the gyroscope", record.gyro_bias, 1e3, "mrad/s", RIG_AXES),
        _lines("Bias of the accelerometer", record.accel_bias, 1e3, "mm/s²", RIG_AXES),
    ]
    gnss = [
        _residuals("Antenna as estimated less the fix", record.gnss_off, 1.0, "m", ENU_AXES),
        _lines("Part of it that lasts, as estimated", record.gnss_lasting, 1.0, "m", ENU_AXES),
    ]
    return {
        sensor: charts
        for sensor, found in (("IMU", imu), ("GNSS", gnss))
        if (charts := [c for c in found if c is not None])
    }


def _residuals(
    title: str, series: SensorSeries | None, factor: float, unit: str, axes: tuple[str, ...]
) -> SensorChart | None:
    """Dots, with their spread and how it compares with what was assumed."""
    if series is None:
        return None
    dots = [Series(n, series.at_s, factor * series.values[:, k], k, is_dots=True) for k, n in enumerate(axes)]
    words = [f"{title}, {unit}: {_samples(series)}, rms {_three(factor * _rms(series.values))} {unit}"]
    if series.std is not None:
        whitened = series.values / series.std
        words.append(
            f"assumed (1σ, median) {_three(factor * np.median(series.std, axis=0))} {unit}, "
            f"hence {_three(_rms(whitened))} of it"
        )
    chart = line_chart(title, "time, s", unit, dots, from_zero=False)
    return SensorChart(chart, "; ".join(words) + ".", axes)


def _lines(
    title: str, series: SensorSeries | None, factor: float, unit: str, axes: tuple[str, ...]
) -> SensorChart | None:
    if series is None or not np.any(series.values):
        return None
    lines = [Series(n, series.at_s, factor * series.values[:, k], k) for k, n in enumerate(axes)]
    words = (
        f"{title}, {unit}: {_samples(series)}, mean {_three(factor * np.mean(series.values, axis=0))} {unit}."
    )
    return SensorChart(line_chart(title, "time, s", unit, lines, from_zero=False), words, axes)


def _samples(series: SensorSeries) -> str:
    shown = len(series.at_s)
    return f"{series.count:,} values" if shown >= series.count else f"{shown:,} of {series.count:,} values"


def _rms(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _three(values: np.ndarray) -> str:
    return ", ".join(f"{x:.2g}".replace("-", "−") for x in values.tolist())
