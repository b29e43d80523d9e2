"""NMEA 0183 logs of satellite receivers and compasses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import date
from math import isfinite, nan
from pathlib import Path

import numpy as np

from rigwake._types import Stamps
from rigwake.errors import InputError
from rigwake.geometry import so3
from rigwake.readers.csv_sensors import Findings
from rigwake.readers.gnss_fixes import gnss_stream_of_fixes
from rigwake.readers.nmea_sentences import Sentence, sentences
from rigwake.readers.streams import usable_rows
from rigwake.recording import AttitudeStream, Finding, GnssStream, Recording

_DAY_NS = 86_400 * 10**9
_HEADING_STD = np.radians(1.0)
_UNKNOWN_TILT_STD = 10.0  # radians: roll and pitch are not measured by a compass
_LARGEST_HDOP = 50.0  # receivers without satellites send 99.9
_USUAL_HDOP = 5.0 / 3.0
# Standard deviation east and north per unit of HDOP, by the quality of GGA; others are no measured position
_METRES_PER_HDOP = {1: 3.0, 2: 1.0, 3: 1.0, 4: 0.02, 5: 0.3, 8: 3.0, 9: 1.0}
_NO_SATELLITES = {6: "dead reckoning", 7: "entered by hand"}
_GNS_QUALITY = {"A": 1, "D": 2, "P": 3, "R": 4, "F": 5, "E": 6, "M": 7, "S": 8}
_POSITION_KINDS = ("GGA", "GNS", "RMC", "GLL")
_SATELLITE_TALKERS = frozenset({"GP", "GN", "GL", "GA", "GB", "BD", "GQ", "QZ", "GI"})


@dataclass(frozen=True)
class _Fix:
    """One position: of which talker, when (index of a moment), degrees, metres, standard deviation ENU in metres."""

    talker: str
    moment: int
    lla: tuple[float, float, float]
    std_m: float
    quality: int


@dataclass
class _Log:
    """What the sentences have said so far.

    moments: nanoseconds since the midnight before the first sentence, of each sentence that holds a time. days: by
    moment, the days since 1970 that its date says minus the midnights passed.
    """

    moments: list[int] = field(default_factory=list)
    days: dict[int, int] = field(default_factory=dict)
    uncertain_days: dict[int, int] = field(default_factory=dict)
    fixes: dict[str, list[_Fix]] = field(default_factory=lambda: {kind: [] for kind in _POSITION_KINDS})
    std_enu: dict[tuple[str, int], tuple[float, float, float]] = field(default_factory=dict)
    headings: list[tuple[int, float]] = field(default_factory=list)
    separation_m: dict[str, float] = field(default_factory=dict)
    damaged: int = 0
    left_out: dict[str, int] = field(default_factory=dict)


def read_nmea(path: Path, name: str = "gnss") -> tuple[GnssStream, AttitudeStream | None, Findings]:
    """Positions (GGA, else GNS, RMC, GLL; with GST for their spread), and true heading (HDT, THS) as attitude.

    Times of day get the date of the RMC or ZDA nearest before them; without any they count from 1970-01-01.
    Sentences with a wrong checksum and dead reckoning are left out; of several receivers the best is taken. Raises
    InputError if there is no position.
    """
    log = _Log()
    try:
        for sentence in sentences(path):
            _add_sentence(sentence, log)
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).") from error
    most = max(map(len, log.fixes.values()))
    fixes = next(fixes for fixes in log.fixes.values() if 10 * len(fixes) >= most)
    findings = _said(log, name)
    if not fixes:
        causes = " ".join(finding.message for finding in findings)
        raise InputError(f"{path} holds no position (GGA, GNS, RMC or GLL with a fix). {causes}".strip())
    stamps = _absolute_times(log)
    fixes, chosen = _one_receiver(fixes, stamps, name)
    lla = np.array([fix.lla for fix in fixes])
    std = np.array([_std_enu(fix, log) for fix in fixes])
    stream, repaired = gnss_stream_of_fixes(
        name,
        stamps[[fix.moment for fix in fixes]],
        lla,
        np.einsum("ni,ij->nij", std**2, np.eye(3)),
        topic=path.name,
    )
    attitude = _attitude(log, stamps, path)
    return stream, attitude, (*findings, *chosen, *repaired)


def nmea_recording(path: Path) -> Recording:
    """A recording of one NMEA log."""
    gnss, attitude, findings = read_nmea(path)
    attitudes = {} if attitude is None else {attitude.name: attitude}
    return Recording(path, "nmea log", gnss={gnss.name: gnss}, attitudes=attitudes, findings=findings)


def _said(log: _Log, name: str) -> list[Finding]:
    findings = []
    if log.damaged:
        findings.append(Finding("warning", name, f"{log.damaged} damaged sentences were dropped."))
    for what, count in log.left_out.items():
        findings.append(Finding("warning", name, f"{count} positions were {what}; they were left out."))
    if log.moments and not log.days and not log.uncertain_days:
        findings.append(Finding("warning", name, "no sentence holds a date: times count from 1970-01-01."))
    return findings


def _add_sentence(sentence: Sentence, log: _Log) -> None:
    add = _ADDERS.get(sentence.kind)
    known = len(log.moments)
    if not sentence.is_whole:
        log.damaged += 1
    elif add is not None:
        try:
            add(sentence, log)
        except (ValueError, IndexError, OverflowError):
            log.damaged += 1
        if sentence.logged_s is not None and len(log.moments) > known:
            days = round((sentence.logged_s * 10**9 - log.moments[-1]) / _DAY_NS)
            log.uncertain_days.setdefault(len(log.moments) - 1, days)


def _moment(text: str, log: _Log) -> int:
    """The index of a moment given as hhmmss.sss, unwrapped over midnights: no step is longer than half a day."""
    hours, minutes, seconds = int(text[:2]), int(text[2:4]), float(text[4:])
    if not (hours < 24 and minutes < 60 and 0 <= seconds < 61):
        raise ValueError(text)
    at = (hours * 60 + minutes) * 60 * 10**9 + round(seconds * 1e9)
    if log.moments:
        at += round((log.moments[-1] - at) / _DAY_NS) * _DAY_NS
    log.moments.append(at)
    return len(log.moments) - 1


def _add_date(log: _Log, moment: int, day: date, *, uncertain: bool = False) -> None:
    days = (day - date(1970, 1, 1)).days - log.moments[moment] // _DAY_NS
    (log.uncertain_days if uncertain or day.year < 1990 else log.days)[moment] = days


def _absolute_times(log: _Log) -> Stamps:
    """(N,) nanoseconds since 1970 of all moments.

    Each date holds from its sentence on. A date that its neighbours on both sides contradict (receivers change it a
    sentence late at midnight) is outvoted.
    """
    known = log.days or log.uncertain_days
    moments = np.array(log.moments, dtype=np.int64)
    if not known:
        return moments
    at = np.array(sorted(known))
    days = np.array([known[int(i)] for i in at])
    voted = [_vote(days, i) for i in range(len(days))]
    index = np.maximum(np.searchsorted(at, np.arange(len(moments)), side="right") - 1, 0)
    return moments + np.array(voted, dtype=np.int64)[index] * _DAY_NS


def _vote(days: Stamps, at: int) -> int:
    """The most frequent of a date and up to two on each side; its own where that is one of several."""
    nearby = days[max(0, at - 2) : at + 3].tolist()
    counts = {day: nearby.count(day) for day in nearby}
    best = max(counts.values())
    return int(days[at]) if counts[int(days[at])] == best else next(d for d in nearby if counts[d] == best)


def _degrees(value: str, hemisphere: str, positive: str, negative: str) -> float:
    """Degrees of `ddmm.mmmm` or `dddmm.mmmm`; ValueError for what is none."""
    point = value.index(".") if "." in value else len(value)
    degrees, minutes = float(value[: point - 2] or 0), float(value[point - 2 :])
    if minutes >= 60 or not isfinite(degrees) or hemisphere not in (positive, negative):
        raise ValueError(value)
    return (degrees + minutes / 60) * (1 if hemisphere == positive else -1)


def _place(fields: tuple[str, ...], at: int) -> tuple[float, float]:
    latitude = _degrees(fields[at], fields[at + 1], "N", "S")
    longitude = _degrees(fields[at + 2], fields[at + 3], "E", "W")
    if abs(latitude) > 90 or abs(longitude) > 180:
        raise ValueError(fields)
    return latitude, longitude


def _number(text: str) -> float:
    value = float(text) if text else nan
    return value if isfinite(value) else nan


def _add_fix(
    log: _Log,
    sentence: Sentence,
    time_field: str,
    place: int,
    quality: int,
    hdop: str,
    height: tuple[str, str],
) -> int | None:
    """Adds a position; returns its moment."""
    moment = _moment(time_field, log)
    if quality == 0 or not sentence.fields[place]:
        return None
    latitude, longitude = _place(sentence.fields, place)
    if quality not in _METRES_PER_HDOP:
        what = _NO_SATELLITES.get(quality, f"of quality {quality}")
        log.left_out[what] = log.left_out.get(what, 0) + 1
        return None
    altitude, separation = map(_number, height)
    if isfinite(separation):
        log.separation_m[sentence.talker] = separation
    else:
        separation = log.separation_m.get(sentence.talker, 0.0)
    dilution = _number(hdop)
    if not 0 < dilution < _LARGEST_HDOP:
        dilution = _USUAL_HDOP
    fix = _Fix(
        sentence.talker,
        moment,
        (latitude, longitude, altitude + separation),  # ellipsoidal height; NaN if it is not said
        _METRES_PER_HDOP[quality] * dilution,
        quality,
    )
    log.fixes[sentence.kind].append(fix)
    return moment


def _add_gga(sentence: Sentence, log: _Log) -> None:
    f = sentence.fields
    if f[0]:
        _add_fix(log, sentence, f[0], 1, int(f[5] or 0), f[7], (f[8], f[10]))


def _add_gns(sentence: Sentence, log: _Log) -> None:
    f = sentence.fields
    modes = [_GNS_QUALITY.get(mode, 0) for mode in f[5]]
    best = max((m for m in modes if m in _METRES_PER_HDOP), default=max(modes, default=0))
    if f[0]:
        _add_fix(log, sentence, f[0], 1, best, f[7], (f[8], f[9]))


def _add_rmc(sentence: Sentence, log: _Log) -> None:
    f = sentence.fields
    if not f[0]:
        return
    moment = _add_fix(log, sentence, f[0], 2, 1 if f[1] == "A" else 0, "", ("", ""))
    if f[8]:
        year = int(f[8][4:6])
        day = date(2000 + year if year < 80 else 1900 + year, int(f[8][2:4]), int(f[8][:2]))
        _add_date(log, len(log.moments) - 1, day, uncertain=moment is None)


def _add_gll(sentence: Sentence, log: _Log) -> None:
    f = sentence.fields
    if f[4]:
        _add_fix(log, sentence, f[4], 0, 1 if f[5][:1] == "A" else 0, "", ("", ""))


def _add_zda(sentence: Sentence, log: _Log) -> None:
    f = sentence.fields
    if f[0] and f[1] and f[2] and f[3]:
        _add_date(log, _moment(f[0], log), date(int(f[3]), int(f[2]), int(f[1])))


def _add_gst(sentence: Sentence, log: _Log) -> None:
    f = sentence.fields
    if f[0]:
        latitude, longitude, up = (_number(text) for text in f[5:8])
        moment = _moment(f[0], log)
        if latitude > 0 and longitude > 0:
            log.std_enu[sentence.talker, log.moments[moment]] = (longitude, latitude, up if up > 0 else nan)


def _add_heading(sentence: Sentence, log: _Log) -> None:
    heading = float(sentence.fields[0]) if sentence.fields[0] else nan
    is_true = sentence.kind == "HDT" or sentence.fields[1:2] in (("A",), ("E",), ())
    if log.moments and is_true and isfinite(heading):
        log.headings.append((len(log.moments) - 1, heading))


_ADDERS: dict[str, Callable[[Sentence, _Log], None]] = {
    "GGA": _add_gga,
    "GNS": _add_gns,
    "RMC": _add_rmc,
    "GLL": _add_gll,
    "ZDA": _add_zda,
    "GST": _add_gst,
    "HDT": _add_heading,
    "THS": _add_heading,
}


def _std_enu(fix: _Fix, log: _Log) -> tuple[float, float, float]:
    """Standard deviations of a fix: of the GST of its talker and time, else by HDOP and quality."""
    assumed = (fix.std_m, fix.std_m, 2 * fix.std_m)
    stated = log.std_enu.get((fix.talker, log.moments[fix.moment]))
    if stated is None:
        return assumed
    east, north, up = stated
    return east, north, up if isfinite(up) else assumed[2]


def _one_receiver(fixes: list[_Fix], stamps: Stamps, name: str) -> tuple[list[_Fix], list[Finding]]:
    """The fixes of the best receiver of a log, and what was left out.

    A receiver may change its talker with the satellites it uses (GP, GN): its fixes keep one rhythm. Fixes of two
    receivers come between each other.
    """
    talkers = list(dict.fromkeys(fix.talker for fix in fixes))
    if len(talkers) < 2:
        return fixes, []
    times = {t: np.unique([stamps[fix.moment] for fix in fixes if fix.talker == t]) for t in talkers}
    satellite = [t for t in talkers if t in _SATELLITE_TALKERS]
    together = _groups(satellite, times) + [[t] for t in talkers if t not in satellite]
    if len(together) == 1:
        return fixes, []

    def worth(group: list[str]) -> tuple[float, int]:
        own = [fix for fix in fixes if fix.talker in group]
        return -float(np.median([fix.std_m for fix in own])), len(own)

    best = max(together, key=worth)
    kept = [fix for fix in fixes if fix.talker in best]
    message = (
        f"positions of {len(together)} receivers ({', '.join(talkers)}): those of {', '.join(best)} are used, "
        f"{len(fixes) - len(kept)} others were left out."
    )
    return kept, [Finding("warning", name, message)]


def _groups(talkers: list[str], times: dict[str, Stamps]) -> list[list[str]]:
    """Talkers whose fixes keep one rhythm together."""
    groups: list[list[str]] = []
    for talker in talkers:
        for group in groups:
            if all(_one_rhythm(times[talker], times[other]) for other in group):
                group.append(talker)
                break
        else:
            groups.append([talker])
    return groups


def _one_rhythm(a: Stamps, b: Stamps) -> bool:
    """Whether few steps of all times together are shorter than half the usual step of one."""
    own = [np.diff(times) for times in (a, b) if len(times) > 1]
    usual = min((float(np.median(steps)) for steps in own), default=1e9)
    steps = np.diff(np.sort(np.concatenate([a, b])))
    return bool(np.mean(steps < 0.5 * usual) < 0.1)


def _attitude(log: _Log, stamps: Stamps, path: Path) -> AttitudeStream | None:
    """Heading is clockwise from north; yaw is counter-clockwise from east: `yaw = 90 deg - heading`."""
    if not log.headings:
        return None
    at = stamps[[moment for moment, _ in log.headings]]
    yaw = np.pi / 2 - np.radians([heading for _, heading in log.headings])
    rows, _ = usable_rows("heading", at, yaw)
    rotations = so3.exp(np.outer(yaw[rows], [0.0, 0.0, 1.0]))
    std = np.array([_UNKNOWN_TILT_STD, _UNKNOWN_TILT_STD, _HEADING_STD])
    spread = np.broadcast_to(np.diag(std**2), rotations.shape).copy()
    return AttitudeStream("heading", at[rows], rotations, spread, path.name)
