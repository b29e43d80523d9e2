"""Index of a ROS 2 bag: a folder with metadata.yaml and sqlite3 or MCAP files, or one such file."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import quote

import numpy as np

from rigwake._types import Stamps
from rigwake.errors import InputError
from rigwake.readers.channels import (
    MAX_MESSAGE_BYTES,
    BagIndex,
    Channel,
    Payloads,
    joined,
    require_regular_file,
    standard_type_name,
)
from rigwake.readers.chunks import FREE_BYTES, MAX_RATIO
from rigwake.readers.image_files import natural_order
from rigwake.readers.mcap_file import MAGIC as MCAP_MAGIC
from rigwake.readers.mcap_file import index_mcap
from rigwake.readers.packed_files import PACKED_SUFFIXES, packing_of, private_copy, unpacked_file
from rigwake.readers.printable import printable
from rigwake.readers.zstandard_frames import MAGIC as ZSTD_MAGIC
from rigwake.readers.zstandard_frames import ZstdError, unpack_zstd
from rigwake.recording import Finding
from rigwake.yaml_input import read_yaml

SQLITE_MAGIC = b"SQLite format 3\0"
METADATA = "metadata.yaml"
_STORAGE_SUFFIXES = (".db3", ".mcap")
_MAX_METADATA_BYTES = 2**24


@dataclass(frozen=True, eq=False)
class SqlitePayloads:
    """Messages by their row id in the table `messages`."""

    path: Path
    message_ids: Stamps

    def read(self, rows: Iterable[int], limit_bytes: int = MAX_MESSAGE_BYTES) -> Iterator[bytes]:
        """See `Payloads.read`."""
        query = "SELECT substr(data, 1, ?) FROM messages WHERE rowid = ?"
        with closing(_connect(self.path)) as database:
            for row in rows:
                try:
                    found = database.execute(query, (limit_bytes, int(self.message_ids[row]))).fetchone()
                except (sqlite3.Error, UnicodeDecodeError):
                    found = None
                yield found[0] if found and isinstance(found[0], bytes) else b""


@dataclass(frozen=True, eq=False)
class PackedPayloads:
    """Messages that are each packed with zstd (`ros2 bag record --compression-mode message`)."""

    packed: Payloads

    def read(self, rows: Iterable[int], limit_bytes: int = MAX_MESSAGE_BYTES) -> Iterator[bytes]:
        """See `Payloads.read`; no more is unpacked than is asked for."""
        return (_unpacked(stored, limit_bytes) for stored in self.packed.read(rows))


def _unpacked(stored: bytes, limit_bytes: int) -> bytes:
    """Up to `limit_bytes` of the content; empty if it is damaged, or far larger than its packed size allows."""
    limit = min(limit_bytes, FREE_BYTES // 4 + MAX_RATIO * len(stored))
    if not stored.startswith(ZSTD_MAGIC):
        return stored[:limit_bytes]
    try:
        return unpack_zstd(stored, limit)
    except ZstdError:
        return b""


def with_packed_messages(bag: BagIndex) -> BagIndex:
    """The same bag; channels whose messages are packed (a CDR message cannot begin like a zstd frame) unpack them."""
    channels = []
    for channel in bag.channels:
        first = next(iter(channel.payloads.read(range(min(len(channel), 1)), 4)), b"")
        if channel.encoding == "cdr" and first == ZSTD_MAGIC:
            channel = replace(channel, payloads=PackedPayloads(channel.payloads))
        channels.append(channel)
    return replace(bag, channels=tuple(channels))


def _connect(path: Path) -> sqlite3.Connection:
    database = sqlite3.connect(f"file:{quote(os.fsencode(path.resolve()))}?mode=ro&immutable=1", uri=True)
    database.text_factory = lambda text: text.decode("utf-8", "replace")
    database.execute("PRAGMA trusted_schema = OFF")
    # what is stored cannot be larger than its file: anything else is generated on reading
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(MAX_MESSAGE_BYTES, path.stat().st_size + 2**16))
    return database


def index_sqlite(path: Path) -> BagIndex:
    """Index one sqlite3 file of a ROS 2 bag; damage is reported in `findings`.

    What a recorder that was killed left beside it (`-wal`, `-journal`) is taken into account in a copy: the
    recording itself is not changed. Raises InputError if it is no such database or its tables are not those of a bag.
    """
    require_regular_file(path)
    path, remarks = _with_log(path)
    try:
        with closing(_connect(path)) as database:
            _check_tables(database, path)
            topics = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
            entries, problem = _message_entries(database)
    except (sqlite3.Error, UnicodeDecodeError) as error:  # damaged names turn up in sqlite's own messages
        raise InputError(f"The ROS 2 bag {path.name} is damaged ({error}).") from error
    channels, findings = [], list(remarks)
    if problem:
        message = f"{path.name} is cut off or damaged ({problem}); what could be read is kept."
        findings.append(Finding("error", "", message))
    orphans = int(
        (~np.isin(entries[:, 1], [topic[0] for topic in topics if isinstance(topic[0], int)])).sum()
    )
    if orphans:
        findings.append(Finding("error", "", f"{path.name}: {orphans} messages are of no topic; left out."))
    for topic_id, topic, message_type, encoding in topics:
        if encoding != "cdr":
            words = f"encoded as {printable(str(encoding))!r}, not as CDR; left out."
            findings.append(Finding("note", printable(str(topic)), words))
            continue
        rows = entries[entries[:, 1] == topic_id]
        payloads = SqlitePayloads(path, rows[:, 0].copy())
        type_name = standard_type_name(str(message_type))
        channels.append(Channel(str(topic), type_name, "cdr", rows[:, 2].copy(), payloads))
    bag = BagIndex("ros2 sqlite3 bag", joined(channels), tuple(findings))
    return with_packed_messages(bag)


def _with_log(path: Path) -> tuple[Path, list[Finding]]:
    """The database, or a copy of it into which the log of its last writes was worked."""
    logs = [path.with_name(path.name + suffix) for suffix in ("-wal", "-journal")]
    logs = [log for log in logs if log.is_file() and log.stat().st_size]
    if not logs:
        return path, []
    copy = private_copy([path, *logs])
    try:
        with closing(sqlite3.connect(copy)) as database:
            database.execute("PRAGMA trusted_schema = OFF")
            database.execute("PRAGMA journal_mode = DELETE").fetchone()
    except sqlite3.Error as error:
        message = f"{path.name}: what was written last ({logs[0].name}) cannot be read ({error})."
        return path, [Finding("error", "", message)]
    message = f"{path.name} was not closed: what was written last was taken from {logs[0].name}."
    return copy, [Finding("note", "", message)]


def _check_tables(database: sqlite3.Connection, path: Path) -> None:
    """InputError unless topics and messages are plain tables: no views, virtual tables or generated columns."""
    tables = dict(database.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'").fetchall())
    if not {"topics", "messages"} <= tables.keys():
        raise InputError(f"{path.name} is a database, but not a ROS 2 bag.")
    for name in ("topics", "messages"):
        columns = database.execute(f"PRAGMA table_xinfo({name})").fetchall()
        if "VIRTUAL" in str(tables[name]).upper().split("(")[0] or any(column[6] for column in columns):
            raise InputError(f"{path.name}: the table {name} is computed, not recorded.")


def _message_entries(database: sqlite3.Connection) -> tuple[Stamps, str]:
    """(N, 3) row, topic, time of all messages that can be reached, and what stopped the reading."""
    problem = ""
    entries: list[tuple[int, int, int]] = []
    try:
        for entry in database.execute("SELECT rowid, topic_id, timestamp FROM messages ORDER BY rowid"):
            if all(isinstance(value, int) for value in entry):
                entries.append(entry)
    except (sqlite3.Error, UnicodeDecodeError) as error:
        problem = str(error)
    return np.array(entries, dtype=np.int64).reshape(-1, 3), problem


def is_rosbag2_folder(folder: Path) -> bool:
    """Whether a folder is a ROS 2 bag, with or without its metadata (a recorder that was killed writes none)."""
    return (folder / METADATA).is_file() or bool(_storage_files(folder))


def _storage_files(folder: Path) -> list[Path]:
    """The .db3 and .mcap files of a folder in the order of their numbers, packed ones where there is no other."""
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir(), key=natural_order):
        packed = path.suffix in PACKED_SUFFIXES
        plain = path.name.removesuffix(path.suffix) if packed else path.name
        is_storage = plain.endswith(_STORAGE_SUFFIXES) and not plain.startswith(".") and path.is_file()
        if is_storage and (plain not in found or not packed):
            found[plain] = path
    return list(found.values())


def index_storage_file(path: Path) -> BagIndex:
    """Index a file of a ROS 2 bag, sqlite3 or MCAP, packed as a whole or not. Raises InputError."""
    problem = ""
    if packing_of(path) is not None:
        path, problem = unpacked_file(path)
    with path.open("rb") as file:
        is_mcap = file.read(len(MCAP_MAGIC)) == MCAP_MAGIC
    bag = with_packed_messages(index_mcap(path)) if is_mcap else index_sqlite(path)
    return replace(bag, findings=(Finding("error", "", problem), *bag.findings)) if problem else bag


def index_rosbag2_folder(folder: Path) -> BagIndex:
    """Index a ROS 2 bag folder with all its files. Raises InputError if none can be read."""
    files, findings = _files_of(folder)
    bags = []
    for path in files:
        try:
            bags.append(index_storage_file(path))
        except (InputError, OSError) as error:
            words = error.cause if isinstance(error, InputError) else error.strerror
            findings.append(Finding("error", "", f"{path.name} cannot be read ({words}); it is left out."))
    if not bags:
        causes = " ".join(finding.message for finding in findings) or "It names no files."
        raise InputError(f"No file of the ROS 2 bag {folder.name} can be read. {causes}")
    kind = "ros2 mcap bag" if bags[0].kind == "mcap" else bags[0].kind
    channels = joined([channel for bag in bags for channel in bag.channels], of_files=True)
    return BagIndex(kind, channels, (*findings, *(f for bag in bags for f in bag.findings)))


def _files_of(folder: Path) -> tuple[list[Path], list[Finding]]:
    """The files that metadata.yaml names, and those beside it that it does not."""
    there = _storage_files(folder)
    if not (folder / METADATA).exists():
        message = (
            f"{METADATA} is missing: all files of the folder are read (`ros2 bag reindex` writes a new one)."
        )
        return there, [Finding("warning", "", message)]
    named = _metadata(folder / METADATA).get("relative_file_paths")
    files: list[Path] = []
    for name in named if isinstance(named, list) else []:
        path = folder / Path(str(name)).name
        files.append(next((f for f in there if path.name in (f.name, f.stem) or path.stem == f.name), path))
    files = list(dict.fromkeys(files))
    complete = any(path in there for path in files)
    unnamed = [path for path in there if path not in files] if complete else []
    names = ", ".join(printable(path.name) for path in unnamed)
    message = f"{METADATA} does not name {names}: read as well."
    return [*files, *unnamed], [Finding("warning", "", message)] if unnamed else []


def _metadata(path: Path) -> dict[str, object]:
    try:
        information = read_yaml(path, _MAX_METADATA_BYTES)["rosbag2_bagfile_information"]
    except (InputError, KeyError, TypeError) as error:
        raise InputError(
            f"{path} cannot be read as the metadata of a ROS 2 bag ({error}).",
            remedy="`ros2 bag reindex` writes a new one; or open the .db3 or .mcap file itself.",
        ) from error
    if not isinstance(information, dict):
        raise InputError(f"{path} is not the metadata of a ROS 2 bag.")
    return information
