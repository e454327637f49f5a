"""The database results.db: its tables, its lock, and the ways in which an evaluation and readers
open it.

The database uses SQLite's rollback journal with locks of the file system, so several hosts may
share the folder. A write-ahead log would not allow this (https://www.sqlite.org/wal.html). Each
episode is one commit, which takes a few milliseconds.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import functools
import os
import sqlite3
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError

FILE = "results.db"
RUNNING = "running"  # recorded state of a run that has not ended, or was killed
VERSION = 1

SCHEMA = """
CREATE TABLE runs (
    run INTEGER PRIMARY KEY,
    started REAL NOT NULL,
    ended REAL,
    state TEXT NOT NULL,
    config TEXT NOT NULL,
    versions TEXT NOT NULL,
    changes TEXT
);
CREATE TABLE policies (name TEXT PRIMARY KEY, metadata TEXT NOT NULL);
CREATE TABLE cases (
    case_id TEXT PRIMARY KEY,
    policy TEXT NOT NULL,
    step INTEGER,
    suite TEXT NOT NULL,
    env TEXT NOT NULL,
    planned INTEGER NOT NULL,
    seeds TEXT NOT NULL,
    stop TEXT,
    settings TEXT NOT NULL,
    described TEXT,
    contract TEXT,
    code TEXT,
    program TEXT,
    planned_at REAL NOT NULL
);
CREATE TABLE episodes (
    key TEXT PRIMARY KEY,
    case_id TEXT NOT NULL REFERENCES cases,
    env TEXT NOT NULL,
    episode INTEGER NOT NULL,
    seed INTEGER NOT NULL,
    status TEXT NOT NULL,
    success_once INTEGER,
    success_at_end INTEGER,
    first_success INTEGER,
    steps INTEGER NOT NULL,
    episode_return REAL NOT NULL,
    ending TEXT NOT NULL,
    instruction TEXT NOT NULL,
    error TEXT,
    seconds REAL NOT NULL,
    reset_ms REAL,
    env_step_ms REAL,
    env_seconds REAL,
    acts INTEGER NOT NULL,
    policy_ms REAL,
    policy_p95_ms REAL,
    policy_seconds REAL,
    latency_ms REAL,
    ticks_waited INTEGER NOT NULL,
    ticks INTEGER,
    starved INTEGER,
    age_p50_ms REAL,
    age_p95_ms REAL,
    age_p99_ms REAL,
    timing_ms TEXT NOT NULL,
    transport TEXT NOT NULL,
    checkpoint TEXT,
    weights TEXT,
    revision TEXT,
    policy_version INTEGER,
    policy_fingerprint TEXT,
    first_policy_version INTEGER,
    actions_sha256 TEXT,
    start TEXT,
    videos TEXT NOT NULL,
    trajectory TEXT,
    env_program TEXT,
    policy_program TEXT,
    attempts INTEGER NOT NULL,
    run INTEGER NOT NULL REFERENCES runs,
    finished REAL NOT NULL
);
CREATE INDEX episodes_of_cases ON episodes (case_id, checkpoint);
CREATE TABLE attempts (
    key TEXT NOT NULL,
    case_id TEXT NOT NULL REFERENCES cases,
    attempt INTEGER NOT NULL,
    run INTEGER NOT NULL REFERENCES runs,
    at REAL NOT NULL,
    cause TEXT NOT NULL,
    code TEXT NOT NULL,
    error TEXT NOT NULL,
    traceback TEXT NOT NULL,
    log TEXT NOT NULL,
    retried INTEGER NOT NULL
);
CREATE TABLE tracked (
    tracker TEXT NOT NULL,
    what TEXT NOT NULL,
    episodes INTEGER NOT NULL,
    PRIMARY KEY (tracker, what)
);
CREATE TABLE workers (
    run INTEGER NOT NULL REFERENCES runs,
    at REAL NOT NULL,
    host TEXT NOT NULL,
    node TEXT,
    pid INTEGER NOT NULL,
    policy TEXT NOT NULL,
    transport TEXT NOT NULL,
    renderer TEXT
);
"""


def create(db: sqlite3.Connection) -> None:
    """Create the tables of this version, in one transaction."""
    db.executescript(f"BEGIN; {SCHEMA} PRAGMA user_version = {VERSION}; COMMIT;")


def insert(db: sqlite3.Connection, table: str, row: Mapping[str, Any]) -> None:
    """Insert `row`, which maps the names of columns of `SCHEMA` to values."""
    columns = ", ".join(row)
    placeholders = ", ".join("?" * len(row))
    query = f"INSERT INTO {table} ({columns}) VALUES ({placeholders})"  # noqa: S608 (constants)
    db.execute(query, tuple(row.values()))


def require_readable(out: Path, db: sqlite3.Connection) -> None:
    """Raise `ConfigError` for a results file of another version, or with columns that differ from
    this version's.

    A file of a third party may contain any text as the name of a column, which `merge` would insert
    into SQL. It may also contain views or triggers, which would run arbitrary SQL when a table is
    read or written.
    """
    # SQLite also lists a virtual table as a table, so compare the beginning of the SQL statement.
    statements = {"table": "CREATE TABLE", "index": "CREATE INDEX"}
    for object_type, name, sql in db.execute(
        "SELECT type, name, sql FROM sqlite_master WHERE sql IS NOT NULL"
    ):
        if object_type not in statements or not str(sql).startswith(statements[object_type]):
            raise ConfigError(
                f"{out / FILE}: expected only the tables of an evaluation, got {name!r}, a "
                f"{object_type} that no evaluation makes; do not trust its author"
            )

    if not db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
        raise ConfigError(
            f"{out / FILE}: expected a database of results, got an empty file, as after an "
            "interrupted copy; copy it again, or choose another folder"
        )

    version = db.execute("PRAGMA user_version").fetchone()[0]
    if version != VERSION:
        raise ConfigError(
            f"{out / FILE}: expected version {VERSION} of the results, got {version}; choose "
            "another folder"
        )

    for table, expected_columns in _known_columns().items():
        columns = _columns(db, table)
        unknown, missing = columns - expected_columns, expected_columns - columns
        if not unknown and not missing:
            continue
        difference = f"none of the columns {sorted(missing)}"
        if unknown:
            difference = f"the unknown columns {sorted(unknown)}"
        raise ConfigError(
            f"{out / FILE}: expected the table {table!r} of this version of vlagents-ray, got "
            f"{difference}; read it with the version that wrote it"
        )


@functools.cache
def _known_columns() -> dict[str, set[str]]:
    with contextlib.closing(sqlite3.connect(":memory:")) as db:
        create(db)
        tables = [
            name for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        ]
        return {table: _columns(db, table) for table in tables}


def _columns(db: sqlite3.Connection, table: str) -> set[str]:
    return {name for (name,) in db.execute("SELECT name FROM pragma_table_xinfo(?)", (table,))}


WAIT_S = 60.0  # maximum wait for the end of another process's transaction, s


def read_only(out: Path) -> sqlite3.Connection:
    """Open `out/results.db` read-only; the file may be on a read-only file system."""
    return sqlite3.connect(f"{(out / FILE).resolve().as_uri()}?mode=ro", uri=True, timeout=WAIT_S)


LOCK = "results.lock"
_NO_LOCKS = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK)
_READER_S = 1.0  # s, longer than another process has the lock during `is_locked`
_RETRY_EVERY_S = 0.01


def lock(out: Path) -> int:
    """Lock the folder `out`.

    Returns:
        A file descriptor. Closing the descriptor or ending this process releases the lock.
    """
    file = os.open(out / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    deadline = time.monotonic() + _READER_S
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            if time.monotonic() < deadline:
                time.sleep(_RETRY_EVERY_S)
                continue

            os.close(file)
            raise ConfigError(
                f"{out}: another evaluation is writing there; wait, or choose another folder"
            ) from error
        except OSError as error:
            os.close(file)
            if error.errno not in _NO_LOCKS:
                raise
            raise ConfigError(
                f"{out}: expected a file system with locks, got a file system without locks "
                f"({error.strerror}), on which two evaluations could write to one folder; choose "
                f"another folder with "
                "--out (Lustre: have it mounted with `-o flock`)"
            ) from error
        return file


def is_locked(out: Path) -> bool:
    """Return whether an evaluation has locked the folder `out`; True if this cannot be
    determined.
    """
    try:
        file = os.open(out / LOCK, os.O_RDONLY)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(file)
    return False
