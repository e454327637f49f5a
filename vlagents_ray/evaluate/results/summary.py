"""`summary.json`: the outcome of an evaluation, its uncertainty, and its provenance."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from vlagents_ray.evaluate.artifacts.storage import whole
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.results.comparison import gap_to_synchronous
from vlagents_ray.evaluate.results.reader import (
    CaseResults,
    Results,
    by_timing,
    have_common_rate,
    rate_of,
)
from vlagents_ray.evaluate.results.statistics import Rate

FILE = "summary.json"
TOTAL = "total"
Stated = Literal["checkpoint", "weights", "revision"]  # of an episode's result


@dataclass(frozen=True, slots=True)
class Group:
    """Aggregates over the episodes of one case, or of several.

    Rates count an error of the policy as a failure. Episodes that failed by infrastructure are in
    no rate.
    """

    contender: str  # the policy id: its name, with "@STEP" in a sweep; or "total"
    suite: str
    env: str  # or "total"
    planned: int
    stopped: int  # cases that stopped early
    success_once: Rate
    success_at_end: Rate
    policy_errors: int  # episodes that an error of the policy ended; not successes
    infra_failures: int  # episodes that failed by infrastructure; in no rate
    retries: int  # attempts that failed by infrastructure and were repeated
    steps: int  # actions executed in all episodes
    mean_steps: float | None  # None if the episodes have no common rate, as `mean_return`
    mean_return: float | None  # of the sums of rewards
    env_step_ms: float | None  # median of the episodes' medians
    policy_ms: float | None  # median of the episodes' medians
    policy_p95_ms: float | None  # median of the episodes' 95th percentiles

    @property
    def episodes(self) -> int:
        """The number of finished episodes."""
        return self.success_once.episodes

    def with_lost(self, rate: Rate) -> tuple[float, float] | None:
        """Return the bounds of one of the rates with lost episodes: all of them failures, or all
        successes.

        Losses may depend on the policy, such as those of a simulator that its actions break.

        Returns:
            (low, high) in [0, 1]; None if no episode was lost, or the episodes have no common rate.
        """
        if not self.infra_failures or not rate.pooled:
            return None
        planned = rate.episodes + self.infra_failures
        return rate.successes / planned, (rate.successes + self.infra_failures) / planned

    def to_json(self) -> dict[str, Any]:
        """Return the fields for JSON, with `episodes`, and the bounds `with_lost` of each rate."""
        rates = {
            "success_once": self.success_once.to_json(),
            "success_at_end": self.success_at_end.to_json(),
        }
        lost = {name: self.with_lost(getattr(self, name)) for name in rates}
        return asdict(self) | {"episodes": self.episodes} | rates | {"with_lost": lost}


@dataclass(frozen=True, slots=True)
class Summary:
    """The outcome of an evaluation, as `evaluate` returns it; `to_json` is the content of
    summary.json.
    """

    results: Results
    cases: tuple[Group, ...]
    totals: tuple[Group, ...]  # one for each policy id, in the order of `results.contenders`
    wall_seconds: float  # of all runs together, the start of the workers included
    rollout_seconds: float  # from the first reset to the last step, of all runs together

    @property
    def out(self) -> Path:
        """The folder of the results."""
        return self.results.out

    @property
    def state(self) -> str:
        """The state of the last run, as in `Run.state`."""
        return self.results.runs[-1].state

    @property
    def total(self) -> Group:
        """All episodes together."""
        return group_of((TOTAL, "", TOTAL), self.results.cases)

    def parts(self, contender: str) -> dict[str, Group]:
        """Return the totals of a policy id, by the clock of their episodes (`by_timing`)."""
        return {
            timing: group_of((contender, "", TOTAL), cases)
            for timing, cases in by_timing(self.results.of(contender)).items()
        }

    @property
    def best(self) -> list[str]:
        """The policy ids, the best first, by the mean success rate of their cases with one clock.

        The clock is the first of `by_timing`: that of the episodes that waited for the policy, if
        there are any.
        """
        rates: dict[str, list[float]] = {name: [] for name in self.results.contenders}
        timings = list(by_timing(self.results.cases).values())
        for case in timings[0] if timings else []:
            rates[case.contender].append(rate_of([case], "success_once").rate or 0.0)
        means = {
            name: sum(values) / len(values) if values else 0.0 for name, values in rates.items()
        }
        return sorted(means, key=lambda name: -means[name])

    @property
    def transports(self) -> list[str]:
        """The transports by which observations reached the policies."""
        return sorted({result.transport for result in self._counted})

    @property
    def steps_per_second(self) -> float | None:
        """Env steps of all workers together per second of `wall_seconds`; None if no time has
        passed.
        """
        return self.total.steps / self.wall_seconds if self.wall_seconds else None

    @property
    def rollout_steps_per_second(self) -> float | None:
        """Env steps of all workers together per second of `rollout_seconds`; None if no time has
        passed.
        """
        return self.total.steps / self.rollout_seconds if self.rollout_seconds else None

    @property
    def env_busy(self) -> float | None:
        """The share of the workers' time in which they reset and stepped environments; None on a
        robot.
        """
        played = [one for one in self._counted if one.env_seconds is not None]
        return _share([one.env_seconds for one in played], sum(one.seconds for one in played))

    @property
    def policy_busy(self) -> float | None:
        """The share of `rollout_seconds` in which policies computed, above 1 with several
        replicas; None as above.
        """
        return _share([one.policy_seconds for one in self._counted], self.rollout_seconds)

    @property
    def _counted(self) -> list[EpisodeResult]:
        return [result for case in self.results.cases for result in case.counted]

    def to_json(self) -> dict[str, Any]:
        """Return the content of summary.json."""
        cases = [
            group.to_json()
            | {what: stated(case, what) for what in get_args(Stated)}
            | {"pushed_weights": pushed_of(case)}
            | {"settings": case.settings, "env": case.env}
            | {"described": case.described, "contract": case.contract, "code": case.code}
            | {"program": case.program}
            | {
                "stopped_at": case.stopped_at,
                "gap_to_synchronous": gap_to_synchronous(self.results, case),
            }
            for group, case in zip(self.cases, self.results.cases, strict=True)
        ]
        last = self.results.runs[-1]
        return {
            "state": self.state,
            "cases": cases,
            "totals": [group.to_json() for group in self.totals],
            "wall_seconds": self.wall_seconds,
            "rollout_seconds": self.rollout_seconds,
            "steps_per_second": self.steps_per_second,
            "rollout_steps_per_second": self.rollout_steps_per_second,
            "env_busy": self.env_busy,
            "policy_busy": self.policy_busy,
            "transports": self.transports,
            "accepted_changes": [asdict(one) for one in self.results.accepted_changes],
            "policies": self.results.policies,
            "versions": last.versions,
            "config": last.config,
        }


def summarize(results: Results) -> Summary:
    """Aggregate results, those of earlier runs included."""
    wall_s = rollout_s = 0.0
    for run in results.runs:
        played = [one for case in results.cases for one in case.episodes if one.run == run.run]
        last = max((one.finished for one in played), default=run.started)
        # A killed one ended with its last episode.
        wall_s += (last if run.ended is None else run.ended) - run.started
        rollout_s += last - min((one.finished - one.result.seconds for one in played), default=last)
    return Summary(
        results,
        tuple(group_of((case.contender, case.suite, case.env), [case]) for case in results.cases),
        tuple(group_of((name, "", TOTAL), results.of(name)) for name in results.contenders),
        wall_s,
        rollout_s,
    )


def stated(case: CaseResults, what: Stated) -> str | None:
    """Return the checkpoint, the digest of the weights, or the weights' commit on the hub; None
    if none was stated.
    """
    found: list[str | None] = [getattr(one, what) for one in case.counted]
    return next((one for one in found if one is not None), None)


def pushed_of(case: CaseResults) -> str | None:
    """Return the pushed weights of a case's episodes, in words; None if only the checkpoint's
    weights acted.

    The rate of a case of several versions describes none of them.
    """
    named = {
        one.policy_version: one.policy_fingerprint
        for one in case.counted
        if one.policy_version is not None
    }
    numbers = {
        one.first_policy_version for one in case.counted if one.first_policy_version is not None
    } | named.keys()
    if not any(numbers):
        return None
    first, last = min(numbers), max(numbers)
    return (
        f"version {last} ({named[last]})"
        if first == last
        else f"versions {first} to {last}, one after the other"
    )


def cause_of(error: str) -> str:
    """Return the first line of an error, without the numbers and ids in which errors of one
    cause differ.
    """
    return re.sub(r"[0-9a-f]{8,}|\d+(\.\d+)?", "…", error.strip().partition("\n")[0])


def errors_of_policies(results: Results) -> list[tuple[tuple[str, str, str], int]]:
    """Return errors that ended episodes: (policy id, task, an error of the cause), and the
    number of episodes.
    """
    found: dict[tuple[str, str, str], list[str]] = {}
    for case in results.cases:
        for one in case.counted:
            if one.status == "policy_error":
                error = one.error or ""
                found.setdefault((case.contender, case.task, cause_of(error)), []).append(error)
    return [((policy, task, errors[0]), len(errors)) for (policy, task, _), errors in found.items()]


def failing_cases(results: Results) -> list[CaseResults]:
    """Return the cases in which an error of the policy ended every episode."""
    outcomes = [(case, {one.status for one in case.counted}) for case in results.cases]
    return [case for case, statuses in outcomes if statuses == {"policy_error"}]


def write_summary(summary: Summary) -> Path:
    path = summary.out / FILE
    with whole(path) as part:
        part.write_text(json.dumps(summary.to_json(), indent=2) + "\n")
    return path


def group_of(name: tuple[str, str, str], cases: Sequence[CaseResults]) -> Group:
    """Aggregate these cases under the name (policy id, suite, env)."""
    finished: list[EpisodeResult] = [result for case in cases for result in case.counted]
    has_means = bool(finished) and have_common_rate(cases)
    return Group(
        *name,
        planned=sum(case.planned for case in cases),
        stopped=sum(case.stopped_at is not None for case in cases),
        success_once=rate_of(cases, "success_once"),
        success_at_end=rate_of(cases, "success_at_end"),
        policy_errors=sum(one.status == "policy_error" for one in finished),
        infra_failures=sum(
            one.result.status == "infra_failed" and not one.beyond
            for case in cases
            for one in case.episodes
        ),
        retries=sum(attempt.retried for case in cases for attempt in case.attempts),
        steps=sum(one.steps for one in finished),
        mean_steps=float(np.mean([one.steps for one in finished])) if has_means else None,
        mean_return=float(np.mean([one.episode_return for one in finished])) if has_means else None,
        env_step_ms=median([one.env_step_ms for one in finished]),
        policy_ms=median([one.policy_ms for one in finished]),
        policy_p95_ms=median([one.policy_p95_ms for one in finished]),
    )


def median(values: Iterable[float | None]) -> float | None:
    """Return the median of the known values; None without any."""
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def _share(parts: Sequence[float | None], whole_s: float) -> float | None:
    known = [part for part in parts if part is not None]
    return sum(known) / whole_s if known and whole_s else None
