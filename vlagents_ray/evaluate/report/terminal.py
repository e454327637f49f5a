"""An evaluation on a terminal: its progress, live or in plain lines, and the table of results at
its end.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from time import monotonic

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.console import Group as Rows
from rich.live import Live
from rich.table import Table
from rich.text import Text

from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.jobs import Job
from vlagents_ray.evaluate.results.comparison import clock_gaps
from vlagents_ray.evaluate.results.database import RUNNING
from vlagents_ray.evaluate.results.statistics import Rate, confidence_sequence
from vlagents_ray.evaluate.results.summary import (
    Group,
    Summary,
    cause_of,
    errors_of_policies,
    pushed_of,
)

LINE_EVERY_S = 5.0
MOST_ROWS = 12


class Progress:
    """The callbacks of a running evaluation, from one thread. This class shows nothing: override
    some.

    The classes of `progress_for` show them: live on a terminal, in plain lines elsewhere.
    """

    def begin(self, cases: Sequence[EvalCase], recorded: Mapping[str, Rate], left: int) -> None:
        """Note that the evaluation begins.

        Args:
            cases: All planned cases.
            recorded: The success rates of earlier runs, by the case's fingerprint.
            left: The number of episodes to be played.
        """

    def episode(self, case: EvalCase, result: EpisodeResult) -> None:
        """Note that an episode was recorded.

        Args:
            case: The case that it belongs to.
            result: Its result.
        """

    def retry(self, job: Job, failure: Failure) -> None:
        """Note that an attempt failed by infrastructure; the episode will be played again.

        Args:
            job: The episode.
            failure: The failure.
        """

    def stopped(self, case: EvalCase, at: int, spared: int) -> None:
        """Note that a case stopped early.

        Args:
            case: The case.
            at: The number of played episodes.
            spared: The number of episodes that will not be played.
        """

    def end(self) -> None:
        """Note that the evaluation has ended; no call follows."""


class _CountedProgress(Progress):
    """Counts for both displays, and prints errors and retries as lines."""

    def __init__(self, console: Console) -> None:
        self._console = console
        _CountedProgress.begin(self, [], {}, 0)

    def begin(self, cases: Sequence[EvalCase], recorded: Mapping[str, Rate], left: int) -> None:
        self._started = monotonic()
        self._cases = {case.fingerprint: case for case in cases}
        self._rates = {case: recorded.get(case, Rate(0, 0)) for case in self._cases}
        self._infra_failed = dict.fromkeys(self._cases, 0)
        self._steps = 0
        self._played = 0  # in this run
        self._left = left
        self._retries = 0
        self._causes: set[tuple[str, str]] = set()  # (policy id, cause) of errors that were shown
        self._alone = len({case.contender for case in cases}) == 1

    def episode(self, case: EvalCase, result: EpisodeResult) -> None:
        self._played += 1
        self._left -= 1
        self._steps += result.steps
        if result.status == "infra_failed":
            self._infra_failed[case.fingerprint] += 1
            return
        before = self._rates[case.fingerprint]
        successes, episodes = before.successes + bool(result.success_once), before.episodes + 1
        error_rate = before.error_rate  # of a case that may stop early
        bounds = (
            None if error_rate is None else confidence_sequence(successes, episodes, error_rate)
        )
        self._rates[case.fingerprint] = Rate(successes, episodes, bounds, error_rate)
        if result.status == "policy_error":
            error = (result.error or "").strip().partition("\n")[0]
            cause = case.contender, cause_of(error)
            if cause not in self._causes:
                self._causes.add(cause)
                where = f"{case.contender} failed in {case.env} episode {result.key.episode}"
                self._print(f"{where}, counted as no success: {error}")

    def retry(self, job: Job, failure: Failure) -> None:
        self._retries += 1
        first_line = failure.message.strip().partition("\n")[0]
        attempt = f"{job.key.env} episode {job.key.episode}: attempt {job.attempt}"
        self._print(f"{attempt} failed, trying again: {first_line}")

    def stopped(self, case: EvalCase, at: int, spared: int) -> None:
        self._left -= spared
        name = " ".join(filter(None, case.name))
        self._print(f"{name}: certain enough, stopped after {at} of {case.planned} episodes")

    def _print(self, text: str) -> None:
        self._console.print(
            text, markup=False, highlight=False, soft_wrap=not self._console.is_terminal
        )

    def _rows(self) -> list[tuple[str, str, str]]:
        """Return (name, "done/planned", success so far), of many cases only for those being
        played.
        """
        done = {case: self._rates[case].episodes + self._infra_failed[case] for case in self._cases}
        cases = list(self._cases)
        if len(cases) > MOST_ROWS:
            cases = [case for case in cases if 0 < done[case] < self._cases[case].planned][
                :MOST_ROWS
            ]
        rows = []
        for case in cases:
            # Of one policy, without its id.
            name = " ".join(filter(None, self._cases[case].name[self._alone :]))
            rows.append((name, f"{done[case]}/{self._cases[case].planned}", str(self._rates[case])))
        return rows

    def _overall(self) -> str:
        elapsed_s = monotonic() - self._started
        parts = ["waiting for the first episode"]
        if self._played:
            parts = [f"{self._steps / elapsed_s:.0f} steps/s"]
            if (left_s := seconds_left(self._left, self._played, elapsed_s)) is not None:
                parts.append(f"{datetime.timedelta(seconds=round(left_s))} left")
        if self._retries:
            parts.append(
                f"{self._retries} infrastructure {'retry' if self._retries == 1 else 'retries'}"
            )
        if any(self._infra_failed.values()):
            parts.append(f"{sum(self._infra_failed.values())} infrastructure failures")
        return " · ".join(parts)


class LiveProgress(_CountedProgress):
    """Updates a table on a terminal, with errors and retries above it."""

    def __init__(self, console: Console) -> None:
        super().__init__(console)
        self._live = Live(
            console=console, auto_refresh=True, refresh_per_second=4, get_renderable=self._drawing
        )

    def begin(self, cases: Sequence[EvalCase], recorded: Mapping[str, Rate], left: int) -> None:
        super().begin(cases, recorded, left)
        self._live.start()

    def end(self) -> None:
        self._live.stop()  # the last state stays on the terminal

    def _drawing(self) -> Rows:
        table = Table("env", "episodes", "success so far", box=None)
        for row in self._rows():
            table.add_row(*row)
        return Rows(table, Text(self._overall()))


class LineProgress(_CountedProgress):
    """Prints a line every few seconds, for logs."""

    def begin(self, cases: Sequence[EvalCase], recorded: Mapping[str, Rate], left: int) -> None:
        super().begin(cases, recorded, left)
        self._print_state()

    def episode(self, case: EvalCase, result: EpisodeResult) -> None:
        super().episode(case, result)
        if monotonic() - self._last >= LINE_EVERY_S:
            self._print_state()

    def end(self) -> None:
        self._print_state()

    def _print_state(self) -> None:
        self._last = monotonic()
        envs = " · ".join(f"{env} {done}, success {rate}" for env, done, rate in self._rows())
        self._print(f"{envs} · {self._overall()}")


def progress_for(console: Console) -> Progress:
    """Choose the display for `console`: a live table on a terminal, else a line every five
    seconds.
    """
    return LiveProgress(console) if console.is_terminal else LineProgress(console)


def seconds_left(episodes: int, played: int, elapsed_s: float) -> float | None:
    """Estimate the time of `episodes` further episodes, s; None if none are left or none was
    played.
    """
    return episodes * elapsed_s / played if episodes > 0 and played else None


def results_table(summary: Summary) -> Table:
    """Make a table of success, length and speed: for each policy id a row for each env, and one
    for all together.
    """
    names, error_rate = summary.results.contenders, summary.total.success_once.error_rate
    interval = "the Wilson 95 % interval"
    if error_rate is not None:
        interval = f"the confidence sequence of early stopping (error rate {error_rate:.2g})"
    title = f"{', '.join(names)}: success in %, with {interval}"
    table = Table(title=title, box=SIMPLE_HEAD, padding=0, pad_edge=False)
    if len(names) > 1:
        table.add_column("policy", overflow="fold")
    table.add_column("env", overflow="fold")
    some_lost = summary.total.infra_failures > 0
    rates = ("once", "once with lost", "at end") if some_lost else ("once", "at end")
    for title in ("episodes", *rates, "steps", "policy ms", "env ms"):
        table.add_column(title, justify="right", no_wrap=True)
    for name, total in zip(names, summary.totals, strict=True):
        groups = [(group, "") for group in summary.cases if group.contender == name]
        parts = summary.parts(name)
        totals = (
            [(total, "")] if len(parts) == 1 else [(part, timing) for timing, part in parts.items()]
        )
        for group, timing in [*groups, *totals] if len(groups) > 1 else groups:
            table.add_row(
                *([name] if len(names) > 1 else []), *_cells(group, timing, some_lost=some_lost)
            )
        table.add_section()
    return table


def print_summary(console: Console, summary: Summary) -> None:
    """Print the table of results, failures of infrastructure, and the paths of all files written.

    Args:
        console: The console.
        summary: The result of `evaluate`.
    """
    from vlagents_ray.evaluate.report.page import FILE  # late: Jinja is needed when all is played

    console.print(results_table(summary))
    total = summary.total
    if total.policy_errors:
        table = Table(title="Errors of policies", box=SIMPLE_HEAD, padding=0, pad_edge=False)
        for title in ("policy", "env", "error"):
            table.add_column(title, overflow="fold")
        table.add_column("episodes", justify="right", no_wrap=True)
        for (policy, task, error), number in errors_of_policies(summary.results):
            table.add_row(policy, task, Text(error.strip().partition("\n")[0]), str(number))
        console.print(table)
    speed = summary.rollout_steps_per_second
    lines = [f"{total.steps} steps in {summary.wall_seconds:.1f} s"]
    if speed is not None:
        lines[0] += f", {speed:.1f} a second once the workers had started"
    if summary.env_busy is not None and summary.policy_busy is not None:
        lines.append(
            f"envs busy for {summary.env_busy:.0%} of the workers' time, "
            f"the policy for {summary.policy_busy:.0%} of one replica's"
        )
    if total.policy_errors:
        lines.append(
            f"{total.policy_errors} episodes ended by an error of the policy; they count as no "
            "success"
        )
    if total.retries:
        lines.append(f"{total.retries} attempts lost to infrastructure and repeated")
    if total.infra_failures:
        lines.append(
            f"{total.infra_failures} episodes lost to infrastructure, in no rate; --resume tries "
            "them again"
        )
        lines.append(
            "once with lost: the bounds if all lost episodes had failed, or had been solved"
        )
    lines += [f"accepted change: {change}" for change in summary.results.accepted_changes]
    pushed = {
        case.contender: words
        for case in summary.results.cases
        if (words := pushed_of(case)) is not None
    }
    lines += [f"{name}: weights pushed by a learner, {words}" for name, words in pushed.items()]
    for one in (group for group in summary.cases if group.stopped):
        name, error_rate = (
            " ".join(filter(None, (one.contender, one.suite, one.env))),
            one.success_once.error_rate or 0,
        )
        lines.append(
            f"{name}: stopped after {one.episodes} of {one.planned} (error rate "
            f"{100 * error_rate:.2g} %)"
        )
    parts = [part for name in summary.results.contenders for part in summary.parts(name).values()]
    if not all(part.success_once.pooled for part in parts):
        lines.append(
            "cases that stopped after different numbers of episodes have no rate in common: quote "
            "each alone"
        )
    for gap in clock_gaps(summary.results):  # as in the report, on the episodes of both clocks
        counted = [one for case in gap.cases for one in case.counted]
        # 0 if the policy failed before the first step of each.
        steps = max(1, sum(one.steps for one in counted))
        waited, held = (
            sum(getattr(one, what) for one in counted) for what in ("ticks_waited", "ticks_held")
        )
        low, high = gap.total.interval
        lines.append(
            f"{gap.a}: {100 * (gap.total.pairs.difference or 0):+.1f} points to the synchronous "
            "score "
            f"({100 * low:+.1f} to {100 * high:+.1f}, {gap.total.pairs.total} pairs); "
            f"{waited / steps:.0%} of its ticks waited for an answer, {held / steps:.0%} with "
            "nothing to execute"
        )
    if summary.state != "complete":
        lines.append(
            "still running" if summary.state == RUNNING else f"{summary.state}: go on with --resume"
        )
    lines.append(f"results: {summary.out}")
    written = {"report": summary.out / FILE, "videos": summary.out / "videos"}
    lines += [f"{name}: {path}" for name, path in written.items() if path.exists()]
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def _cells(group: Group, timing: str, *, some_lost: bool) -> list[str]:
    bounds = group.with_lost(group.success_once)
    return [
        " ".join(filter(None, (group.suite, group.env, timing))),
        f"{group.episodes}/{group.planned}",
        str(group.success_once),
        *(
            ["-" if bounds is None else f"{100 * bounds[0]:.0f} to {100 * bounds[1]:.0f}%"]
            if some_lost
            else []
        ),
        "-" if group.success_at_end.rate is None else f"{group.success_at_end.rate:.0%}",
        _number(group.mean_steps),
        _number(group.policy_ms, 2),
        _number(group.env_step_ms, 2),
    ]


def _number(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
