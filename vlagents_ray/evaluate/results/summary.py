"""`summary.json`: the outcome of an evaluation, its uncertainty, and its provenance."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from vlagents_ray.chunking.timeliness import TimeShare
from vlagents_ray.evaluate.artifacts.storage import whole
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.results.comparison import gap_to_synchronous
from vlagents_ray.evaluate.results.reader import (
    SYNCHRONOUS,
    CaseResults,
    Results,
    by_timing,
    have_common_rate,
    rate_of,
    reasons_of_sequence,
    time_share_of,
)
from vlagents_ray.evaluate.results.statistics import Rate, median

FILE = "summary.json"
TOTAL = "total"
Reported = Literal["checkpoint", "weights", "revision"]  # fields of an episode's result


@dataclass(frozen=True, slots=True)
class Group:
    """Aggregates over the episodes of one or several cases.

    Rates count an error of the policy as a failure. Episodes that failed because of infrastructure
    are excluded from all rates.
    """

    policy_id: str  # the policy id, or "total"
    suite: str
    env: str  # the name of the env, or "total"
    planned: int
    stopped: int  # number of cases that stopped early
    success_once: Rate
    success_at_end: Rate
    # Number of episodes that ended with an error of the policy; they count as failures.
    policy_errors: int
    # Number of episodes that failed because of infrastructure; excluded from all rates.
    infra_failures: int
    retries: int  # number of attempts that failed because of infrastructure and were repeated
    steps: int  # number of actions executed in all episodes
    # None if the episodes have no common rate; the same applies to `mean_return`.
    mean_steps: float | None
    mean_return: float | None  # mean of the episodes' returns
    env_step_ms: float | None  # median of the episodes' medians
    policy_ms: float | None  # median of the episodes' medians
    policy_p95_ms: float | None  # median of the episodes' 95th percentiles
    # See `time_share_of`; None for cases of several clocks or robots.
    time_share: TimeShare | None

    @property
    def episodes(self) -> int:
        """The number of finished episodes."""
        return self.success_once.episodes

    def with_lost(self, rate: Rate) -> tuple[float, float] | None:
        """Return the values that `rate` would have with the lost episodes, if all of them had
        failed and if all had succeeded.

        These bounds matter because losses may depend on the policy, for example if its actions make
        a simulator fail.

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
        time_share = None if self.time_share is None else self.time_share.to_json()
        return (
            asdict(self)
            | {"episodes": self.episodes}
            | rates
            | {"with_lost": lost, "time_share": time_share}
        )


@dataclass(frozen=True, slots=True)
class Summary:
    """The outcome of an evaluation, which `evaluate` returns; `to_json` returns the content of
    summary.json.
    """

    results: Results
    cases: tuple[Group, ...]
    totals: tuple[Group, ...]  # a group for each policy id, in the order of `results.policy_ids`
    wall_seconds: float  # duration, summed over all runs, including the start of the workers
    rollout_seconds: float  # time from the first reset to the last step, summed over all runs

    @property
    def out(self) -> Path:
        """The folder of the results."""
        return self.results.out

    @property
    def state(self) -> str:
        """The state of the last run, see `Run.state`."""
        return self.results.runs[-1].state

    @property
    def total(self) -> Group:
        """The group of all episodes."""
        return group_of((TOTAL, "", TOTAL), self.results.cases)

    def parts(self, policy_id: str) -> dict[str, Group]:
        """Return the totals of a policy id for each timing of its episodes (see `by_timing`)."""
        return {
            timing: group_of((policy_id, "", TOTAL), cases)
            for timing, cases in by_timing(self.results.of(policy_id)).items()
        }

    @property
    def reasons_of_sequence(self) -> list[str]:
        """The reasons why intervals are confidence sequences (see `reasons_of_sequence`)."""
        reasons: list[str] = []
        for cases in by_timing(self.results.cases).values():
            reasons += reasons_of_sequence(cases)
        return list(dict.fromkeys(reasons))

    @property
    def has_one_rate_each(self) -> bool:
        """Whether each policy id has a common rate for all its cases with the same timing."""
        for policy_id in self.results.policy_ids:
            groups = self.parts(policy_id).values()
            if not all(group.success_once.pooled for group in groups):
                return False
        return True

    @property
    def best(self) -> list[str]:
        """The policy ids, best first, sorted by the mean success rate of their cases with the same
        timing, in which lost episodes count as failures.

        The timing is the first one in `by_timing`: "synchronous", if there are such episodes.
        """
        rates: dict[str, list[float]] = {name: [] for name in self.results.policy_ids}
        timings = list(by_timing(self.results.cases).values())
        for case in timings[0] if timings else []:
            once = rate_of([case], "success_once")
            rates[case.policy_id].append(once.successes / max(1, once.episodes + once.lost))

        means = {}
        for name, values in rates.items():
            means[name] = sum(values) / len(values) if values else 0.0
        return sorted(means, key=lambda name: -means[name])

    @property
    def transports(self) -> list[str]:
        """The transports with which observations were sent to the policies."""
        return sorted({result.transport for result in self.results.counted})

    @property
    def steps_per_second(self) -> float | None:
        """Env steps of all workers per second of `wall_seconds`; None if no time has passed."""
        return self.total.steps / self.wall_seconds if self.wall_seconds else None

    @property
    def rollout_steps_per_second(self) -> float | None:
        """Env steps of all workers per second of `rollout_seconds`; None if no time has passed."""
        return self.total.steps / self.rollout_seconds if self.rollout_seconds else None

    @property
    def env_busy(self) -> float | None:
        """The share of the workers' time that was spent on resets and steps of environments; None
        on a robot.
        """
        simulated = [result for result in self.results.counted if result.env_seconds is not None]
        busy_s = [result.env_seconds for result in simulated]
        return _share(busy_s, sum(result.seconds for result in simulated))

    @property
    def policy_busy(self) -> float | None:
        """The computing time of the policies as a share of `rollout_seconds`, which may exceed 1
        with several replicas; None if no time has passed.
        """
        computed_s = [result.policy_seconds for result in self.results.counted]
        return _share(computed_s, self.rollout_seconds)

    def to_json(self) -> dict[str, Any]:
        """Return the content of summary.json."""
        groups_and_cases = zip(self.cases, self.results.cases, strict=True)
        last_run = self.results.runs[-1]
        return {
            "state": self.state,
            "cases": [self._case_json(group, case) for group, case in groups_and_cases],
            "totals": [group.to_json() for group in self.totals],
            "wall_seconds": self.wall_seconds,
            "rollout_seconds": self.rollout_seconds,
            "steps_per_second": self.steps_per_second,
            "rollout_steps_per_second": self.rollout_steps_per_second,
            "env_busy": self.env_busy,
            "policy_busy": self.policy_busy,
            "transports": self.transports,
            "accepted_changes": [asdict(change) for change in self.results.accepted_changes],
            "confidence_sequences": self.reasons_of_sequence,
            "policies": self.results.policies,
            "versions": [
                {"runs": numbers, **versions} for numbers, versions in self.results.versions
            ],
            "config": last_run.config,
        }

    def _case_json(self, group: Group, case: CaseResults) -> dict[str, Any]:
        """Return the JSON entry of a case, whose aggregate is `group`."""
        weights = {field: reported(case, field) for field in get_args(Reported)}
        return (
            group.to_json()
            | weights
            | {
                "pushed_weights": pushed_of(case),
                "settings": case.settings,
                "env": case.env,
                "described": case.described,
                "contract": case.contract,
                "code": case.code,
                "program": case.program,
                "stopped_at": case.stopped_at,
                "gap_to_synchronous": gap_to_synchronous(self.results, case),
            }
        )


def summarize(results: Results) -> Summary:
    """Aggregate results, including those of earlier runs."""
    wall_s = rollout_s = 0.0
    for run in results.runs:
        played = [episode for episode in results.episodes if episode.run == run.run]
        begins = [episode.finished - episode.result.seconds for episode in played]
        last_end = max((episode.finished for episode in played), default=run.started)

        # A killed run has no recorded end; the end of its last episode is used.
        end = last_end if run.ended is None else run.ended
        wall_s += end - run.started
        rollout_s += last_end - min(begins, default=last_end)

    cases = [group_of((case.policy_id, case.suite, case.env), [case]) for case in results.cases]
    totals = [group_of((name, "", TOTAL), results.of(name)) for name in results.policy_ids]
    return Summary(results, tuple(cases), tuple(totals), wall_s, rollout_s)


def reported(case: CaseResults, field: Reported) -> str | None:
    """Return the checkpoint, the digest of the weights, or the weights' commit on the hub; None if
    the policy did not report this value.
    """
    for result in case.counted:
        value: str | None = getattr(result, field)
        if value is not None:
            return value
    return None


def pushed_of(case: CaseResults) -> str | None:
    """Return a text about the pushed weights of a case's episodes; None if only the checkpoint's
    weights were used.

    If several versions were used in a case, its rate describes none of them.
    """
    # Fingerprint of each version of the weights that computed a last action.
    fingerprints: dict[int, str | None] = {}
    versions: set[int] = set()
    for result in case.counted:
        if result.policy_version is not None:
            fingerprints[result.policy_version] = result.policy_fingerprint
            versions.add(result.policy_version)
        if result.first_policy_version is not None:
            versions.add(result.first_policy_version)
    if not any(versions):
        return None

    first, last = min(versions), max(versions)
    if first == last:
        return f"version {last} ({fingerprints[last]})"
    return f"versions {first} to {last} in turn"


def cause_of(error: str) -> str:
    """Return the first line of an error, without numbers and ids, which differ between errors with
    the same cause.
    """
    return re.sub(r"[0-9a-f]{8,}|\d+(\.\d+)?", "…", error.strip().partition("\n")[0])


def errors_of_policies(results: Results) -> list[tuple[tuple[str, str, str], int]]:
    """Return the errors that ended episodes, one for each cause: (policy id, task, error) and the
    number of episodes.
    """
    by_cause: dict[tuple[str, str, str], list[str]] = {}  # errors by policy id, task and cause
    for case in results.cases:
        for result in case.counted:
            if result.status == "policy_error":
                error = result.error or ""
                key = (case.policy_id, case.task, cause_of(error))
                by_cause.setdefault(key, []).append(error)
    return [
        ((policy, task, errors[0]), len(errors)) for (policy, task, _), errors in by_cause.items()
    ]


def failing_cases(results: Results) -> list[CaseResults]:
    """Return the cases in which an error of the policy ended every episode."""
    failing = []
    for case in results.cases:
        statuses = {result.status for result in case.counted}
        if statuses == {"policy_error"}:
            failing.append(case)
    return failing


def write_summary(summary: Summary) -> Path:
    """Write summary.json into the folder of results, completely or not at all, and return the path
    of the file.
    """
    path = summary.out / FILE
    text = json.dumps(summary.to_json(), indent=2) + "\n"
    with whole(path) as temporary:
        temporary.write_text(text)
    return path


def group_of(name: tuple[str, str, str], cases: Sequence[CaseResults]) -> Group:
    """Aggregate these cases under the name (policy id, suite, env)."""
    finished: list[EpisodeResult] = []
    infra_failures = retries = 0
    for case in cases:
        finished += case.counted
        retries += sum(attempt.retried for attempt in case.attempts)
        for episode in case.episodes:
            if episode.result.status == "infra_failed" and not episode.beyond:
                infra_failures += 1

    timings = by_timing(cases).keys() - {SYNCHRONOUS}
    steps = [result.steps for result in finished]
    mean_steps = mean_return = None
    if finished and have_common_rate(cases):
        mean_steps = float(np.mean(steps))
        mean_return = float(np.mean([result.episode_return for result in finished]))

    return Group(
        *name,
        planned=sum(case.planned for case in cases),
        stopped=sum(case.stopped_at is not None for case in cases),
        success_once=rate_of(cases, "success_once"),
        success_at_end=rate_of(cases, "success_at_end"),
        policy_errors=sum(result.status == "policy_error" for result in finished),
        infra_failures=infra_failures,
        retries=retries,
        steps=sum(steps),
        mean_steps=mean_steps,
        mean_return=mean_return,
        env_step_ms=median(result.env_step_ms for result in finished),
        policy_ms=median(result.policy_ms for result in finished),
        policy_p95_ms=median(result.policy_p95_ms for result in finished),
        time_share=time_share_of(finished) if len(timings) <= 1 else None,
    )


def _share(seconds: Sequence[float | None], total_s: float) -> float | None:
    """Return the sum of the known `seconds` as a share of `total_s`; None if no value is known."""
    known_s = [value for value in seconds if value is not None]
    return sum(known_s) / total_s if known_s and total_s else None
