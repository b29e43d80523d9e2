"""`SensorCheck`: whether one sensor agrees with the others, by which figure, and what is wrong if it does not."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal

from rigwake.errors import InputError

Action = Literal["none", "repaired", "left out", "refused"]


@dataclass(frozen=True)
class SensorCheck:
    """One comparison of a sensor with the others.

    sensor: `gyroscope`, `accelerometer`, `gnss NAME`, `camera NAME`, `imu`.
    agrees: whether the figure is within what the sensor's physics allows.
    statistic, expected: the figure, and the most that it may be. quantity: what the figure is, with its unit.
    hypothesis: what is wrong, in one sentence with figures; what was noticed, where it agrees; or empty.
    remedy: what to do about it. action: what came of it. part: what of the sensor is judged, where it
    is its lens alone.
    """

    sensor: str
    agrees: bool
    statistic: float
    expected: float
    hypothesis: str = ""
    remedy: str = ""
    quantity: str = ""
    action: Action = "none"
    part: Literal["", "lens"] = ""

    def with_action(self, action: Action) -> SensorCheck:
        """The same check, with what came of it."""
        return replace(self, action=action)

    @property
    def sentence(self) -> str:
        """Sensor, cause and remedy in words."""
        return " ".join(part for part in (f"{self.sensor}: {self.hypothesis}", self.remedy) if part)


def disagreeing(checks: Iterable[SensorCheck]) -> tuple[SensorCheck, ...]:
    """The checks of sensors that do not agree with the others, and of which nothing has come yet."""
    return tuple(check for check in checks if not check.agrees and check.action == "none")


def refuse(checks: Iterable[SensorCheck], consequence: str = "No rig is estimated from it.") -> None:
    """Raise InputError that names every disagreement without a repair; nothing happens where there is none."""
    wrong = disagreeing(checks)
    if not wrong:
        return
    causes = " ".join(f"{check.sensor}: {check.hypothesis}" for check in wrong)
    remedies = " ".join(dict.fromkeys(check.remedy for check in wrong if check.remedy))
    raise InputError(causes, consequence=consequence, remedy=remedies)


def checks_to_list(checks: Iterable[SensorCheck]) -> list[dict[str, Any]]:
    """Checks as plain values for JSON and the calibration file; figures that are not finite become None."""
    return [
        {
            "sensor": check.sensor,
            "agrees": check.agrees,
            "quantity": check.quantity,
            "statistic": _finite(check.statistic),
            "expected": _finite(check.expected),
            "hypothesis": check.hypothesis,
            "remedy": check.remedy,
            "action": check.action,
            "part": check.part,
        }
        for check in checks
    ]


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
