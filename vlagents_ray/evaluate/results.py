"""What a folder of results holds, for whoever reads it: the table, the report, exports."""

from __future__ import annotations

import dataclasses
import json
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.cells import contender
from vlagents_ray.evaluate.config import StopConfig
from vlagents_ray.evaluate.episode import EpisodeResult
from vlagents_ray.evaluate.jobs import EpisodeKey
from vlagents_ray.evaluate.schema import FILE, require_version
from vlagents_ray.evaluate.statistics import Rate
from vlagents_ray.evaluate.stopping import Stopping, pooled


@dataclass(frozen=True, slots=True)
class Episode:
    """An episode as it was recorded."""

    result: EpisodeResult
    videos: tuple[str, ...]  # paths relative to the folder
    trajectory: str | None  # likewise
    attempts: int
    run: int
    finished: float  # seconds since 1970
    beyond: bool = False  # the point at which its cell stopped, or what is planned by now

    @property
    def counts(self) -> bool:
        """Is it in the rates? What infrastructure kept from ending is not, nor what is beyond the plan."""
        return self.result.status != "infra_failed" and not self.beyond


@dataclass(frozen=True, slots=True)
class Attempt:
    """An attempt at an episode that infrastructure failed."""

    key: str
    cell: str
    attempt: int
    run: int
    at: float  # seconds since 1970
    cause: str
    code: str
    error: str
    traceback: str
    log: str  # the last of what the worker wrote, if it broke
    retried: bool


@dataclass(frozen=True, slots=True)
class Worker:
    """A worker that connected to a policy or made an env, and where; one that did so again is here again."""

    run: int
    at: float  # seconds since 1970
    host: str
    node: str | None  # Ray's id
    pid: int
    policy: str
    transport: str
    renderer: str | None  # that its env drew with


@dataclass(frozen=True, slots=True)
class Run:
    """One run over the plan: the first, or one that resumed it."""

    run: int
    started: float  # seconds since 1970
    ended: float | None  # None: it was killed
    state: str  # "complete", "interrupted", "out of time", "stopped" by an error, or "running"
    config: dict[str, Any]
    versions: dict[str, Any]


@dataclass(frozen=True, slots=True)
class CellResults:
    """What came of one cell: a policy, at a checkpoint, in an env."""

    cell: str  # fingerprint of its settings
    policy: str
    step: int | None
    suite: str
    env: str
    planned: int
    settings: dict[str, Any]
    described: dict[str, Any]  # `EvalEnv.describe()`; {} if no worker has made it
    contract: dict[str, Any]
    code: dict[str, Any]  # of the env: commit, dirty, diff_sha256; {} if git knows nothing of it
    episodes: tuple[Episode, ...]  # by seed
    attempts: tuple[Attempt, ...]
    stop: StopConfig | None = None  # the rule by which it could stop early
    stopped_at: int | None = None  # the number of episodes after which it did; those beyond are kept, and not counted

    @property
    def contender(self) -> str:
        """The policy at its checkpoint, in a word."""
        return contender(self.policy, self.step)

    @property
    def counted(self) -> list[EpisodeResult]:
        """The results that are in the rates."""
        return [episode.result for episode in self.episodes if episode.counts]


@dataclass(frozen=True, slots=True)
class Results:
    """All of a folder."""

    out: Path
    cells: tuple[CellResults, ...]  # in the order of the plan
    runs: tuple[Run, ...]
    policies: dict[str, dict[str, Any]]  # what each policy's server said of itself
    workers: tuple[Worker, ...] = ()  # in the order of time; of old results none

    @classmethod
    def load(cls, out: Path) -> Results:
        """Read `out`, which an evaluation may be writing to. Raises `ConfigError` if it holds no results."""
        with reading(out) as db:
            episodes: dict[str, list[Episode]] = {}
            for row in table(db, "episodes", "seed"):
                episodes.setdefault(row["cell"], []).append(episode_of(row))
            attempts: dict[str, list[Attempt]] = {}
            for row in table(db, "attempts"):
                attempts.setdefault(row["cell"], []).append(Attempt(**row | {"retried": bool(row["retried"])}))
            return cls(
                out,
                tuple(
                    _cell(row, tuple(episodes.get(row["cell"], ())), tuple(attempts.get(row["cell"], ())))
                    for row in table(db, "cells")
                ),
                tuple(_run(row) for row in table(db, "runs")),
                {row["name"]: json.loads(row["metadata"]) for row in table(db, "policies")},
                tuple(Worker(**row) for row in table(db, "workers")),
            )

    @property
    def contenders(self) -> list[str]:
        """The policies at their checkpoints, in the order of the plan."""
        return list(dict.fromkeys(cell.contender for cell in self.cells))

    def of(self, contender: str) -> list[CellResults]:
        """The cells of one contender."""
        return [cell for cell in self.cells if cell.contender == contender]

    def only(self, contender: str | None = None, env: str | None = None) -> Results:
        """Without the cells of other contenders and envs; None takes all. `ConfigError` if that leaves nothing."""
        left = tuple(one for one in self.cells if contender in (None, one.contender) and env in (None, one.env))
        if not left:
            have = sorted({f"{one.contender} in {one.env}" for one in self.cells})
            raise ConfigError(f"{self.out}: has nothing of {contender or 'any policy'} in {env or 'any env'}: {have}")
        return dataclasses.replace(self, cells=left)


@contextmanager
def reading(out: Path) -> Iterator[sqlite3.Connection]:
    """One state of all tables in `out`, which may be written to meanwhile."""
    if not (out / FILE).is_file():
        raise ConfigError(f"{out}: got no {FILE} there, want a folder that an evaluation wrote its results to")
    with closing(sqlite3.connect(out / FILE)) as db:
        require_version(out, db)
        db.row_factory = sqlite3.Row
        db.execute("BEGIN")
        yield db


def table(db: sqlite3.Connection, name: str, order: str = "rowid") -> Iterator[dict[str, Any]]:
    """The rows of a table, by its columns' names; none if the file is older than the table."""
    if db.execute("SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = ?", (name,)).fetchone() is None:
        return iter(())
    return (dict(row) for row in db.execute(f"SELECT * FROM {name} ORDER BY {order}"))  # noqa: S608 (constants)


def episode_of(row: dict[str, Any]) -> Episode:
    """What a row of the table of episodes says."""
    names = {field.name for field in dataclasses.fields(EpisodeResult)}
    known = {name: value for name, value in row.items() if name in names and name != "key"}
    for name in ("success_once", "success_at_end"):
        known[name] = None if known[name] is None else bool(known[name])
    key = EpisodeKey(row["env"], row["episode"], row["seed"], row["cell"])
    result = EpisodeResult(**known | {"key": key, "timing_ms": json.loads(row["timing_ms"])})
    videos = tuple(json.loads(row["videos"]))
    return Episode(result, videos, row["trajectory"], row["attempts"], row["run"], row["finished"])


def _cell(row: dict[str, Any], episodes: tuple[Episode, ...], attempts: tuple[Attempt, ...]) -> CellResults:
    seeds, rule = json.loads(row.pop("seeds")), row.pop("stop")
    parsed = {name: json.loads(row[name] or "{}") for name in ("settings", "described", "contract", "code")}
    each = row["planned"] // len(seeds)
    episodes = tuple(replace(one, beyond=not _is_planned(one.result.key, seeds, each)) for one in episodes)
    stop, stopped_at = None, None
    if rule is not None:
        stop = StopConfig.model_validate_json(rule)
        stopping = Stopping(stop, seeds, row["planned"])
        stopping.add_all(episode.result for episode in episodes)
        stopped_at = stopping.at
        episodes = tuple(replace(one, beyond=one.beyond or not stopping.counts(one.result.key)) for one in episodes)
    return CellResults(**row | parsed, episodes=episodes, attempts=attempts, stop=stop, stopped_at=stopped_at)


def _is_planned(key: EpisodeKey, seeds: Sequence[int], each: int) -> bool:
    """Is it still? After a resumption with fewer episodes, counting what happened to be played would be a selection."""
    return key.episode < each and key.seed - key.episode in seeds


def _run(row: dict[str, Any]) -> Run:
    return Run(**row | {name: json.loads(row[name]) for name in ("config", "versions")})


def rate_of(cells: Sequence[CellResults], what: Literal["success_once", "success_at_end"]) -> Rate:
    """The success rate of one cell, or of several together, with bounds that hold where cells could stop early."""
    counts = [(sum(bool(getattr(one, what)) for one in cell.counted), len(cell.counted)) for cell in cells]
    successes, episodes = (sum(column) for column in zip(*counts, strict=True)) if counts else (0, 0)
    if not (rules := [cell.stop for cell in cells if cell.stop is not None]):
        return Rate(successes, episodes)
    error_rate = max(rule.error_rate for rule in rules)
    return Rate(successes, episodes, pooled(counts, error_rate), error_rate)


def synchronous_twin(results: Results, cell: CellResults) -> CellResults | None:
    """The cell that a real-time one differs from in its clock alone: there the env waited for the policy."""
    if cell.settings["clock"] is None:
        return None
    wanted = cell.settings | {"clock": None}
    return next((other for other in results.cells if other.settings == wanted), None)
