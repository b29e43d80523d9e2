"""NMEA 0183 logs of satellite receivers and compasses."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, date, datetime, time
from pathlib import Path
from typing import Any

import numpy as np
import pynmea2

from rigwake.errors import InputError
from rigwake.geometry import so3
from rigwake.geometry.geodesy import enu_from_lla
from rigwake.readers.csv_sensors import UNKNOWN_GNSS_VARIANCE, Findings
from rigwake.readers.streams import usable_rows
from rigwake.recording import AttitudeStream, Finding, GnssStream, Recording

_MAX_LINE = 4096
_DAY_NS = 86_400 * 10**9
_HEADING_STD = np.radians(1.0)
_UNKNOWN_TILT_STD = 10.0  # radians: roll and pitch are not measured by a compass
_METRES_PER_HDOP = 3.0


@dataclass
class _Log:
    """What the sentences have said so far."""

    day: date | None = None
    midnights: int = 0
    last_time_ns: int = -1
    fixes: list[tuple[int, float, float, float, float, float, float]] = field(default_factory=list)
    std_enu: dict[int, tuple[float, float, float]] = field(default_factory=dict)
    headings: list[tuple[int, float]] = field(default_factory=list)
    damaged: int = 0


def looks_like_nmea(start: bytes) -> bool:
    """Whether a file begins with an NMEA sentence."""
    return start[:1] in b"$!" and start[1:6].isalnum() and b"," in start[:12]


def read_nmea(path: Path, name: str = "gnss") -> tuple[GnssStream, AttitudeStream | None, Findings]:
    """Positions (GGA, with GST for their spread), and true heading (HDT, THS) as attitude.

    Times of day get their date from RMC or ZDA; without one they count from 1970-01-01. Sentences with a
    wrong checksum are dropped. Raises InputError if there is no position.
    """
    log = _Log()
    try:
        with path.open("rb") as file:
            while line := file.readline(_MAX_LINE):
                _add_sentence(line.decode("ascii", "replace").strip(), log)
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).") from error
    if not log.fixes:
        raise InputError(f"{path} holds no position (GGA sentence with a fix).")
    fixes = np.array([fix[1:] for fix in log.fixes])
    since_midnight = np.array([fix[0] for fix in log.fixes], dtype=np.int64)
    start_ns = _start_of_day_ns(log)
    rows, repaired = usable_rows(name, since_midnight, fixes[:, :3])
    lla = fixes[rows, :3]
    origin = (float(lla[0, 0]), float(lla[0, 1]), float(lla[0, 2]))
    std = np.array([log.std_enu.get(int(since_midnight[row]), tuple(fixes[row, 3:])) for row in rows])
    covariances = np.einsum("ni,ij->nij", std**2, np.eye(3))
    stream = GnssStream(
        name, since_midnight[rows] + start_ns, enu_from_lla(lla, origin), covariances, origin, topic=path.name
    )
    findings = list(repaired)
    if log.damaged:
        findings.append(Finding("warning", name, f"{log.damaged} damaged sentences were dropped."))
    if log.day is None:
        findings.append(Finding("warning", name, "no sentence holds a date: times count from 1970-01-01."))
    return stream, _attitude(log, start_ns, path), tuple(findings)


def nmea_recording(path: Path) -> Recording:
    """A recording of one NMEA log."""
    gnss, attitude, findings = read_nmea(path)
    attitudes = {} if attitude is None else {attitude.name: attitude}
    return Recording(path, "nmea log", gnss={gnss.name: gnss}, attitudes=attitudes, findings=findings)


def _start_of_day_ns(log: _Log) -> int:
    day = log.day or date(1970, 1, 1)
    return int(datetime.combine(day, time(), UTC).timestamp()) * 10**9 - log.midnights * _DAY_NS


def _add_sentence(line: str, log: _Log) -> None:
    if not line.startswith(("$", "!")):
        return
    try:
        sentence = pynmea2.parse(line, check="*" in line)
        kind = sentence.sentence_type
        if kind in ("RMC", "ZDA"):
            stamp = sentence.datetime
            log.day = stamp.date() if stamp else log.day
        elif kind == "GGA":
            _add_fix(sentence, log)
        elif kind == "GST" and sentence.timestamp:
            std = (float(sentence.std_dev_longitude), float(sentence.std_dev_latitude))
            at = _time_ns(sentence.timestamp, log)
            log.std_enu[at] = (*std, float(sentence.std_dev_altitude))
        elif kind in ("HDT", "THS") and log.last_time_ns >= 0:
            log.headings.append((log.last_time_ns, float(sentence.data[0])))
    except (pynmea2.ParseError, ValueError, TypeError, AttributeError, IndexError, KeyError):
        log.damaged += 1


def _time_ns(moment: Any, log: _Log) -> int:
    """Nanoseconds since the midnight before the first sentence; a step back by half a day is midnight."""
    seconds = (moment.hour * 60 + moment.minute) * 60 + moment.second
    at = (seconds * 10**6 + moment.microsecond) * 1000 + log.midnights * _DAY_NS
    if log.last_time_ns - at > _DAY_NS // 2:
        log.midnights += 1
        at += _DAY_NS
    log.last_time_ns = max(log.last_time_ns, at)
    return at


def _add_fix(sentence: Any, log: _Log) -> None:
    if not sentence.timestamp or not sentence.lat or int(sentence.gps_qual or 0) == 0:
        return
    altitude = float(sentence.altitude or 0.0) + float(sentence.geo_sep or 0.0)  # ellipsoidal height
    std = _METRES_PER_HDOP * float(sentence.horizontal_dil or 0.0) or UNKNOWN_GNSS_VARIANCE**0.5
    at = _time_ns(sentence.timestamp, log)
    log.fixes.append((at, sentence.latitude, sentence.longitude, altitude, std, std, 2 * std))


def _attitude(log: _Log, start_ns: int, path: Path) -> AttitudeStream | None:
    """Heading is clockwise from north; yaw is counter-clockwise from east: `yaw = 90 deg - heading`."""
    if not log.headings:
        return None
    stamps = np.array([at for at, _ in log.headings], dtype=np.int64) + start_ns
    yaw = np.pi / 2 - np.radians([heading for _, heading in log.headings])
    rows, _ = usable_rows("heading", stamps, yaw)
    rotations = so3.exp(np.outer(yaw[rows], [0.0, 0.0, 1.0]))
    std = np.array([_UNKNOWN_TILT_STD, _UNKNOWN_TILT_STD, _HEADING_STD])
    spread = np.broadcast_to(np.diag(std**2), rotations.shape).copy()
    return AttitudeStream("heading", stamps[rows], rotations, spread, path.name)
