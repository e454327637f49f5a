"""The live view of a folder of results: cases, learning curves, and failures with their videos."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.artifacts.storage import inside, outcome
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.jobs import Job
from vlagents_ray.evaluate.report.terminal import Progress, seconds_left
from vlagents_ray.evaluate.results.database import FILE, RUNNING
from vlagents_ray.evaluate.results.reader import (
    CaseResults,
    Episode,
    Results,
    is_sequential,
    rate_of,
    time_share_of,
)
from vlagents_ray.evaluate.results.statistics import Rate

STARTING = "starting"
_FAILURES = 24  # maximum number of failures in the document, which contains the newest
_TEXT = 300  # maximum length of an error or an instruction, characters
_EVERY_S = 1.0  # minimum time between two readings of the results, s
_SHARE = 0.04  # maximum share of a core for reading the results
WAITING, ENDED, STOPPED = "waiting", "ended", "stopped"


class ResultsDocument:
    """Describes the results of an evaluation or a training, which may run in another process.

    `read` and `video` must be called on one thread. The report's code computes the numbers from the
    folder, so they include earlier runs and, in a training, earlier versions. Results are read only
    when `read` is called.
    """

    reason = ""
    """The error that ended the evaluation."""

    # Whether further evaluations follow, such as the evaluations of later checkpoints of a
    # training.
    goes_on = False

    def __init__(self, out: Path) -> None:
        """Create a document of the results in the folder `out`, which need not exist yet."""
        self._out = out
        # Number of each video, by path, in the order of the numbers.
        self._numbers: dict[str, int] = {}
        self._document: dict[str, Any] = {}
        self._read_at, self._took_s = float("-inf"), 0.0

    def read(self) -> dict[str, Any]:
        """Return {"evaluation": the document}; this is the same object as before if the results
        were not read again.

        A call may take the time of reading the folder of results, but on average calls use at most
        4 % of a core.
        """
        age_s = time.monotonic() - self._read_at
        if self.is_due(rested=age_s >= max(_EVERY_S, self._took_s / _SHARE)):
            start_s = time.thread_time()
            self._document = {"evaluation": self._describe()}
            self._took_s = time.thread_time() - start_s
            self._read_at = time.monotonic()
        return self._document

    def video(self, number: int) -> Path | None:
        """Return the file of a video in the document; None if the file does not exist, or is a link
        out of the folder.
        """
        if not 0 <= number < len(self._numbers):
            return None
        try:
            path = inside(self._out, list(self._numbers)[number])
        except ConfigError:
            return None
        return path if path.is_file() else None

    def is_due(self, *, rested: bool) -> bool:
        """Return whether to read the results.

        Args:
            rested: Whether reading the results now keeps within the share of a core.
        """
        return rested

    def state(self, results: Results | None) -> str:
        """Return the state of the evaluation: "starting", or the state of its last run."""
        return results.runs[-1].state if results is not None and results.runs else STARTING

    def _describe(self) -> dict[str, Any]:
        results = None
        with contextlib.suppress(ConfigError):  # raised while another process creates the file
            results = Results.load(self._out) if (self._out / FILE).is_file() else None
        state = self.state(results)
        cases = () if results is None else results.cases

        ends = None
        if results is not None and state == RUNNING:
            now = time.time()
            run = results.runs[-1]
            played = sum(episode.run == run.run for episode in results.episodes)
            remaining = sum(_planned(case) - _done(case) for case in cases)
            left_s = seconds_left(remaining, played, now - run.started)
            ends = None if left_s is None else now + left_s

        unsolved: list[tuple[CaseResults, Episode]] = []
        for case in cases:
            for episode in case.episodes:
                if not episode.beyond and not episode.result.success_once:
                    unsolved.append((case, episode))
        unsolved.sort(key=lambda failure: failure[1].finished, reverse=True)

        return {
            "name": self._out.name,
            "state": state,
            "reason": self.reason[:_TEXT],
            "ends": ends,
            "goes_on": self.goes_on,
            "policy_ids": [] if results is None else results.policy_ids,
            "tasks": list(dict.fromkeys(case.task for case in cases)),
            "done": sum(_done(case) for case in cases),
            "planned": sum(_planned(case) for case in cases),
            "retries": sum(_retries(case) for case in cases),
            "cases": [_case(case) for case in cases],
            "curves": [] if results is None else _curves(results),
            "failed": len(unsolved),
            "failures": [self._failure(case, episode) for case, episode in unsolved[:_FAILURES]],
        }

    def _failure(self, case: CaseResults, episode: Episode) -> dict[str, Any]:
        result = episode.result
        return {
            "key": result.full_key,
            "policy": case.policy_id,
            "task": case.task,
            "episode": result.key.episode,
            "seed": result.key.seed,
            "outcome": outcome(result),
            "error": (result.error or "")[:_TEXT],
            "instruction": result.instruction[:_TEXT],
            "steps": result.steps,
            "finished": episode.finished,
            "videos": [self._number_of(video) for video in episode.videos],
        }

    def _number_of(self, video: str) -> int:
        """Return the number by which the page requests a video."""
        return self._numbers.setdefault(video, len(self._numbers))


def _case(case: CaseResults) -> dict[str, Any]:
    time_share = time_share_of(case.counted)
    return {
        "policy": case.policy_id,
        "task": case.task,
        "done": _done(case),
        "planned": _planned(case),
        "stopped": case.stopped_at is not None,
        "sequence": is_sequential([case]),
        # Share of the ticks in time, among the ticks that need an action of the policy; None if the
        # environment waits for the policy.
        "share_in_time": None if time_share is None else time_share.share,
    } | _rate(rate_of([case], "success_once"))


def _curves(results: Results) -> list[dict[str, Any]]:
    """Return the success rate at each step or version, for each policy that has steps."""
    points: dict[str, list[dict[str, Any]]] = {}  # keys: policies
    for policy_id in results.policy_ids:
        cases = results.of(policy_id)
        policy, step = cases[0].policy, cases[0].step
        if step is None:
            continue
        is_whole = all(_done(case) == _planned(case) for case in cases)
        point = {"step": step, "whole": is_whole} | _rate(rate_of(cases, "success_once"))
        points.setdefault(policy, []).append(point)
    return [{"policy": policy, "points": its_points} for policy, its_points in points.items()]


def _done(case: CaseResults) -> int:
    """Return the number of episodes that ended, including those lost to infrastructure."""
    return sum(not episode.beyond for episode in case.episodes)


def _planned(case: CaseResults) -> int:
    """Return the number of planned episodes, without episodes that are no longer needed because
    their case stopped early.
    """
    return case.planned if case.stopped_at is None else _done(case)


def _retries(case: CaseResults) -> int:
    return sum(attempt.retried for attempt in case.attempts)


def _rate(rate: Rate) -> dict[str, Any]:
    low, high = rate.interval
    return {
        "successes": rate.successes,
        "episodes": rate.episodes,
        "rate": rate.rate,
        "low": low,
        "high": high,
    }


class ProgressDocument(ResultsDocument, Progress):
    """Describes an evaluation to which it is connected as the `Progress`. The page's thread may
    read it concurrently.
    """

    def __init__(self, out: Path, shown: Progress | None = None, *, goes_on: bool = False) -> None:
        super().__init__(out)
        self.goes_on = goes_on
        self._shown = shown or Progress()
        self._state = STARTING
        self._changed = True

    def begin(self, cases: Sequence[EvalCase], recorded: Mapping[str, Rate], left: int) -> None:
        self._change(RUNNING)
        self._shown.begin(cases, recorded, left)

    def episode(self, case: EvalCase, result: EpisodeResult) -> None:
        self._changed = True
        self._shown.episode(case, result)

    def retry(self, job: Job, failure: Failure) -> None:
        self._changed = True
        self._shown.retry(job, failure)

    def stopped(self, case: EvalCase, at: int, spared: int) -> None:
        self._changed = True
        self._shown.stopped(case, at, spared)

    def end(self) -> None:
        """Record that the evaluation has ended; the state is "waiting" if further evaluations
        follow.
        """
        if self.goes_on:
            self._change(WAITING)
        else:
            self.close()
        self._shown.end()

    def close(self) -> None:
        """Record that no further evaluation follows; the state is then the state of the last
        run.
        """
        if self._state != STOPPED:
            self._change(ENDED)

    def fail(self, reason: str) -> None:
        """Record that an error stopped the evaluation."""
        self.reason = reason
        self._change(STOPPED)

    def is_due(self, *, rested: bool) -> bool:
        """Return whether to read the results: after a change if `rested`, and always after the
        end.
        """
        is_final = self._changed and self._state in (ENDED, STOPPED)
        is_due = is_final or (rested and (self._changed or self._state == RUNNING))
        if is_due:
            self._changed = False
        return is_due

    def state(self, results: Results | None) -> str:
        return super().state(results) if self._state == ENDED else self._state

    def _change(self, state: str) -> None:
        self._state = state
        self._changed = True
