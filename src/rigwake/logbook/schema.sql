-- One vessel's history. Times are UTC nanoseconds since 1970, documents are JSON or YAML text.
CREATE TABLE vessel (
    id INTEGER PRIMARY KEY CHECK (id = 1),
    fingerprint TEXT NOT NULL
) STRICT;

CREATE TABLE calibration (
    id INTEGER PRIMARY KEY,
    valid_from_ns INTEGER NOT NULL,
    valid_to_ns INTEGER CHECK (valid_to_ns IS NULL OR valid_to_ns >= valid_from_ns),
    added_ns INTEGER NOT NULL,
    supersedes INTEGER REFERENCES calibration (id),
    note TEXT NOT NULL DEFAULT '',
    fingerprint TEXT NOT NULL,
    sha256 TEXT NOT NULL UNIQUE,
    document TEXT NOT NULL
) STRICT;

CREATE INDEX calibration_by_time ON calibration (valid_from_ns);

CREATE TABLE verdict (
    id INTEGER PRIMARY KEY,
    calibration_id INTEGER NOT NULL REFERENCES calibration (id),
    recording TEXT NOT NULL,
    begin_ns INTEGER NOT NULL,
    end_ns INTEGER NOT NULL CHECK (end_ns >= begin_ns),
    added_ns INTEGER NOT NULL,
    camera TEXT NOT NULL,
    state TEXT NOT NULL,
    size_deg REAL,
    std_deg REAL,
    words TEXT NOT NULL,
    evidence TEXT NOT NULL DEFAULT '{}'
) STRICT;

CREATE INDEX verdict_by_camera ON verdict (camera, begin_ns);
