"""The reader of a folder of results."""

from __future__ import annotations

import itertools
import json
import math
import sqlite3
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from vlagents_ray.chunking.timeliness import TimeShare
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.artifacts.storage import inside, require_below
from vlagents_ray.evaluate.episode.records import INIT_STATE, EpisodeResult, WorkerInfo
from vlagents_ray.evaluate.plan.cases import policy_id
from vlagents_ray.evaluate.plan.config import StopConfig
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.evaluate.results.changes import Change
from vlagents_ray.evaluate.results.database import (
    FILE,
    RUNNING,
    is_locked,
    read_only,
    require_readable,
)
from vlagents_ray.evaluate.results.early_stopping import CaseStopping, place_in_plan
from vlagents_ray.evaluate.results.statistics import (
    ERROR_RATE,
    Rate,
    independent_episodes,
    median,
    pooled,
)

KILLED = "killed"  # state of a run that was killed before it recorded an end

_SQLITE_FULL = 13  # value of sqlite3.SQLITE_FULL, which Python 3.10 lacks


@dataclass(frozen=True, slots=True)
class Episode:
    """A recorded episode."""

    result: EpisodeResult
    videos: tuple[str, ...]  # paths relative to the folder of results
    trajectory: str | None  # path relative to the folder of results
    attempts: int
    run: int
    finished: float  # seconds since 1970
    # Digest of the software that runs the episode, and of the environment's files.
    env_program: str | None = None
    # Digest of the software of the policy's server, of the policy's files, and of the values of a
    # factory; None if the server reports none.
    policy_program: str | None = None
    # Whether the episode follows the end of its case, which stopped early, or is no longer planned.
    beyond: bool = False
    unplanned: bool = False  # whether the episode is no longer planned

    @property
    def counts(self) -> bool:
        """Whether the rates include the episode. They exclude episodes that failed because of
        infrastructure or are `beyond`.
        """
        return self.result.status != "infra_failed" and not self.beyond


@dataclass(frozen=True, slots=True)
class Attempt:
    """An attempt at an episode that failed because of the infrastructure, not of the policy."""

    key: str  # the key of the episode
    case_id: str
    attempt: int  # number of the attempt, from 1
    run: int
    at: float  # seconds since 1970
    cause: str
    code: str
    error: str
    traceback: str
    log: str  # the end of the worker's output, if the worker died
    retried: bool


@dataclass(frozen=True, slots=True)
class Worker(WorkerInfo):
    """A record of a worker that connected to a policy or created an env. A worker may have several
    records.
    """

    run: int
    at: float  # seconds since 1970


@dataclass(frozen=True, slots=True)
class Run:
    """One run over the plan: the first run, or a run that resumed it."""

    run: int
    started: float  # seconds since 1970
    ended: float | None  # end of the run; None if the run has not ended, or was killed
    # "complete", "interrupted", "out of time", "stopped" by an error, "running", or "killed".
    state: str
    config: dict[str, Any]
    versions: dict[str, Any]
    changes: tuple[Change, ...] = ()  # accepted changes since earlier runs


@dataclass(frozen=True)
class CaseResults:
    """The results of one case: a policy, at a checkpoint, in an env of a suite."""

    case_id: str  # fingerprint of the case's settings
    policy: str
    step: int | None
    suite: str
    env: str
    planned: int
    settings: dict[str, Any]
    described: dict[str, Any]  # `EvalEnv.describe()`; {} if no worker has created the env
    contract: dict[str, Any]
    # Git state of the env's code, with `commit`, `dirty` and `diff_sha256`; {} if the code is not
    # in a git repository.
    code: dict[str, Any]
    # Versions of software and digests of the env's files, by their names, at the last run.
    program: dict[str, str]
    episodes: tuple[Episode, ...]  # in the order of the seeds
    attempts: tuple[Attempt, ...]
    stop: StopConfig | None = None  # the rule for stopping the case early
    # The number of episodes after which the case stopped; later episodes are kept, but not counted.
    stopped_at: int | None = None
    # The time at which the number of planned episodes, or the rule for stopping early, was last
    # chosen, s since 1970.
    planned_at: float = 0.0

    @property
    def policy_id(self) -> str:
        """The policy id: the policy's name, with "@STEP" in a sweep over checkpoints."""
        return policy_id(self.policy, self.step)

    @property
    def task(self) -> str:
        """The env, preceded by the name of its suite if it has one, as an env may be in several
        suites.
        """
        return f"{self.suite} {self.env}".strip()

    # The next three are cached, since each comparison of two policies reads them, and a report
    # compares each pair of policies.
    @cached_property
    def counted_episodes(self) -> tuple[Episode, ...]:
        """The episodes that the rates include."""
        return tuple(episode for episode in self.episodes if episode.counts)

    @cached_property
    def counted(self) -> tuple[EpisodeResult, ...]:
        """The results of the episodes that the rates include."""
        return tuple(episode.result for episode in self.counted_episodes)

    @cached_property
    def outcomes(self) -> dict[tuple[int, int], bool | None]:
        """Success once of each planned episode with a record, by number and seed; None if
        infrastructure lost the episode.
        """
        outcomes = {}
        for episode in self.episodes:
            if not episode.beyond:
                key = episode.result.key
                solved = bool(episode.result.success_once) if episode.counts else None
                outcomes[key.episode, key.seed] = solved
        return outcomes

    @property
    def lost(self) -> int:
        """The number of episodes that infrastructure lost, which the rates exclude."""
        return sum(solved is None for solved in self.outcomes.values())

    @property
    def missing(self) -> int:
        """The number of planned episodes without a result; 0 for a case that stopped early."""
        return self.planned - len(self.counted) if self.stopped_at is None else 0


@dataclass(frozen=True)
class Results:
    """The results of an evaluation from its folder; `Results.load` reads them, without Ray."""

    out: Path  # the folder of results
    cases: tuple[CaseResults, ...]  # in the order of the plan
    runs: tuple[Run, ...]
    # The metadata of each policy's server, by the policy's name.
    policies: dict[str, dict[str, Any]]
    workers: tuple[Worker, ...] = ()  # in the order of their time
    # The folders below `out`, if several folders were combined (see `combined`).
    parts: tuple[Path, ...] = ()

    @property
    def episodes(self) -> list[Episode]:
        """All recorded episodes, case by case."""
        return list(itertools.chain.from_iterable(case.episodes for case in self.cases))

    @property
    def counted(self) -> list[EpisodeResult]:
        """The results of all episodes that the rates include, case by case."""
        return list(itertools.chain.from_iterable(case.counted for case in self.cases))

    @property
    def accepted_changes(self) -> list[Change]:
        """Changes of files and weights between episodes, which `--accept-changes` accepted."""
        changes: list[Change] = []
        for run in self.runs:
            changes += run.changes
        return list(dict.fromkeys(changes))

    @property
    def versions(self) -> list[tuple[list[int], dict[str, Any]]]:
        """The versions of the software of all runs: the numbers of the runs that have the same
        versions, and these versions.
        """
        runs_by_versions: dict[str, list[Run]] = {}
        for run in self.runs:
            text = json.dumps(run.versions, sort_keys=True)
            runs_by_versions.setdefault(text, []).append(run)
        return [([run.run for run in runs], runs[0].versions) for runs in runs_by_versions.values()]

    @classmethod
    def load(cls, out: str | Path) -> Results:
        """Read a folder of results.

        Args:
            out: The folder, which is not changed. An evaluation may be writing to it.

        Returns:
            The results, in one consistent state.

        Raises:
            ConfigError: The folder contains no results, or the results are of another version or
                cannot be read.
        """
        out = Path(out)
        was_locked = is_locked(out)
        with reading(out) as db:
            episodes: dict[str, list[Episode]] = {}  # keys: cases
            for row in table(db, "episodes", "seed"):
                episodes.setdefault(row["case_id"], []).append(episode_of(row))

            attempts: dict[str, list[Attempt]] = {}  # keys: cases
            for row in table(db, "attempts"):
                attempt = Attempt(**row | {"retried": bool(row["retried"])})
                attempts.setdefault(attempt.case_id, []).append(attempt)

            cases = []
            for row in table(db, "cases"):
                case_id = row["case_id"]
                cases.append(_case(row, episodes.get(case_id, []), attempts.get(case_id, [])))

            runs = [_run(row) for row in table(db, "runs")]
            policies = {row["name"]: json.loads(row["metadata"]) for row in table(db, "policies")}
            workers = [Worker(**row) for row in table(db, "workers")]
            # Check the lock again, since an evaluation may have begun after the first check.
            is_written = was_locked or is_locked(out)

        for index, run in enumerate(runs):
            runs_now = is_written and index == len(runs) - 1
            if run.state == RUNNING and not runs_now:
                runs[index] = replace(run, state=KILLED)

        return cls(out, tuple(cases), tuple(runs), policies, tuple(workers))

    @property
    def policy_ids(self) -> list[str]:
        """The policy ids: policies without steps first, then the checkpoints of each policy by
        their step.
        """
        return list(self._policy_ids)

    @cached_property
    def _policy_ids(self) -> tuple[str, ...]:
        policies = list(dict.fromkeys(case.policy for case in self.cases))

        def rank(case: CaseResults) -> tuple[bool, int, int]:
            return case.step is not None, policies.index(case.policy), case.step or 0

        ordered = sorted(self.cases, key=rank)
        return tuple(dict.fromkeys(case.policy_id for case in ordered))

    @cached_property
    def starts(self) -> dict[str, dict[tuple[int, int], str]]:
        """The start of each episode (see `starts_of`)."""
        return starts_of(self.cases)

    def of(self, policy_id: str) -> list[CaseResults]:
        """Return the cases of one policy id, in the order of the plan."""
        return [case for case in self.cases if case.policy_id == policy_id]

    def file(self, path: str) -> Path:
        """Return the absolute path of an episode's file from the relative `path`; the file need not
        exist.

        Raises:
            ConfigError: The path leads out of the folder of results, or follows a symbolic link out
                of it.
        """
        absolute = self.out / path
        folders = (folder for folder in self.parts if absolute.is_relative_to(folder))
        home = next(folders, self.out)
        return inside(home, str(absolute.relative_to(home)))

    def among(self, cases: Sequence[CaseResults]) -> Results:
        """Return the same results with only these cases."""
        return replace(self, cases=tuple(cases))

    def only(self, policy_id: str | None = None, env: str | None = None) -> Results:
        """Select the cases of a policy or an env.

        Args:
            policy_id: The id of a policy; None for all.
            env: The full name of an env; None for all.

        Returns:
            The same results with only these cases.

        Raises:
            ConfigError: No case is left.
        """
        selected = []
        for case in self.cases:
            if policy_id in (None, case.policy_id) and env in (None, case.env):
                selected.append(case)
        if not selected:
            available = sorted({f"{case.policy_id} in {case.env}" for case in self.cases})
            raise ConfigError(
                f"{self.out}: expected episodes of {policy_id or 'any policy'} in "
                f"{env or 'any env'}, got none; the results have {available}"
            )
        return self.among(selected)


@contextmanager
def reading(out: Path) -> Iterator[sqlite3.Connection]:
    """Return a context manager that yields a connection to `out`, in which all tables are in one
    consistent state, even while an evaluation writes.
    """
    if not (out / FILE).is_file():
        raise ConfigError(
            f"{out}: expected a folder that an evaluation wrote, with {FILE} in it, got a folder "
            f"without this file; check the path"
        )
    try:
        with closing(read_only(out)) as db:
            require_readable(out, db)
            db.execute("PRAGMA trusted_schema = OFF")  # the file may come from a third party
            db.row_factory = sqlite3.Row
            db.execute("BEGIN")
            yield db
    except sqlite3.DatabaseError as error:
        # The error comes from the caller, which writes a copy to a full disk.
        if getattr(error, "sqlite_errorcode", None) == _SQLITE_FULL:
            raise
        raise ConfigError(
            f"{out / FILE}: cannot be read ({error}); if its evaluation was killed, --resume "
            "repairs it; otherwise copy the whole folder again from its original place"
        ) from error


def table(db: sqlite3.Connection, name: str, order: str = "rowid") -> Iterator[dict[str, Any]]:
    """Yield the rows of a table, each as a dict of values by the name of the column."""
    rows = db.execute(f"SELECT * FROM {name} ORDER BY {order}")  # noqa: S608 (constants)
    return map(dict, rows)


def episode_of(row: dict[str, Any]) -> Episode:
    """Return the episode of a row of the table.

    Raises:
        ConfigError: A path leads out of the folder.
    """
    names = {field.name for field in fields(EpisodeResult)} - {"key"}
    values = {name: value for name, value in row.items() if name in names}
    for name in ("success_once", "success_at_end"):
        if values[name] is not None:
            values[name] = bool(values[name])
    values["timing_ms"] = json.loads(row["timing_ms"])
    key = EpisodeKey(row["env"], row["episode"], row["seed"], row["case_id"])

    trajectory = row["trajectory"]
    return Episode(
        EpisodeResult(**values, key=key),
        videos=tuple(require_below(path) for path in json.loads(row["videos"])),
        trajectory=None if trajectory is None else require_below(trajectory),
        attempts=row["attempts"],
        run=row["run"],
        finished=row["finished"],
        env_program=row["env_program"],
        policy_program=row["policy_program"],
    )


def _run(row: dict[str, Any]) -> Run:
    """Return the run of a row of the table."""
    changes = [Change(**change) for change in json.loads(row["changes"] or "[]")]
    parsed = {
        "config": json.loads(row["config"]),
        "versions": json.loads(row["versions"]),
        "changes": tuple(changes),
    }
    return Run(**row | parsed)


def _case(
    row: dict[str, Any], episodes: Sequence[Episode], attempts: Sequence[Attempt]
) -> CaseResults:
    """Return the case of a row of the table, with its episodes marked by whether they count."""
    seeds, rule = json.loads(row.pop("seeds")), row.pop("stop")
    names = ("settings", "described", "contract", "code", "program")
    parsed = {name: json.loads(row[name] or "{}") for name in names}

    stop, stopping = None, None
    if rule is not None:
        stop = StopConfig.model_validate_json(rule)
        stopping = CaseStopping(stop, seeds, row["planned"])
        stopping.add_all(episode.result for episode in episodes)

    episodes_per_seed = row["planned"] // len(seeds)
    marked = []
    for episode in episodes:
        key = episode.result.key
        # If the evaluation was resumed with fewer episodes, the finished episodes beyond this
        # number would be a biased selection.
        unplanned = place_in_plan(key, seeds, episodes_per_seed) is None
        after_stop = stopping is not None and not stopping.counts(key)
        marked.append(replace(episode, beyond=unplanned or after_stop, unplanned=unplanned))

    return CaseResults(
        **row | parsed,
        episodes=tuple(marked),
        attempts=tuple(attempts),
        stop=stop,
        stopped_at=None if stopping is None else stopping.at,
    )


def rate_of(
    cases: Sequence[CaseResults], outcome: Literal["success_once", "success_at_end"]
) -> Rate:
    """Return the success rate of one case, or of several together, with bounds that are valid if
    the number of episodes may depend on their outcomes.

    For cases without a common rate (see `have_common_rate`), the counts are summed, but the rate is
    None.
    """
    rates = []
    for case in cases:
        solved = sum(bool(getattr(result, outcome)) for result in case.counted)
        rates.append(
            Rate(solved, len(case.counted), lost=case.lost, independent=_independent([case]))
        )

    bounds = error_rate = None
    if is_sequential(cases):
        rules = [case.stop.error_rate for case in cases if case.stop is not None]
        error_rate = max(rules, default=ERROR_RATE)
        bounds = pooled(rates, error_rate)
    return Rate(
        sum(rate.successes for rate in rates),
        sum(rate.episodes for rate in rates),
        bounds,
        error_rate,
        have_common_rate(cases),
        sum(rate.lost for rate in rates),
        _independent(cases),
    )


def _independent(cases: Sequence[CaseResults]) -> float | None:
    """Return the number of independent episodes in the cases, with the lost ones; None if no start
    is repeated. Cases of one policy id in one env have the same starts, also in several suites.
    """
    repeats: Counter[tuple[str, str, str]] = Counter()
    starts = starts_of(cases)
    for case in cases:
        names = starts[case.case_id].values()
        repeats.update((case.policy_id, case.env, start) for start in names)
    if all(number == 1 for number in repeats.values()):
        return None
    return independent_episodes(repeats.values())


def starts_of(cases: Iterable[CaseResults]) -> dict[str, dict[tuple[int, int], str]]:
    """Return the start of each episode in `CaseResults.outcomes`, by number and seed, for each
    case id.

    The start is the number of the initial state, if the environment has a fixed number of states.
    Otherwise it is the lowest seed whose first observation is the same, so that a seed also has
    one start if two suites render it differently. An episode without a recorded start has its seed.
    """
    cases = list(cases)
    lowest_seeds: dict[tuple[str, str], int] = {}  # by env and first observation
    for result in itertools.chain.from_iterable(map(_planned_results, cases)):
        if result.start is not None:
            place = result.key.env, result.start
            lowest_seeds[place] = min(result.key.seed, lowest_seeds.get(place, result.key.seed))

    starts_of_cases = {}
    for case in cases:
        starts = {}
        for result in _planned_results(case):
            start = result.start
            if start is None or not start.startswith(INIT_STATE):
                place = result.key.env, start or ""
                start = f"seed {lowest_seeds.get(place, result.key.seed)}"
            starts[result.key.episode, result.key.seed] = start
        starts_of_cases[case.case_id] = starts
    return starts_of_cases


def _planned_results(case: CaseResults) -> Iterator[EpisodeResult]:
    return (episode.result for episode in case.episodes if not episode.beyond)


def is_sequential(cases: Sequence[CaseResults]) -> bool:
    """Return whether the number of episodes of the cases may depend on their outcomes."""
    return bool(reasons_of_sequence(cases))


def reasons_of_sequence(cases: Sequence[CaseResults]) -> list[str]:
    """Return the reasons why the number of episodes of the cases may depend on their outcomes;
    empty if the number was chosen before the first outcome.
    """
    by_policy_id: dict[str, list[CaseResults]] = {}
    for case in cases:
        by_policy_id.setdefault(case.policy_id, []).append(case)

    reasons = []
    if any(case.stop is not None for case in cases):
        reasons.append("cases could stop early")
    if any(case.stop is None and len(case.outcomes) < case.planned for case in cases):
        reasons.append("planned episodes have no result yet")
    if any(map(_was_planned_late, by_policy_id.values())):
        reasons.append("the plan changed after the first results")
    return reasons


def _was_planned_late(cases: Sequence[CaseResults]) -> bool:
    """Return whether a case of a policy id was planned, or its number of episodes was changed,
    after the first result of this policy id.
    """
    finished = [episode.finished for case in cases for episode in case.episodes]
    return max(case.planned_at for case in cases) > min(finished, default=math.inf)


def have_common_rate(cases: Sequence[CaseResults]) -> bool:
    """Return whether one rate may be computed over the episodes of these cases.

    Cases that stopped after different numbers of episodes have no common rate, since their outcomes
    would determine their weights. Cases with different timings have no common rate (see
    `by_timing`): success in real time or on a robot differs from success while the env waits.
    """
    return len({case.stopped_at for case in cases}) <= 1 and len(by_timing(cases)) <= 1


def time_share_of(results: Sequence[EpisodeResult]) -> TimeShare | None:
    """Return the common figures of episodes in real time or on a robot; None if there are no such
    episodes.

    Ticks are summed. The ages are the medians of the episodes' percentiles.
    """
    time_shares = [result.time_share for result in results if result.time_share is not None]
    if not time_shares:
        return None
    return TimeShare(
        ticks=sum(share.ticks for share in time_shares),
        starved=sum(share.starved for share in time_shares),
        age_p50_ms=median(share.age_p50_ms for share in time_shares),
        age_p95_ms=median(share.age_p95_ms for share in time_shares),
        age_p99_ms=median(share.age_p99_ms for share in time_shares),
    )


SYNCHRONOUS, REAL_TIME, ON_ROBOT = "synchronous", "in real time", "on the robot"


def by_timing(cases: Sequence[CaseResults]) -> dict[str, list[CaseResults]]:
    """Group the cases by what happens while the policy computes: first "synchronous", then "in real
    time", then "on the robot".

    Each clock and each robot, with its control loop, has a separate group if there are several.
    """
    groups: dict[str, dict[str, list[CaseResults]]] = {SYNCHRONOUS: {}, REAL_TIME: {}, ON_ROBOT: {}}
    for case in cases:
        timing, settings = _timing(case)
        members = groups[timing].setdefault(json.dumps(settings, sort_keys=True), [])
        members.append(case)

    named = {}
    for timing, alike in groups.items():
        for number, members in enumerate(alike.values(), 1):
            suites = dict.fromkeys(case.suite or "the nameless suite" for case in members)
            name = timing if len(alike) == 1 else f"{timing} ({', '.join(suites)})"
            if name in named:  # suites of several folders may have one name
                name = f"{timing} ({', '.join(suites)}, {number})"
            named[name] = members
    return named


def _timing(case: CaseResults) -> tuple[str, Any]:
    """Return the timing of a case, and its settings."""
    robot, clock = case.settings.get("robot"), case.settings.get("clock")
    if robot is not None:
        return ON_ROBOT, {name: value for name, value in robot.items() if name != "task"}
    return (SYNCHRONOUS, None) if clock is None else (REAL_TIME, clock)


def synchronous_twin(results: Results, case: CaseResults) -> CaseResults | None:
    """Find the synchronous counterpart of a case in real time: the case that differs only in its
    clock.

    Args:
        results: The results with both cases.
        case: Any case in the results.

    Returns:
        The case in which the env waited for the policy; None if there is no such case, or if `case`
        itself is synchronous.
    """
    if _timing(case)[0] != REAL_TIME:
        return None
    settings = case.settings | {"clock": None}
    return next((twin for twin in results.cases if twin.settings == settings), None)
