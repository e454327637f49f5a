"""`results.db`: what an evaluation knows, in SQLite, one transaction an episode.

A commit survives the death of the process that made it, whenever that comes; so an evaluation
that is killed and resumed has each episode exactly once.
"""

from __future__ import annotations

import fcntl
import json
import os
import sqlite3
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.config import EvalConfig, canonical, outcome_settings
from vlagents_ray.evaluate.episode import EpisodeResult
from vlagents_ray.evaluate.jobs import Job
from vlagents_ray.evaluate.rollout import Failure, Made

FILE = "results.db"
LOCK = "results.lock"
SCHEMA_VERSION = 2
IDENTITY = ("policy", "checkpoint")  # of the policy's metadata: what must not change between runs

_SCHEMA = """
CREATE TABLE meta (name TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE runs (
    run INTEGER PRIMARY KEY, started REAL NOT NULL, ended REAL, state TEXT NOT NULL,
    config TEXT NOT NULL, versions TEXT NOT NULL
);
CREATE TABLE envs (env TEXT PRIMARY KEY, settings TEXT NOT NULL, described TEXT, contract TEXT);
CREATE TABLE episodes (
    key TEXT PRIMARY KEY, env TEXT NOT NULL, episode INTEGER NOT NULL, seed INTEGER NOT NULL,
    settings TEXT NOT NULL, status TEXT NOT NULL, success_once INTEGER, success_at_end INTEGER,
    steps INTEGER NOT NULL, episode_return REAL NOT NULL, ending TEXT NOT NULL, instruction TEXT NOT NULL,
    error TEXT, seconds REAL NOT NULL, reset_ms REAL, env_step_ms REAL, acts INTEGER NOT NULL,
    policy_ms REAL, policy_p95_ms REAL, transport TEXT NOT NULL, checkpoint TEXT, videos TEXT NOT NULL,
    attempts INTEGER NOT NULL, run INTEGER NOT NULL REFERENCES runs, finished REAL NOT NULL
);
CREATE TABLE attempts (
    key TEXT NOT NULL, attempt INTEGER NOT NULL, run INTEGER NOT NULL REFERENCES runs, at REAL NOT NULL,
    cause TEXT NOT NULL, code TEXT NOT NULL, error TEXT NOT NULL, traceback TEXT NOT NULL,
    retried INTEGER NOT NULL
);
"""


class Store:
    """The results of one `out` folder, open for one evaluation at a time. Use as a context manager."""

    def __init__(self, config: EvalConfig) -> None:
        """Open or begin `config.out`.

        Raises `ConfigError` if there are results and `config.resume` is off, if they come from other
        settings, or if another evaluation is writing there.
        """
        self._out = config.out
        self._out.mkdir(parents=True, exist_ok=True)
        self._lock = _lock(self._out)
        self._run = 0
        try:
            self._db = self._open(config)
        except BaseException:
            os.close(self._lock)
            raise

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; the lock is given back."""
        self._db.close()
        os.close(self._lock)

    def begin_run(self, config: EvalConfig, versions: dict[str, Any]) -> None:
        """Note that an evaluation starts, or goes on."""
        with self._db:
            row = (time.time(), "running", config.model_dump_json(), canonical(versions))
            cursor = self._db.execute("INSERT INTO runs (started, state, config, versions) VALUES (?, ?, ?, ?)", row)
            self._run = int(cursor.lastrowid or 0)

    def end_run(self, state: str) -> None:
        """Note how the evaluation ended."""
        with self._db:
            self._db.execute("UPDATE runs SET ended = ?, state = ? WHERE run = ?", (time.time(), state, self._run))

    def finished(self) -> set[str]:
        """Keys of the episodes that are not to be played again."""
        return {key for (key,) in self._db.execute("SELECT key FROM episodes WHERE status != 'infra_failed'")}

    def record(self, result: EpisodeResult, attempts: int, videos: Sequence[str] = ()) -> None:
        """Add an episode. One that infrastructure failed gives way; any other is there once and for all.

        `ConfigError` for one that another checkpoint played, as after a swap: a rate is that of one.
        """
        self._require_same_checkpoint(result)
        row = asdict(result)
        key = row.pop("key")
        row |= {
            "key": str(result.key),
            **key,
            "videos": canonical(list(videos)),
            "attempts": attempts,
            "run": self._run,
            "finished": time.time(),
        }
        with self._db:
            self._db.execute("DELETE FROM episodes WHERE key = ? AND status = 'infra_failed'", (row["key"],))
            columns, marks = ", ".join(row), ", ".join("?" * len(row))
            self._db.execute(f"INSERT INTO episodes ({columns}) VALUES ({marks})", tuple(row.values()))  # noqa: S608 (our own column names)

    def _require_same_checkpoint(self, result: EpisodeResult) -> None:
        row = self._db.execute("SELECT checkpoint FROM episodes WHERE checkpoint IS NOT NULL LIMIT 1").fetchone()
        if row is not None and result.checkpoint not in (None, row[0]):
            raise ConfigError(
                f"policy: {result.key} was played by checkpoint {result.checkpoint!r}, the results in {self._out} "
                f"are of {row[0]!r}; serve that one again, or choose another out folder"
            )

    def record_attempt(self, job: Job, failure: Failure, *, retried: bool) -> None:
        """Note an attempt that infrastructure failed."""
        where = (str(job.key), job.attempt, self._run, time.time())
        why = (failure.cause, failure.code, failure.message, failure.traceback, retried)
        with self._db:
            self._db.execute("INSERT INTO attempts VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", where + why)

    def note_env(self, made: Made) -> None:
        """Keep what a worker found out about an env."""
        with self._db:
            self._db.execute(
                "UPDATE envs SET described = ?, contract = ? WHERE env = ?",
                (json.dumps(made.described, default=str), canonical(made.contract), made.env),
            )

    def note_policy(self, metadata: dict[str, Any]) -> None:
        """Keep what the policy's server says of itself; `ConfigError` if it is not the policy of before."""
        known = self.policy()
        for name in IDENTITY:
            if known is not None and known.get(name) != metadata.get(name):
                raise ConfigError(
                    f"policy: the server has {name} {metadata.get(name)!r}, the results in {self._out} are of "
                    f"{known.get(name)!r}; serve that one again, or choose another out folder"
                )
        with self._db:
            value = json.dumps(metadata, default=str)
            self._db.execute("INSERT OR REPLACE INTO meta VALUES ('policy', ?)", (value,))

    def policy(self) -> dict[str, Any] | None:
        """The policy's metadata, if any worker has reached it."""
        row = self._db.execute("SELECT value FROM meta WHERE name = 'policy'").fetchone()
        return None if row is None else dict(json.loads(row[0]))

    def rows(self, table: str) -> list[dict[str, Any]]:
        """All rows of "episodes", "attempts", "envs" or "runs", oldest first."""
        cursor = self._db.execute(f"SELECT * FROM {table} ORDER BY rowid")  # noqa: S608 (called with constants)
        columns = [column[0] for column in cursor.description]
        return [dict(zip(columns, row, strict=True)) for row in cursor]

    def _open(self, config: EvalConfig) -> sqlite3.Connection:
        db = sqlite3.connect(self._out / FILE)
        try:
            db.execute("PRAGMA journal_mode = WAL")  # readers may look while the evaluation writes
            db.execute("PRAGMA synchronous = NORMAL")  # safe against a killed process, and no fsync an episode
            version = db.execute("PRAGMA user_version").fetchone()[0]
            if version == 0:
                db.executescript(f"BEGIN; {_SCHEMA} PRAGMA user_version = {SCHEMA_VERSION}; COMMIT;")
            elif version != SCHEMA_VERSION:
                raise ConfigError(
                    f"{self._out / FILE}: got version {version} of the results file, want {SCHEMA_VERSION}; "
                    f"choose another out folder"
                )
            self._require_resumable(db, config)
            self._note_settings(db, config)
        except BaseException:
            db.close()
            raise
        return db

    def _require_resumable(self, db: sqlite3.Connection, config: EvalConfig) -> None:
        runs, episodes = (db.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0] for table in ("runs", "episodes"))  # noqa: S608
        if runs and not config.resume:
            raise ConfigError(
                f"{self._out} already has results ({episodes} episodes): resume them (--resume), "
                f"or choose another out folder"
            )
        stored = {env: json.loads(text) for env, text in db.execute("SELECT env, settings FROM envs")}
        found = [
            f"- {env}: {name}: the results have {stored[env].get(name)!r}, now it is {value!r}"
            for env in config.envs
            if env in stored
            for name, value in _settings(config, env).items()
            if stored[env].get(name) != value
        ]
        if runs and found:
            raise ConfigError(
                f"{self._out} has results of other settings:\n"
                + "\n".join(found)
                + "\ntake the old settings, or choose another out folder"
            )

    @staticmethod
    def _note_settings(db: sqlite3.Connection, config: EvalConfig) -> None:
        with db:
            for env in config.envs:
                row = (env, canonical(_settings(config, env)))
                db.execute(
                    "INSERT INTO envs (env, settings) VALUES (?, ?) ON CONFLICT DO UPDATE SET settings = ?",
                    (*row, row[1]),
                )


def _settings(config: EvalConfig, env: str) -> dict[str, Any]:
    """What must be the same to go on. The first seed is among it: else episode 3 would be two episodes."""
    return outcome_settings(config, env) | {"seed": config.seed}


def _lock(out: Path) -> int:
    """An open file with a lock on `out`, which the system gives back whenever this process ends."""
    file = os.open(out / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(file)
        raise ConfigError(
            f"{out}: another evaluation is writing there; wait for it, or choose another folder"
        ) from error
    return file
