"""Index of a ROS 2 bag: a folder with metadata.yaml and sqlite3 or MCAP files, or one such file."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import numpy as np
import zstandard

from rigwake._types import Stamps
from rigwake.errors import InputError
from rigwake.readers.channels import MAX_MESSAGE_BYTES, BagIndex, Channel, joined, standard_type_name
from rigwake.readers.mcap_file import index_mcap
from rigwake.recording import Finding
from rigwake.yaml_input import read_yaml

SQLITE_MAGIC = b"SQLite format 3\0"
METADATA = "metadata.yaml"
_MAX_METADATA_BYTES = 2**24


@dataclass(frozen=True, eq=False)
class SqlitePayloads:
    """Messages by their row id in the table `messages`; each packed with zstd if `packed`."""

    path: Path
    message_ids: Stamps
    packed: bool

    def read(self, rows: Iterable[int], limit_bytes: int = MAX_MESSAGE_BYTES) -> Iterator[bytes]:
        """See `Payloads.read`."""
        query = "SELECT substr(data, 1, ?) FROM messages WHERE id = ?"
        stored_limit = MAX_MESSAGE_BYTES if self.packed else limit_bytes
        with closing(_connect(self.path)) as database:
            for row in rows:
                try:
                    found = database.execute(query, (stored_limit, int(self.message_ids[row]))).fetchone()
                except (sqlite3.Error, UnicodeDecodeError):
                    found = None
                stored = found[0] if found and isinstance(found[0], bytes) else b""
                yield _unpacked(stored)[:limit_bytes] if self.packed else stored


def _unpacked(stored: bytes) -> bytes:
    try:
        with zstandard.ZstdDecompressor().stream_reader(stored) as reader:
            return bytes(reader.read(MAX_MESSAGE_BYTES))
    except zstandard.ZstdError:
        return b""


def _connect(path: Path) -> sqlite3.Connection:
    database = sqlite3.connect(f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1", uri=True)
    database.text_factory = lambda text: text.decode("utf-8", "replace")
    database.execute("PRAGMA trusted_schema = OFF")
    return database


def index_sqlite(path: Path, *, packed: bool = False) -> BagIndex:
    """Index one sqlite3 file of a ROS 2 bag; damage is reported in `findings`.

    Raises InputError if it is no such database or its tables are not those of a bag.
    """
    try:
        with closing(_connect(path)) as database:
            tables = database.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
            if not {("topics",), ("messages",)} <= set(tables):
                raise InputError(f"{path.name} is a database, but not a ROS 2 bag.")
            topics = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
            entries, problem = _message_entries(database)
    except (sqlite3.Error, UnicodeDecodeError) as error:  # damaged names turn up in sqlite's own messages
        raise InputError(f"The ROS 2 bag {path.name} is damaged ({error}).") from error
    channels, findings = [], []
    if problem:
        message = f"{path.name} is cut off or damaged ({problem}); what could be read is kept."
        findings.append(Finding("error", "", message))
    for topic_id, topic, message_type, encoding in topics:
        if encoding != "cdr":
            findings.append(Finding("note", str(topic), f"encoded as {encoding!r}, not as CDR; left out."))
            continue
        rows = entries[entries[:, 1] == topic_id]
        payloads = SqlitePayloads(path, rows[:, 0].copy(), packed)
        type_name = standard_type_name(str(message_type))
        channels.append(Channel(str(topic), type_name, "cdr", rows[:, 2].copy(), payloads))
    return BagIndex("ros2 sqlite3 bag", tuple(channels), tuple(findings))


def _message_entries(database: sqlite3.Connection) -> tuple[Stamps, str]:
    """(N, 3) id, topic, time of all messages that can be reached, and what stopped the reading."""
    problem = ""
    entries: list[tuple[int, int, int]] = []
    try:
        for entry in database.execute("SELECT id, topic_id, timestamp FROM messages ORDER BY id"):
            if all(isinstance(value, int) for value in entry):
                entries.append(entry)
    except (sqlite3.Error, UnicodeDecodeError) as error:
        problem = str(error)
    return np.array(entries, dtype=np.int64).reshape(-1, 3), problem


def index_rosbag2_folder(folder: Path) -> BagIndex:
    """Index a ROS 2 bag folder with all its files. Raises InputError if none can be read."""
    information = _metadata(folder / METADATA)
    compression = str(information.get("compression_mode") or "").lower()
    if compression == "file":
        raise InputError(
            f"The files of {folder.name} are compressed as a whole.",
            remedy="Unpack them with `zstd -d *.zstd` and remove compression_mode from metadata.yaml.",
        )
    names = information.get("relative_file_paths")
    bags, findings = [], []
    for name in names if isinstance(names, list) else []:
        path = folder / Path(str(name)).name
        try:
            bags.append(
                index_mcap(path)
                if path.suffix == ".mcap"
                else index_sqlite(path, packed=compression == "message")
            )
        except (InputError, OSError) as error:
            findings.append(Finding("error", "", f"{path.name} cannot be read ({error}); it is left out."))
    if not bags:
        causes = " ".join(finding.message for finding in findings) or "metadata.yaml names no files."
        raise InputError(f"No file of the ROS 2 bag {folder.name} can be read. {causes}")
    kind = "ros2 mcap bag" if bags[0].kind == "mcap" else bags[0].kind
    channels = joined([channel for bag in bags for channel in bag.channels])
    return BagIndex(kind, channels, (*findings, *(f for bag in bags for f in bag.findings)))


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
