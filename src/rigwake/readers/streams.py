"""Repairs that every reader makes the same way: time order, duplicates, values that are not finite."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rigwake._types import Array, Indices, Stamps
from rigwake.readers.clock_steps import longest_between_steps
from rigwake.recording import Finding

LARGEST_VALUE = 1e9
"""No position (m), rate, force or variance of a vessel is larger: such a value is damage."""


def time_order(sensor: str, timestamps_ns: Stamps) -> tuple[Indices, list[Finding]]:
    """Indices that put the stamps in strictly increasing order (of equal stamps the first stays), and what
    that repaired. Of a clock that was set back the longest stretch stays (`clock_steps`)."""
    stamps = np.asarray(timestamps_ns, dtype=np.int64)
    kept, findings = longest_between_steps(sensor, stamps)
    first, stamps = kept.start or 0, stamps[kept]
    steps = np.diff(stamps)
    order = np.argsort(stamps, kind="stable")
    fresh = np.concatenate([[True], np.diff(stamps[order]) > 0])[: len(order)]
    if (backward := int((steps < 0).sum())) > 0:
        worst_s = -float(steps.min()) * 1e-9
        severity = "error" if worst_s > 1.0 else "warning"
        message = f"time goes back {backward} times, by up to {worst_s:.3g} s; samples were sorted."
        findings.append(Finding(severity, sensor, message))
    if (duplicates := int((~fresh).sum())) > 0:
        message = f"{duplicates} samples repeat the stamp of another; the first of each was kept."
        findings.append(Finding("warning", sensor, message))
    return first + order[fresh], findings


def sane_rows(sensor: str, *columns: ArrayLike) -> tuple[Indices, list[Finding]]:
    """Indices in which every column is finite and of possible size, and how many were dropped."""
    good = np.ones(len(np.asarray(columns[0])), dtype=bool)
    for column in columns:
        values = np.asarray(column, dtype=np.float64)
        sane = np.abs(values) < LARGEST_VALUE  # false for NaN
        good &= sane.all(axis=tuple(range(1, values.ndim)))
    if good.all():
        return np.arange(len(good)), []
    message = f"{int((~good).sum())} samples hold NaN, infinite or impossible values; they were dropped."
    return np.flatnonzero(good), [Finding("warning", sensor, message)]


def usable_rows(
    sensor: str, timestamps_ns: Stamps, *columns: ArrayLike
) -> tuple[Indices, tuple[Finding, ...]]:
    """Indices that are finite, in strictly increasing time order."""
    sane, dropped = sane_rows(sensor, *columns)
    order, sorted_findings = time_order(sensor, np.asarray(timestamps_ns)[sane])
    return sane[order], (*dropped, *sorted_findings)


def unit_quaternions(quaternions: Array) -> Array:
    """The quaternions (N, 4), NaN where they are not of unit length within 5 %."""
    bounded = np.where(np.abs(quaternions) < 2, quaternions, np.nan)
    length: Array = np.sqrt(np.sum(bounded**2, axis=1))
    is_unit = np.abs(length - 1) < 0.05  # false for NaN
    return np.where(is_unit[:, None], bounded, np.nan)


def symmetric_psd(covariances: Array, fallback: float) -> Array:
    """Covariances (N, k, k) made symmetric; those that are zero, negative or not finite become
    `fallback * I`."""
    sane = np.all(np.abs(covariances) < LARGEST_VALUE, axis=(1, 2), keepdims=True)
    bounded = np.where(sane, covariances, 0.0)
    symmetric = (bounded + np.swapaxes(bounded, -1, -2)) / 2
    usable = np.linalg.eigvalsh(symmetric)[:, 0, None, None] > 0
    return np.where(usable, symmetric, fallback * np.eye(symmetric.shape[-1]))
