"""The tables of `results.db`."""

from __future__ import annotations

import sqlite3
from pathlib import Path

from vlagents_ray.errors import ConfigError

FILE = "results.db"
VERSION = 3

SCHEMA = """
CREATE TABLE runs (
    run INTEGER PRIMARY KEY, started REAL NOT NULL, ended REAL, state TEXT NOT NULL,
    config TEXT NOT NULL, versions TEXT NOT NULL
);
CREATE TABLE policies (name TEXT PRIMARY KEY, metadata TEXT NOT NULL);
CREATE TABLE cells (
    cell TEXT PRIMARY KEY, policy TEXT NOT NULL, step INTEGER, suite TEXT NOT NULL, env TEXT NOT NULL,
    planned INTEGER NOT NULL, seeds TEXT NOT NULL, stop TEXT, settings TEXT NOT NULL, described TEXT, contract TEXT,
    code TEXT
);
CREATE TABLE episodes (
    key TEXT PRIMARY KEY, cell TEXT NOT NULL REFERENCES cells, env TEXT NOT NULL, episode INTEGER NOT NULL,
    seed INTEGER NOT NULL, status TEXT NOT NULL, success_once INTEGER, success_at_end INTEGER, first_success INTEGER,
    steps INTEGER NOT NULL, episode_return REAL NOT NULL, ending TEXT NOT NULL, instruction TEXT NOT NULL,
    error TEXT, seconds REAL NOT NULL, reset_ms REAL, env_step_ms REAL, acts INTEGER NOT NULL,
    policy_ms REAL, policy_p95_ms REAL, latency_ms REAL, ticks_waited INTEGER NOT NULL, ticks_held INTEGER NOT NULL,
    timing_ms TEXT NOT NULL, transport TEXT NOT NULL, checkpoint TEXT,
    actions_sha256 TEXT, videos TEXT NOT NULL, trajectory TEXT, attempts INTEGER NOT NULL,
    run INTEGER NOT NULL REFERENCES runs, finished REAL NOT NULL
);
CREATE INDEX episodes_of_cells ON episodes (cell, checkpoint);
CREATE TABLE attempts (
    key TEXT NOT NULL, cell TEXT NOT NULL REFERENCES cells, attempt INTEGER NOT NULL,
    run INTEGER NOT NULL REFERENCES runs, at REAL NOT NULL, cause TEXT NOT NULL, code TEXT NOT NULL,
    error TEXT NOT NULL, traceback TEXT NOT NULL, log TEXT NOT NULL, retried INTEGER NOT NULL
);
CREATE TABLE tracked (
    tracker TEXT NOT NULL, what TEXT NOT NULL, episodes INTEGER NOT NULL, PRIMARY KEY (tracker, what)
);
"""

# Apart, because older results of this version have none: it is made when they are gone on with.
WORKERS = """
CREATE TABLE IF NOT EXISTS workers (
    run INTEGER NOT NULL REFERENCES runs, at REAL NOT NULL, host TEXT NOT NULL, node TEXT, pid INTEGER NOT NULL,
    policy TEXT NOT NULL, transport TEXT NOT NULL, renderer TEXT
);
"""


def require_version(out: Path, db: sqlite3.Connection) -> None:
    """`ConfigError` for a results file that this version of the package does not read."""
    version = db.execute("PRAGMA user_version").fetchone()[0]
    if version != VERSION:
        raise ConfigError(
            f"{out / FILE}: got version {version} of the results file, want {VERSION}; choose another out folder"
        )
