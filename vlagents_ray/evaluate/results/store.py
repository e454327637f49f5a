"""Writes `results.db`: the state of an evaluation in SQLite, with one transaction for each episode.

A commit survives the end of its process at any time, so an evaluation that is killed and resumed
has each episode exactly once. Read it with `vlagents_ray.evaluate.results.reader`.
"""

from __future__ import annotations

import json
import logging
import os
import sqlite3
import time
from collections.abc import Hashable, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict
from typing import Any

from vlagents_ray.errors import ConfigError, WeightsLost
from vlagents_ray.evaluate.artifacts.storage import storing
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.episode.records import EnvInfo, EpisodeResult, WorkerInfo
from vlagents_ray.evaluate.plan.cases import EvalCase, plan_cases
from vlagents_ray.evaluate.plan.config import EvalConfig, canonical
from vlagents_ray.evaluate.plan.jobs import Job
from vlagents_ray.evaluate.results.changes import (
    MIX,
    Change,
    EnvStatement,
    changed,
    env_changes,
    listed,
    policy_changes,
    policy_program,
    program_changes,
    program_id,
)
from vlagents_ray.evaluate.results.database import (
    FILE,
    RUNNING,
    WAIT_S,
    create,
    insert,
    lock,
    require_readable,
)
from vlagents_ray.naming import did_you_mean

log = logging.getLogger(__name__)


class Store(AbstractContextManager["Store"]):
    """The results of one `out` folder, open for one evaluation at a time."""

    def __init__(self, config: EvalConfig) -> None:
        """Open or begin the results in `config.out`.

        Raises:
            ConfigError: There are results and `config.resume` is off, they have other settings or
                another program and `config.accept_changes` is off, or another evaluation is writing
                to them.
            StorageFailed: The folder cannot be written to.
        """
        self.cases = plan_cases(config)
        self._out = config.out
        with storing(config.out):
            self._out.mkdir(parents=True, exist_ok=True)
            self._lock = lock(self._out)
        self._run = 0
        self._accepts = config.accept_changes
        self._changes: list[Change] = []  # accepted in this run
        # policies, cases and places whose change was accepted in this run.
        self._accepted: set[Hashable] = set()
        self._policy_programs: dict[str, str | None] = {}  # by policy; of this run
        self._case = {case.fingerprint: case for case in self.cases}
        # By case, and by (policy, step, checkpoint); read when first needed.
        self._weights: dict[Hashable, str] = {}
        self._made: set[str] = set()  # places whose env is known to be that of earlier runs
        try:
            with storing(config.out):
                self._db = self._open(config)
        except BaseException:
            os.close(self._lock)
            raise

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        self._db.close()
        os.close(self._lock)

    def begin_run(
        self, config: EvalConfig, versions: dict[str, Any], started: float | None = None
    ) -> None:
        """Record that a run over the plan begins, or began at `started`, s since 1970."""
        with self._db:
            row = (
                time.time() if started is None else started,
                RUNNING,
                config.model_dump_json(),
                canonical(versions),
            )
            cursor = self._db.execute(
                "INSERT INTO runs (started, state, config, versions) VALUES (?, ?, ?, ?)", row
            )
            self._run = int(cursor.lastrowid or 0)
            self._write_changes()
            programs = [(canonical(case.program), case.fingerprint) for case in self.cases]
            self._db.executemany("UPDATE cases SET program = ? WHERE case_id = ?", programs)

    def end_run(self, state: str) -> None:
        with self._db:
            self._db.execute(
                "UPDATE runs SET ended = ?, state = ? WHERE run = ?",
                (time.time(), state, self._run),
            )

    def finished(self) -> set[str]:
        """Return the keys of the episodes that will not be played again."""
        return {
            key
            for (key,) in self._db.execute(
                "SELECT key FROM episodes WHERE status != 'infra_failed'"
            )
        }

    def record(
        self,
        result: EpisodeResult,
        attempts: int,
        videos: Sequence[str] = (),
        trajectory: str | None = None,
        finished: float | None = None,
    ) -> None:
        """Record an episode, finished now or at `finished`, s since 1970.

        It replaces one that failed by infrastructure; any other is not changed.

        Raises `ConfigError` if it was played by another checkpoint than earlier episodes of its
        case, as after a swap, by other weights of the same name, or by other weights than the
        pushed ones of its case: a rate has one checkpoint.
        """
        case = self._case[result.key.settings]
        want = case.policy.pushed_weights
        acted = (result.first_policy_version, result.policy_version, result.policy_fingerprint)
        if (
            want
            and result.policy_version is not None
            and acted != (want.version, want.version, want.fingerprint)
        ):
            raise WeightsLost(
                f"policy: {result.key} was played by versions {acted[0]} to {acted[1]} of the "
                f"weights ({acted[2]}), "
                f"want {want.version} ({want.fingerprint}); push nothing while a version is "
                "evaluated, and let the "
                f"policy's `options` ask for no other"
            )
        known = self._db.execute(
            "SELECT checkpoint FROM episodes WHERE case_id = ? AND checkpoint IS NOT NULL LIMIT 1",
            (result.key.settings,),
        ).fetchone()
        if known is not None and result.checkpoint not in (None, known[0]):
            raise ConfigError(
                f"policy: {result.key} was played by checkpoint {result.checkpoint!r}, the results "
                f"in {self._out} "
                f"are of {known[0]!r}; serve that one again, or choose another out folder"
            )
        self._require_same_weights(result)
        row = asdict(result)
        key = row.pop("key")
        del key["policy_seed"]  # in an evaluation, it is that of the environment
        row |= {
            "key": str(result.key),
            "case_id": key.pop("settings"),
            **key,
            "timing_ms": canonical(result.timing_ms),
            "videos": canonical(list(videos)),
            "trajectory": trajectory,
            "env_program": program_id(case.program),
            "policy_program": self._policy_programs.get(case.policy.name),
            "attempts": attempts,
            "run": self._run,
            "finished": time.time() if finished is None else finished,
        }
        with self._db:
            self._db.execute(
                "DELETE FROM episodes WHERE key = ? AND status = 'infra_failed'", (row["key"],)
            )
            insert(self._db, "episodes", row)

    def _require_same_weights(self, result: EpisodeResult) -> None:
        if result.weights is None:
            return
        if not self._weights:
            query = (
                "SELECT DISTINCT e.case_id, c.policy, c.step, e.checkpoint, e.weights"
                " FROM episodes e JOIN cases c ON c.case_id = e.case_id"
                " WHERE e.weights IS NOT NULL"
            )
            for of, *checkpoint, weights in self._db.execute(query):
                self._weights |= {of: weights, tuple(checkpoint): weights}
        case = self._case[result.key.settings]
        for of in (case.fingerprint, (case.policy.name, case.step, result.checkpoint)):
            known = self._weights.setdefault(of, result.weights)
            if result.weights != known:
                change = Change(
                    f"policy {case.contender}",
                    result.checkpoint or "weights",
                    known,
                    result.weights,
                )
                self._accept_or_raise(
                    of, [change], f"{result.key} was played by other weights than the results in"
                )
                self._weights[of] = result.weights

    def _accept_or_raise(
        self, what: Hashable, changes: list[Change], where: str, cure: str = MIX
    ) -> None:
        """Record changes since earlier runs, once for each `what` in a run; raise `ConfigError`
        unless they are
        accepted.

        A second change within a run means that processes have different files.
        """
        if not changes:
            return
        if not self._accepts or what in self._accepted:
            cure = "all processes of a run need the same files" if self._accepts else cure
            raise ConfigError(f"{where} {self._out}:\n{listed(changes)}\n{cure}")
        self._accepted.add(what)
        self._changes += [one for one in changes if one not in self._changes]
        if self._run:
            with self._db:
                self._write_changes()

    def _write_changes(self) -> None:
        value = canonical([asdict(one) for one in self._changes])
        self._db.execute("UPDATE runs SET changes = ? WHERE run = ?", (value, self._run))

    def record_attempt(self, job: Job, failure: Failure, *, retried: bool) -> None:
        where = (str(job.key), job.key.settings, job.attempt, self._run, time.time())
        why = (
            failure.cause,
            failure.code,
            failure.message,
            failure.traceback,
            failure.log,
            retried,
        )
        with self._db:
            self._db.execute(
                "INSERT INTO attempts VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", where + why
            )

    def note_worker(self, where: WorkerInfo) -> None:
        with self._db:
            insert(self._db, "workers", asdict(where) | {"run": self._run, "at": time.time()})

    def note_env(self, place: str, made: EnvInfo) -> None:
        """Record the description, contract and code of the env of the cases at `place`.

        Raises `ConfigError` if description or contract differ from an earlier run, as after an
        update of the simulator, or if the worker has other files than the process that made the
        plan.
        """
        [case, *_] = [case for case in self.cases if case.place == place]
        odd = program_changes(f"env {case.env}", case.program, made.program)
        # The environment itself may write a file that its settings name.
        if any(one.was is not None for one in odd):
            raise ConfigError(
                f"the worker on {made.host} has other files than this process, or they were edited "
                "since the start:\n"
                f"{listed(odd)}\ngive both the same files, and go on with --resume"
            )
        self._require_same_env(case, made)
        code = {} if made.code is None else made.code.to_json()
        found = (json.dumps(made.described, default=str), canonical(made.contract), canonical(code))
        with self._db:
            self._db.executemany(
                "UPDATE cases SET described = ?, contract = ?, code = ? WHERE case_id = ?",
                [(*found, case.fingerprint) for case in self.cases if case.place == place],
            )

    def _require_same_env(self, case: EvalCase, made: EnvInfo) -> None:
        # By another worker of this run; descriptions may differ between nodes.
        if case.place in self._made:
            return
        self._made.add(case.place)
        now = EnvStatement(
            json.loads(json.dumps(made.described, default=str)),
            json.loads(canonical(made.contract)),
        )
        changes: dict[Change, None] = {}
        for other in self.cases:  # also those of other policies, which are compared with this one
            if other.place != case.place:
                continue
            query = (
                "SELECT described, contract FROM cases WHERE case_id = ? AND described IS NOT NULL"
            )
            if (known := self._db.execute(query, (other.fingerprint,)).fetchone()) is not None:
                was = EnvStatement(*map(json.loads, known))
                changes |= dict.fromkeys(env_changes(case.env, was, now))
        self._accept_or_raise(
            case.place, list(changes), "the environment is not that of the results in"
        )

    def note_policy(self, name: str, metadata: dict[str, Any]) -> None:
        """Record the metadata of a policy's server; raises `ConfigError` if it is another policy
        than before.
        """
        row = self._db.execute("SELECT metadata FROM policies WHERE name = ?", (name,)).fetchone()
        known = None if row is None else json.loads(row[0])
        swept = any(case.step is not None for case in self.cases if case.policy.name == name)
        if known is not None:
            if (what := changed(known, metadata, swept=swept)) in ("policy", "checkpoint"):
                raise ConfigError(
                    f"policy {name!r}: the server has {what} {metadata.get(what)!r}, the results "
                    f"in {self._out} are of "
                    f"{known.get(what)!r}; serve that one again, or choose another out folder"
                )
            odd = policy_changes(f"policy {name}", known, metadata, swept=swept)
            self._accept_or_raise(("policy", name), odd, "the policy is not that of the results in")
        self._policy_programs[name] = program_id(policy_program(metadata, swept=swept))
        with self._db:
            value = json.dumps(metadata, default=str)
            self._db.execute("INSERT OR REPLACE INTO policies VALUES (?, ?)", (name, value))

    def _open(self, config: EvalConfig) -> sqlite3.Connection:
        # By default each commit reaches the disk.
        db = sqlite3.connect(self._out / FILE, timeout=WAIT_S)
        try:
            if db.execute("PRAGMA user_version").fetchone()[0] == 0:
                create(db)
            require_readable(self._out, db)
            self._require_resumable(db, config)
            stop = _rule(config)
            with db:
                for case in self.cases:
                    identity = (case.policy.name, case.step, case.suite.name, case.env)
                    extent = (case.planned, canonical(case.suite.seeds), stop)
                    row = (
                        case.fingerprint,
                        *identity,
                        canonical(case.settings),
                        *extent,
                        canonical(case.program),
                    )
                    db.execute(
                        "INSERT INTO cases (case_id, policy, step, suite, env, settings, planned, "
                        "seeds, stop, program)"
                        " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"
                        " ON CONFLICT DO UPDATE SET planned = ?, seeds = ?, stop = ?",
                        row + extent,
                    )
        except BaseException:
            db.close()
            raise
        return db

    def _require_resumable(self, db: sqlite3.Connection, config: EvalConfig) -> None:
        runs, episodes = (
            db.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0]  # noqa: S608
            for table in ("runs", "episodes")
        )
        causes = {cause for (cause,) in db.execute("SELECT DISTINCT cause FROM attempts")}
        if not runs and config.resume:
            others = [file.parent.name for file in self._out.parent.glob(f"*/{FILE}")]
            log.warning(
                "%s: has no results to resume (--resume), so that the evaluation begins there%s",
                self._out,
                did_you_mean(self._out.name, set(others) - {self._out.name}),
            )
        if not runs or (not episodes and causes == {"user"}):
            with db:
                for table in ("attempts", "cases", "policies", "workers", "runs"):
                    db.execute(f"DELETE FROM {table}")  # noqa: S608 - of a plan that could not begin
            return
        if not config.resume:
            raise ConfigError(
                f"{self._out} already has results ({episodes} episodes): resume them (--resume), "
                f"or choose another out folder"
            )
        if found := [f"- {text}" for case in self.cases for text in _differences(db, case)]:
            odd = "\n".join(found)
            raise ConfigError(
                f"{self._out} has results of other settings:\n{odd}\n"
                f"take the old settings, or choose another out folder"
            )
        lacking, programs = self._other_plan(db, config), dict[Change, None]()
        for case in self.cases:
            query = (
                "SELECT program FROM cases WHERE env = ? AND program IS NOT NULL AND case_id = ?"
            )
            if (row := db.execute(query, (case.env, case.fingerprint)).fetchone()) is not None:
                programs |= dict.fromkeys(
                    program_changes(f"env {case.env}", json.loads(row[0]), case.program)
                )
        self._accept_or_raise(
            "plan",
            lacking,
            "this plan is not that of the results in",
            "plan all of it; give a new folder (--out); or go on with this plan and have the "
            "report say so "
            "(--accept-changes)",
        )
        self._accept_or_raise(
            "program", list(programs), "the environment is not that of the results in"
        )

    def _other_plan(self, db: sqlite3.Connection, config: EvalConfig) -> list[Change]:
        """Return the cases and episodes of the results that this plan lacks, and other rules of
        early stopping.

        A plan may grow, also by steps of a policy, which `--watch` adds one after the other. A
        trainer evaluates versions of policies one after the other into one folder, each with its
        plan, so cases of other policies are not missing.
        """
        trained = all(case.policy.pushed_weights for case in self.cases)
        policies = {case.policy.name for case in self.cases}
        mine = {(case.policy.name, case.suite.name, case.env) for case in self.cases}
        rows = db.execute(
            "SELECT DISTINCT policy, suite, env FROM cases WHERE case_id IN (SELECT case_id FROM "
            "episodes)"
        )
        gone = [
            " ".join(filter(None, row))
            for row in rows
            if row not in mine and (row[0] in policies or not trained)
        ]
        changes = [Change("plan", name, "in it", None) for name in gone]
        rule = _rule(config)
        for case in self.cases:
            query = "SELECT planned, seeds, stop FROM cases WHERE case_id = ?"
            if (row := db.execute(query, (case.fingerprint,)).fetchone()) is not None:
                changes += _plan_changes(case, rule, *row)
        return changes


def _rule(config: EvalConfig) -> str | None:
    """Return the rule of early stopping as the table of cases has it."""
    return config.stop.model_dump_json() if config.stop else None


def _plan_changes(
    case: EvalCase, rule: str | None, planned: int, seeds_json: str, stop: str | None
) -> list[Change]:
    """Return what the plan of a case leaves out of the results, or another rule of early stopping
    than `stop`.

    Otherwise an evaluation could end where its rate looks good.
    """
    seeds = json.loads(seeds_json)
    episodes = planned // len(seeds)
    name = " ".join(filter(None, case.name))
    changes = []
    if case.suite.episodes < episodes:
        changes.append(Change("plan", f"{name}: episodes", str(episodes), str(case.suite.episodes)))
    if len(case.suite.seeds) < len(seeds):
        changes.append(Change("plan", f"{name}: seeds", str(seeds), str(case.suite.seeds)))
    if stop != rule:
        changes.append(Change("plan", f"{name}: early stopping", str(stop), str(rule)))
    return changes


def _differences(db: sqlite3.Connection, case: EvalCase) -> list[str]:
    """Return the settings of `case` that differ from those in the results, a sentence each; none
    for a new case.

    The first seeds must be the same: else episode 3 would be two episodes.
    """
    row = db.execute(
        "SELECT settings, seeds FROM cases"
        " WHERE policy = ? AND step IS ? AND suite = ? AND env = ?",
        (case.policy.name, case.step, case.suite.name, case.env),
    ).fetchone()
    if row is None:
        return []
    stored, seeds = map(json.loads, row)
    differing = [
        (name, stored.get(name), value)
        for name, value in case.settings.items()
        if stored.get(name) != value
    ]
    if any(old != new for old, new in zip(seeds, case.suite.seeds, strict=False)):
        differing.append(("seeds", seeds, case.suite.seeds))
    where = " ".join(filter(None, case.name))
    return [
        f"{where}: {name}: the results have {old!r}, now it is {new!r}"
        for name, old, new in differing
    ]
