"""Writes `results.db`: the state of an evaluation in SQLite, with one transaction for each episode.

A commit survives even if the process is killed, so an evaluation that is killed and resumed
contains each episode exactly once. Read it with `vlagents_ray.evaluate.results.reader`.
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
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.config import canonical
from vlagents_ray.evaluate.plan.jobs import Job
from vlagents_ray.evaluate.plan.resolved import ResolvedPlan
from vlagents_ray.evaluate.results.changes import (
    MIX,
    PLAN,
    Change,
    EnvStatement,
    changed,
    env_changes,
    listed,
    policy_changes,
    policy_program,
    program_changes,
    program_id,
    with_known,
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

    def __init__(self, plan: ResolvedPlan) -> None:
        """Open the results in `plan.out`, or create new results.

        Raises:
            ConfigError: The folder has results and `plan.resume` is False; or their settings
                differ; or their code or files differ and `plan.accept_changes` is False; or another
                evaluation is writing to the folder.
            StorageFailed: The folder cannot be written to.
        """
        self.cases = plan.cases
        self.out = plan.out
        self._plan = plan
        self._cases_by_id = {case.fingerprint: case for case in self.cases}
        with storing(self.out):
            self.out.mkdir(parents=True, exist_ok=True)
            self._lock = lock(self.out)

        self._run = 0  # the number of this run
        # Whether the folder has no results, except rows of a run that could not begin.
        self._begins_anew = False
        self._changes: list[Change] = []  # the accepted changes of this run
        self._accepted: set[Hashable] = set()  # policies, cases and places with accepted changes
        self._policy_programs: dict[str, str | None] = {}  # metadata of each policy's server
        # Places whose env has been compared with earlier runs.
        self._compared_envs: set[str] = set()

        # Digests of the weights by case, and by (policy, step, checkpoint); read from the database
        # at the first use.
        self._weights: dict[Hashable, str] = {}

        try:
            with storing(self.out):
                self._db = self._open()
        except BaseException:
            os.close(self._lock)
            raise

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the database, and release the lock of the folder."""
        self._db.close()
        os.close(self._lock)

    def begin_run(self, versions: dict[str, Any], started: float | None = None) -> None:
        """Record that a run over the plan begins now, or began at `started`, s since 1970."""
        row = (
            time.time() if started is None else started,
            RUNNING,
            self._plan.settings.model_dump_json(),
            canonical(versions),
        )
        with self._db:
            if self._begins_anew:
                for table in ("attempts", "cases", "policies", "workers", "runs"):
                    self._db.execute(f"DELETE FROM {table}")  # noqa: S608 - one of these constants
            # Before the first row of this run, which changes what the plan is compared with.
            self._changes += self._growth()
            self._plan_cases(row[0])
            cursor = self._db.execute(
                "INSERT INTO runs (started, state, config, versions) VALUES (?, ?, ?, ?)", row
            )
            self._run = int(cursor.lastrowid or 0)
            self._write_changes()

    def _plan_cases(self, now: float) -> None:
        """Write the cases of the plan; `now` is the time of the plan, s since 1970."""
        stop = self._stopping_rule()
        for case in self.cases:
            row = {
                "case_id": case.fingerprint,
                "policy": case.policy.name,
                "step": case.step,
                "suite": case.suite.name,
                "env": case.env,
                "settings": canonical(case.settings),
                "planned": case.planned,
                "seeds": canonical(case.suite.seeds),
                "stop": stop,
                "program": canonical(case.program),
                "planned_at": now,
            }
            self._db.execute(
                "INSERT INTO cases (case_id, policy, step, suite, env, settings, planned, seeds, "
                "stop, program, planned_at) VALUES (:case_id, :policy, :step, :suite, :env, "
                ":settings, :planned, :seeds, :stop, :program, :planned_at) ON CONFLICT DO UPDATE "
                "SET planned_at = CASE WHEN planned = :planned AND seeds = :seeds AND stop IS "
                ":stop THEN planned_at ELSE :planned_at END, planned = :planned, seeds = :seeds, "
                "stop = :stop, program = :program",
                row,
            )

    def _growth(self) -> list[Change]:
        """Return the episodes and cases that the plan adds to policy ids that have results.

        They are accepted, but recorded: one could add episodes until the result looks good.
        """
        with_results = set(
            self._db.execute(
                "SELECT DISTINCT c.policy, c.step FROM episodes e JOIN cases c ON c.case_id = "
                "e.case_id"
            )
        )
        changes = []
        for case in self.cases:
            if (case.policy.name, case.step) not in with_results:
                continue
            name = " ".join(filter(None, case.name))
            row = self._db.execute(
                "SELECT planned, seeds FROM cases WHERE case_id = ?", (case.fingerprint,)
            ).fetchone()
            if row is None:
                changes.append(Change(PLAN, name, None, "in it"))
                continue
            planned, seeds = row[0], json.loads(row[1])
            episodes = planned // len(seeds)
            if case.suite.episodes > episodes:
                now = str(case.suite.episodes)
                changes.append(Change(PLAN, f"{name}: episodes", str(episodes), now))
            if len(case.suite.seeds) > len(seeds):
                now = str(case.suite.seeds)
                changes.append(Change(PLAN, f"{name}: seeds", str(seeds), now))
        return changes

    def end_run(self, state: str) -> None:
        """Record that the run ends now, in one of the states of `Run.state`."""
        with self._db:
            self._db.execute(
                "UPDATE runs SET ended = ?, state = ? WHERE run = ?",
                (time.time(), state, self._run),
            )

    def finished(self) -> set[str]:
        """Return the keys of the episodes that have a result and will not run again."""
        query = "SELECT key FROM episodes WHERE status != 'infra_failed'"
        return {key for (key,) in self._db.execute(query)}

    def record(
        self,
        result: EpisodeResult,
        attempts: int,
        videos: Sequence[str] = (),
        trajectory: str | None = None,
        finished: float | None = None,
    ) -> None:
        """Record an episode that finished now, or at `finished`, s since 1970.

        It replaces an episode with the same key that failed because of infrastructure. An episode
        that has a result is never changed.

        Raises:
            ConfigError: The episode ran with another checkpoint than earlier episodes of its case,
                or with other weights of the same name. All episodes of a success rate need the same
                checkpoint.
            WeightsLost: The episode ran with weights other than the pushed weights that its case
                evaluates.
        """
        case = self._cases_by_id[result.key.settings]
        _require_pushed_weights(case, result)
        self._require_same_checkpoint(result)
        self._require_same_weights(result)

        row = asdict(result)
        key = row.pop("key")
        del key["policy_seed"]  # in an evaluation, the policy's seed equals the environment's seed
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

    def _require_same_checkpoint(self, result: EpisodeResult) -> None:
        """Raise `ConfigError` if earlier episodes of the case ran with another checkpoint."""
        query = (
            "SELECT checkpoint FROM episodes WHERE case_id = ? AND checkpoint IS NOT NULL LIMIT 1"
        )
        row = self._db.execute(query, (result.key.settings,)).fetchone()
        if row is None or result.checkpoint is None:
            return
        (recorded_checkpoint,) = row
        if result.checkpoint != recorded_checkpoint:
            raise ConfigError(
                f"policy: expected the checkpoint {recorded_checkpoint!r} of the results in "
                f"{self.out}, got {result.checkpoint!r} in {result.key}; serve the first again, or "
                "choose another out folder"
            )

    def _require_same_weights(self, result: EpisodeResult) -> None:
        """Raise `ConfigError` unless the weights equal the weights of earlier episodes of the case
        and of other cases with the same checkpoint, or changes are accepted.
        """
        if result.weights is None:
            return
        if not self._weights:
            query = (
                "SELECT DISTINCT e.case_id, c.policy, c.step, e.checkpoint, e.weights FROM "
                "episodes e JOIN cases c ON c.case_id = e.case_id WHERE e.weights IS NOT NULL"
            )
            for case_id, policy, step, checkpoint, weights in self._db.execute(query):
                self._weights[case_id] = weights
                self._weights[policy, step, checkpoint] = weights

        case = self._cases_by_id[result.key.settings]
        owners: tuple[Hashable, ...] = (
            case.fingerprint,
            (case.policy.name, case.step, result.checkpoint),
        )
        for owner in owners:
            recorded_weights = self._weights.setdefault(owner, result.weights)
            if result.weights == recorded_weights:
                continue
            name = result.checkpoint or "weights"
            change = Change(f"policy {case.policy_id}", name, recorded_weights, result.weights)
            self._accept_or_raise(
                owner, [change], f"{result.key} was run with other weights than the results in"
            )
            self._weights[owner] = result.weights

    def _accept_or_raise(
        self, subject: Hashable, changes: list[Change], where: str, cure: str = MIX
    ) -> None:
        """Record changes since earlier runs, once per subject in a run, or raise `ConfigError` if
        the plan does not accept changes.

        If a subject changes again within a run, the processes of the run have different files,
        which is an error.
        """
        if not changes:
            return
        accepts = self._plan.accept_changes
        if not accepts or subject in self._accepted:
            cure = "all processes of a run need the same files" if accepts else cure
            raise ConfigError(f"{where} {self.out}:\n{listed(changes)}\n{cure}")

        self._accepted.add(subject)
        self._changes += [change for change in changes if change not in self._changes]
        if self._run:
            with self._db:
                self._write_changes()

    def _write_changes(self) -> None:
        value = canonical([asdict(change) for change in self._changes])
        self._db.execute("UPDATE runs SET changes = ? WHERE run = ?", (value, self._run))

    def record_attempt(self, job: Job, failure: Failure, *, retried: bool) -> None:
        """Record an attempt that failed because of infrastructure.

        Args:
            job: The episode and the number of the attempt.
            failure: The failure.
            retried: Whether another attempt follows.
        """
        row = {
            "key": str(job.key),
            "case_id": job.key.settings,
            "attempt": job.attempt,
            "run": self._run,
            "at": time.time(),
            "cause": failure.cause,
            "code": failure.code,
            "error": failure.message,
            "traceback": failure.traceback,
            "log": failure.log,
            "retried": retried,
        }
        with self._db:
            insert(self._db, "attempts", row)

    def note_worker(self, worker: WorkerInfo) -> None:
        """Record a worker that has connected to its policy, or created its env."""
        with self._db:
            insert(self._db, "workers", asdict(worker) | {"run": self._run, "at": time.time()})

    def note_env(self, place: str, env_info: EnvInfo) -> None:
        """Record the description, contract and code of an env that a worker has created.

        Args:
            place: Suite and env of the cases (`EvalCase.place`).
            env_info: The description that the worker reports.

        Raises:
            ConfigError: The description or the contract differs from an earlier run, for example
                after an update of the simulator, or the worker's files differ from the files of the
                process that created the plan.
        """
        cases = [case for case in self.cases if case.place == place]
        env = cases[0].env
        changes = []
        for change in program_changes(f"env {env}", cases[0].program, env_info.program):
            # New files are allowed: the environment itself may write a file that its settings name.
            # A worker may have its own packages (`runtime_env`).
            if change.was is not None and change.subject != "software":
                changes.append(change)
        if changes:
            raise ConfigError(
                f"expected the files of this process on the worker at {env_info.host}, got other "
                f"files, or the files were edited since the start:\n{listed(changes)}\ngive both "
                f"the same "
                "files, and continue with --resume"
            )

        # Compare the env only once in a run, since descriptions may differ between nodes.
        if place not in self._compared_envs:
            self._compared_envs.add(place)
            self._require_same_env(cases, env_info)

        # An empty description or contract does not replace an earlier one.
        described = json.dumps(env_info.described, default=str) if env_info.described else None
        contract = canonical(env_info.contract) if env_info.contract else None
        code = {} if env_info.code is None else env_info.code.to_json()
        values = (described, contract, canonical(code))
        with self._db:
            self._db.executemany(
                "UPDATE cases SET described = coalesce(?, described, '{}'), "
                "contract = coalesce(?, contract, '{}'), code = ? WHERE case_id = ?",
                [(*values, case.fingerprint) for case in cases],
            )

    def _require_same_env(self, cases: Sequence[EvalCase], env_info: EnvInfo) -> None:
        """Raise `ConfigError` unless the description and the contract equal those of earlier runs
        for any of the cases, or changes are accepted.

        The cases share one env. They include the cases of all policies, since policies are compared
        with each other.
        """
        env, place = cases[0].env, cases[0].place
        now = EnvStatement(
            json.loads(json.dumps(env_info.described, default=str)),
            json.loads(canonical(env_info.contract)),
        )
        query = "SELECT described, contract FROM cases WHERE case_id = ? AND described IS NOT NULL"
        changes: dict[Change, None] = {}
        for case in cases:
            row = self._db.execute(query, (case.fingerprint,)).fetchone()
            if row is not None:
                described, contract = row
                was = EnvStatement(json.loads(described), json.loads(contract))
                changes |= dict.fromkeys(env_changes(env, was, now))
        self._accept_or_raise(
            place, list(changes), "the environment differs from the environment of the results in"
        )

    def note_policy(self, name: str, metadata: dict[str, Any]) -> None:
        """Record the metadata of a policy's server.

        Raises:
            ConfigError: The policy differs from the policy of earlier runs.
        """
        row = self._db.execute("SELECT metadata FROM policies WHERE name = ?", (name,)).fetchone()
        earlier = None if row is None else json.loads(row[0])
        swept = any(case.step is not None for case in self.cases if case.policy.name == name)
        if earlier is not None:
            field = changed(earlier, metadata, swept=swept)
            if field in ("policy", "checkpoint"):
                raise ConfigError(
                    f"policy {name!r}: expected {field} {earlier.get(field)!r}, as in the results "
                    f"in {self.out}, got {metadata.get(field)!r} from the server; serve the "
                    "first again, or choose another out folder"
                )
            changes = policy_changes(f"policy {name}", earlier, metadata, swept=swept)
            self._accept_or_raise(
                ("policy", name), changes, "the policy differs from the policy of the results in"
            )

        self._policy_programs[name] = program_id(policy_program(metadata, swept=swept))
        recorded = metadata if earlier is None else with_known(metadata, earlier)
        with self._db:
            value = json.dumps(recorded, default=str)
            self._db.execute("INSERT OR REPLACE INTO policies VALUES (?, ?)", (name, value))

    def _open(self) -> sqlite3.Connection:
        # With SQLite's default settings, each commit is flushed to the disk.
        db = sqlite3.connect(self.out / FILE, timeout=WAIT_S)
        try:
            if db.execute("PRAGMA user_version").fetchone()[0] == 0:
                create(db)
            require_readable(self.out, db)
            self._require_resumable(db)
        except BaseException:
            db.close()
            raise
        return db

    def _require_resumable(self, db: sqlite3.Connection) -> None:
        """Raise `ConfigError` unless this plan may continue the results in the folder, if there are
        any.
        """
        (runs,) = db.execute("SELECT COUNT(*) FROM runs").fetchone()
        (episodes,) = db.execute("SELECT COUNT(*) FROM episodes").fetchone()
        causes = {cause for (cause,) in db.execute("SELECT DISTINCT cause FROM attempts")}
        if not runs and self._plan.resume:
            folders = {file.parent.name for file in self.out.parent.glob(f"*/{FILE}")}
            log.warning(
                "%s: has no results to resume (--resume), so a new evaluation begins there%s",
                self.out,
                did_you_mean(self.out.name, folders - {self.out.name}),
            )

        could_not_begin = not episodes and causes == {"user"}
        self._begins_anew = not runs or could_not_begin
        if self._begins_anew:
            return

        if not self._plan.resume:
            raise ConfigError(
                f"{self.out} already has results ({episodes} episodes): resume them (--resume), "
                "or choose another out folder"
            )

        differences: list[str] = []
        for case in self.cases:
            differences += [f"- {difference}" for difference in _differences(db, case)]
        if differences:
            listing = "\n".join(differences)
            raise ConfigError(
                f"{self.out}: expected results of these settings, got results of "
                f"others:\n{listing}\nuse the earlier settings, or choose another out folder"
            )

        self._accept_or_raise(
            PLAN,
            self._other_plan(db),
            "this plan differs from the plan of the results in",
            "plan all of it; choose a new folder (--out); or continue with this plan, which the "
            "report will mention (--accept-changes)",
        )
        self._accept_or_raise(
            "program",
            self._other_programs(db),
            "the environment differs from the environment of the results in",
        )

    def _stopping_rule(self) -> str | None:
        """Return the rule of early stopping in the format of the table of cases."""
        return None if self._plan.stop is None else self._plan.stop.model_dump_json()

    def _other_programs(self, db: sqlite3.Connection) -> list[Change]:
        """Return the changes in the environments' files since earlier runs."""
        query = "SELECT program FROM cases WHERE case_id = ? AND program IS NOT NULL"
        changes: dict[Change, None] = {}
        for case in self.cases:
            row = db.execute(query, (case.fingerprint,)).fetchone()
            if row is not None:
                was = json.loads(row[0])
                changes |= dict.fromkeys(program_changes(f"env {case.env}", was, case.program))
        return list(changes)

    def _other_plan(self, db: sqlite3.Connection) -> list[Change]:
        """Return the cases and episodes of the results that this plan lacks, and changed rules of
        early stopping.

        A plan may grow (see `_growth`); for example, `--watch` adds one step of a policy after
        another. A trainer
        evaluates the versions of its policies one after another into one folder, and each plan
        contains only the cases of one policy. So the cases of other policies do not count as
        missing.
        """
        is_training = all(case.policy.pushed_weights for case in self.cases)
        policies = {case.policy.name for case in self.cases}
        planned = {(case.policy.name, case.suite.name, case.env) for case in self.cases}
        recorded = db.execute(
            "SELECT DISTINCT policy, suite, env FROM cases WHERE case_id IN (SELECT case_id FROM "
            "episodes)"
        )
        changes = []
        for policy, suite, env in recorded:
            is_expected = policy in policies or not is_training
            if is_expected and (policy, suite, env) not in planned:
                name = " ".join(filter(None, (policy, suite, env)))
                changes.append(Change(PLAN, name, "in it", None))

        rule = self._stopping_rule()
        query = "SELECT planned, seeds, stop FROM cases WHERE case_id = ?"
        for case in self.cases:
            row = db.execute(query, (case.fingerprint,)).fetchone()
            if row is not None:
                changes += _plan_changes(case, rule, *row)
        return changes


def _require_pushed_weights(case: EvalCase, result: EpisodeResult) -> None:
    """Raise `WeightsLost` if an action was computed with weights other than the pushed weights that
    the case evaluates.
    """
    pushed = case.policy.pushed_weights
    if pushed is None or result.policy_version is None:
        return
    first, last = result.first_policy_version, result.policy_version
    acted = (first, last, result.policy_fingerprint)
    if acted != (pushed.version, pushed.version, pushed.fingerprint):
        raise WeightsLost(
            f"policy: expected version {pushed.version} of the weights ({pushed.fingerprint}) in "
            f"{result.key}, got {first} to {last} ({result.policy_fingerprint}); push nothing "
            f"while a version is evaluated, and select no other version with the policy's `options`"
        )


def _plan_changes(
    case: EvalCase, rule: str | None, planned: int, seeds_json: str, stop: str | None
) -> list[Change]:
    """Return the seeds and episodes in the results that the plan of a case lacks, and a change of
    its rule of early stopping.

    Without this check, one could end an evaluation when the rate happens to be high.
    """
    seeds = json.loads(seeds_json)
    episodes = planned // len(seeds)
    name = " ".join(filter(None, case.name))
    changes = []
    if case.suite.episodes < episodes:
        changes.append(Change(PLAN, f"{name}: episodes", str(episodes), str(case.suite.episodes)))
    if len(case.suite.seeds) < len(seeds):
        changes.append(Change(PLAN, f"{name}: seeds", str(seeds), str(case.suite.seeds)))
    if stop != rule:
        changes.append(Change(PLAN, f"{name}: early stopping", str(stop), str(rule)))
    return changes


def _differences(db: sqlite3.Connection, case: EvalCase) -> list[str]:
    """Return a sentence for each setting of `case` that differs from the results; empty for a new
    case.

    The first seeds must be equal; otherwise the number of an episode would refer to two different
    episodes.
    """
    row = db.execute(
        "SELECT settings, seeds FROM cases WHERE policy = ? AND step IS ? AND suite = ? AND env = "
        "?",
        (case.policy.name, case.step, case.suite.name, case.env),
    ).fetchone()
    if row is None:
        return []
    recorded, recorded_seeds = map(json.loads, row)

    # (name, recorded value, planned value) of each difference.
    differing: list[tuple[str, Any, Any]] = []
    for name, value in case.settings.items():
        if recorded.get(name) != value:
            differing.append((name, recorded.get(name), value))
    both_seeds = zip(recorded_seeds, case.suite.seeds, strict=False)
    if any(old != new for old, new in both_seeds):
        differing.append(("seeds", recorded_seeds, case.suite.seeds))

    case_name = " ".join(filter(None, case.name))
    return [
        f"{case_name}: {name}: the results have {old!r}, now it is {new!r}"
        for name, old, new in differing
    ]
