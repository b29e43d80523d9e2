"""A vessel's logbook: one SQLite file. What `add` acknowledged survives a power cut; nothing is ever half-written."""

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import quote

import yaml

from rigwake.calibration import Calibration
from rigwake.calibration.yaml_file import calibration_from_dict, calibration_to_dict
from rigwake.errors import InputError, RigwakeError, UsageError
from rigwake.logbook.vessel_fingerprint import VesselFingerprint, fingerprint_of_calibration
from rigwake.yaml_input import parse_yaml

SCHEMA_VERSION = 1
_APPLICATION_ID = 0x72676C67  # "rglg"
_BUSY_MS = 30_000


@dataclass(frozen=True)
class LoggedCalibration:
    """An entry of the logbook. valid_to_ns: None while in force. supersedes: the entry before, if any."""

    id: int
    valid_from_ns: int
    valid_to_ns: int | None
    added_ns: int
    supersedes: int | None
    note: str
    sha256: str


@dataclass(frozen=True)
class LoggedVerdict:
    """What the monitor said of a camera over one recording."""

    camera: str
    state: str
    size_deg: float | None
    std_deg: float | None
    words: str
    recording: str
    begin_ns: int
    end_ns: int
    calibration_id: int = 0
    evidence: Mapping[str, Any] = field(default_factory=dict)


class Logbook:
    """An open logbook; use it in a `with` block."""

    def __init__(self, path: Path | str, *, create: bool = False, read_only: bool = False) -> None:
        """Open, or create where there is none. InputError where the file is not a logbook of a version known here."""
        self.path = Path(path)
        if not create and not self.path.is_file():
            raise InputError(
                f"There is no logbook {self.path}.",
                remedy=f"`rigwake log add {self.path} calibration.yaml` begins one.",
            )
        try:
            uri = f"file:{quote(os.fsencode(self.path.absolute()))}?mode={'ro' if read_only else 'rwc'}"
            self._db = sqlite3.connect(uri, uri=True, timeout=_BUSY_MS / 1000, isolation_level=None)
        except sqlite3.Error as error:
            raise _failure(self.path, error) from error
        try:
            self._prepare(read_only)
        except BaseException:
            self._db.close()
            raise

    def _prepare(self, read_only: bool) -> None:
        with _told(self.path):
            self._db.execute(f"PRAGMA busy_timeout = {_BUSY_MS}")
            self._db.execute("PRAGMA foreign_keys = ON")
            self._db.execute("PRAGMA trusted_schema = OFF")
            if not read_only:
                self._db.execute("PRAGMA synchronous = FULL")
            version, application = self._versions()
            if version == 0 and application == 0 and not read_only:
                self._create()
                version, application = self._versions()
        if application != _APPLICATION_ID:
            raise InputError(
                f"{self.path} is not a rigwake logbook.",
                consequence="It was left as it is.",
                remedy="Name another file.",
            )
        if version > SCHEMA_VERSION:
            raise InputError(
                f"{self.path} is a logbook of version {version}; this rigwake knows version {SCHEMA_VERSION}.",
                consequence="It was left as it is.",
                remedy="Update rigwake.",
            )

    def _versions(self) -> tuple[int, int]:
        version = int(self._db.execute("PRAGMA user_version").fetchone()[0])
        return version, int(self._db.execute("PRAGMA application_id").fetchone()[0])

    def _create(self) -> None:
        """The tables, in one transaction; another process may be doing the same."""
        self._db.execute("PRAGMA journal_mode = WAL")
        schema = (resources.files("rigwake.logbook") / "schema.sql").read_text(encoding="utf-8")
        with self._writing():
            if self._versions() != (0, 0):
                return
            if self._db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
                return  # another program's database
            for statement in schema.split(";"):
                if statement.strip():
                    self._db.execute(statement)
            self._db.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
            self._db.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")

    def __enter__(self) -> Logbook:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """One transaction that holds the write lock from its beginning."""
        with _told(self.path):
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._db.execute("COMMIT")
            except BaseException:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise

    def add(self, calibration: Calibration, valid_from_ns: int, note: str = "") -> int:
        """Log a calibration that holds from a time on; the one in force then ends there. Returns its number.

        The same calibration twice is one entry. Raises InputError for another vessel's, UsageError for a time at
        which another calibration began.
        """
        document = yaml.safe_dump(calibration_to_dict(calibration), sort_keys=False)
        digest = hashlib.sha256(document.encode()).hexdigest()
        fingerprint = fingerprint_of_calibration(calibration)
        with self._writing():
            known = self._db.execute("SELECT id FROM calibration WHERE sha256 = ?", (digest,)).fetchone()
            if known is not None:
                return int(known[0])
            self._require_vessel(fingerprint)
            before = self._db.execute(
                "SELECT id, valid_from_ns FROM calibration WHERE valid_from_ns <= ? ORDER BY valid_from_ns DESC",
                (valid_from_ns,),
            ).fetchone()
            if before is not None and before[1] == valid_from_ns:
                raise UsageError(
                    f"Calibration {before[0]} of {self.path.name} begins at the same time.",
                    remedy="Name a later time: --from TIME.",
                )
            after = self._db.execute(
                "SELECT min(valid_from_ns) FROM calibration WHERE valid_from_ns > ?", (valid_from_ns,)
            ).fetchone()[0]
            if before is not None:
                self._db.execute(
                    "UPDATE calibration SET valid_to_ns = ? WHERE id = ?", (valid_from_ns, before[0])
                )
            cursor = self._db.execute(
                "INSERT INTO calibration (valid_from_ns, valid_to_ns, added_ns, supersedes, note, fingerprint, sha256, "
                "document) VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
                (
                    valid_from_ns,
                    after,
                    time.time_ns(),
                    None if before is None else before[0],
                    note,
                    json.dumps(fingerprint.to_json()),
                    digest,
                    document,
                ),
            )
            number = cursor.lastrowid
        assert number is not None
        return int(number)

    def _require_vessel(self, fingerprint: VesselFingerprint) -> None:
        """The logbook's vessel is that of its first entry; a camera more or less, or a new lens, is another vessel."""
        row = self._db.execute("SELECT fingerprint FROM vessel").fetchone()
        if row is None:
            text = json.dumps(fingerprint.to_json())
            self._db.execute("INSERT INTO vessel (id, fingerprint) VALUES (1, ?)", (text,))
            return
        vessel = VesselFingerprint.from_json(json.loads(row[0]))
        differences = vessel.differences(fingerprint)
        if differences:
            raise InputError(
                f"{self.path.name} is the logbook of another vessel: {'; '.join(differences)}.",
                consequence="Nothing was logged.",
                remedy="Keep one logbook per vessel.",
            )

    def add_verdicts(self, calibration_id: int, verdicts: Sequence[LoggedVerdict]) -> None:
        """Log what the monitor said, all or nothing."""
        with self._writing():
            self._db.executemany(
                "INSERT INTO verdict (calibration_id, recording, begin_ns, end_ns, added_ns, camera, state, size_deg, "
                "std_deg, words, evidence) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                [
                    (
                        calibration_id,
                        v.recording,
                        v.begin_ns,
                        v.end_ns,
                        time.time_ns(),
                        v.camera,
                        v.state,
                        v.size_deg,
                        v.std_deg,
                        v.words,
                        json.dumps(dict(v.evidence), allow_nan=False),
                    )
                    for v in verdicts
                ],
            )

    def calibrations(self) -> list[LoggedCalibration]:
        """All entries, in the order of their validity."""
        with _told(self.path):
            rows = self._db.execute(
                "SELECT id, valid_from_ns, valid_to_ns, added_ns, supersedes, note, sha256 FROM calibration "
                "ORDER BY valid_from_ns"
            ).fetchall()
            return [LoggedCalibration(*row) for row in rows]

    def find(self, calibration: Calibration) -> int | None:
        """The number of this very calibration, None if it was never logged."""
        document = yaml.safe_dump(calibration_to_dict(calibration), sort_keys=False)
        digest = hashlib.sha256(document.encode()).hexdigest()
        with _told(self.path):
            row = self._db.execute("SELECT id FROM calibration WHERE sha256 = ?", (digest,)).fetchone()
        return None if row is None else int(row[0])

    def load(self, number: int) -> Calibration:
        """A logged calibration; UsageError where there is no such number, InputError where its text was changed."""
        with _told(self.path):
            row = self._db.execute(
                "SELECT document, sha256 FROM calibration WHERE id = ?", (number,)
            ).fetchone()
        if row is None:
            numbers = ", ".join(str(entry.id) for entry in self.calibrations())
            raise UsageError(
                f"{self.path.name} has no calibration {number}.", remedy=f"It has: {numbers or 'none'}."
            )
        document, digest = str(row[0]), str(row[1])
        if hashlib.sha256(document.encode()).hexdigest() != digest:
            raise InputError(
                f"Calibration {number} of {self.path.name} is not what was logged: its checksum differs.",
                consequence="It was not used.",
                remedy="Restore the file from a copy.",
            )
        return calibration_from_dict(
            parse_yaml(document, self.path.name), f"{self.path.name}, calibration {number}"
        )

    def at(self, time_ns: int) -> LoggedCalibration:
        """The calibration valid at a time; UsageError where there is none."""
        found = [entry for entry in self.calibrations() if entry.valid_from_ns <= time_ns]
        if not found:
            raise UsageError(
                f"No calibration of {self.path.name} was valid at that time.",
                remedy="`rigwake log list` shows their validity.",
            )
        return found[-1]

    def verdicts(self, camera: str | None = None) -> list[LoggedVerdict]:
        """What the monitor said, in the order of time."""
        with _told(self.path):
            rows = self._db.execute(
                "SELECT camera, state, size_deg, std_deg, words, recording, begin_ns, end_ns, calibration_id, evidence "
                "FROM verdict WHERE ? IS NULL OR camera = ? ORDER BY begin_ns, id",
                (camera, camera),
            ).fetchall()
            return [replace(LoggedVerdict(*row[:9]), evidence=json.loads(row[9])) for row in rows]

    def copy_to(self, path: Path) -> None:
        """A consistent copy, also while others write."""
        with _told(path), sqlite3.connect(path) as other:
            self._db.backup(other)
        other.close()


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Errors of SQLite in words."""
    try:
        yield
    except sqlite3.Error as error:
        raise _failure(path, error) from error
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:  # of what a row holds
        raise InputError(
            f"{path} is a damaged logbook ({type(error).__name__}: {error}).",
            consequence="It was left as it is.",
            remedy="Restore it from a copy (`rigwake log export`).",
        ) from error


def _failure(path: Path, error: sqlite3.Error) -> RigwakeError:
    code = getattr(error, "sqlite_errorname", "") or ""
    if code.startswith("SQLITE_FULL"):
        return RigwakeError(
            f"The disk of {path} is full.",
            consequence="Nothing was logged; what was there is untouched.",
            remedy="Make room and run the command again.",
        )
    if code.startswith(("SQLITE_READONLY", "SQLITE_CANTOPEN", "SQLITE_PERM")):
        return RigwakeError(
            f"{path} cannot be written or opened ({error}).",
            consequence="Nothing was logged.",
            remedy="Check the folder, its permissions, and whether the disk is read-only.",
        )
    if code.startswith("SQLITE_BUSY"):
        return RigwakeError(
            f"{path} has been locked by another program for {_BUSY_MS // 1000} s.",
            consequence="Nothing was logged.",
            remedy="End that program, then run the command again.",
        )
    if code.startswith(("SQLITE_NOTADB", "SQLITE_CORRUPT")):
        return InputError(
            f"{path} is not a logbook, or it is damaged ({error}).",
            consequence="It was left as it is.",
            remedy="Restore it from a copy (`rigwake log export`).",
        )
    return RigwakeError(f"{path}: {error}.", consequence="Nothing was logged.")
