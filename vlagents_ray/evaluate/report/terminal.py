"""The output of an evaluation on a terminal: the progress, as a live table or in plain lines, and
the table of results at the end.
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

from vlagents_ray.chunking.timeliness import in_words
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.jobs import Job
from vlagents_ray.evaluate.results.comparison import clock_gaps
from vlagents_ray.evaluate.results.database import RUNNING
from vlagents_ray.evaluate.results.modes import modes
from vlagents_ray.evaluate.results.reader import CaseResults
from vlagents_ray.evaluate.results.statistics import Rate
from vlagents_ray.evaluate.results.summary import (
    Group,
    Summary,
    cause_of,
    errors_of_policies,
    pushed_of,
)

LINE_EVERY_S = 5.0
MOST_ROWS = 12  # maximum number of rows in the table of a running evaluation


class Progress:
    """The callbacks of a running evaluation, which are called on one thread.

    The methods of this class do nothing; derived classes override some of them. The objects that
    `progress_for` returns show the progress, as a live table on a terminal and in plain lines
    elsewhere.
    """

    def begin(self, cases: Sequence[EvalCase], recorded: Mapping[str, Rate], left: int) -> None:
        """Called when the evaluation begins.

        Args:
            cases: All planned cases.
            recorded: The success rates of earlier runs, by the case's fingerprint.
            left: The number of episodes to run.
        """

    def episode(self, case: EvalCase, result: EpisodeResult) -> None:
        """Called when an episode was recorded.

        Args:
            case: The case of the episode.
            result: The result of the episode.
        """

    def retry(self, job: Job, failure: Failure) -> None:
        """Called when an attempt failed because of infrastructure; the episode will be run
        again.

        Args:
            job: The episode.
            failure: The failure.
        """

    def stopped(self, case: EvalCase, at: int, spared: int) -> None:
        """Called when a case stopped early.

        Args:
            case: The case.
            at: The number of finished episodes.
            spared: The number of planned episodes that will not be run.
        """

    def end(self) -> None:
        """Called when the evaluation has ended; no other call follows."""


class _CountedProgress(Progress):
    """The base class of both displays: maintains the counts, and prints errors and retries as
    lines.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        _CountedProgress.begin(self, [], {}, 0)

    def begin(self, cases: Sequence[EvalCase], recorded: Mapping[str, Rate], left: int) -> None:
        """Start the counts from the rates of earlier runs."""
        self._started = monotonic()
        self._cases = {case.fingerprint: case for case in cases}
        # The keys of the next two dicts are the fingerprints of the cases.
        self._rates = {case_id: recorded.get(case_id, Rate(0, 0)) for case_id in self._cases}
        self._infra_failed = dict.fromkeys(self._cases, 0)
        self._steps = 0
        self._played = 0  # number of finished episodes of this run
        self._left = left
        self._retries = 0
        # (policy id, cause) of the errors that were already shown.
        self._causes: set[tuple[str, str]] = set()
        self._is_one_policy = len({case.policy_id for case in cases}) == 1

    def episode(self, case: EvalCase, result: EpisodeResult) -> None:
        """Count an episode; print an error of the policy if its cause is new."""
        self._played += 1
        self._left -= 1
        self._steps += result.steps
        if result.status == "infra_failed":
            self._infra_failed[case.fingerprint] += 1
            return

        before = self._rates[case.fingerprint]
        successes = before.successes + bool(result.success_once)
        self._rates[case.fingerprint] = Rate(successes, before.episodes + 1)

        if result.status == "policy_error":
            error = (result.error or "").strip().partition("\n")[0]
            cause = case.policy_id, cause_of(error)
            if cause not in self._causes:
                self._causes.add(cause)
                where = f"{case.policy_id} failed in {case.env} episode {result.key.episode}"
                self._print(f"{where}, counted as no success: {error}")

    def retry(self, job: Job, failure: Failure) -> None:
        """Print the reason why an attempt failed."""
        self._retries += 1
        first_line = failure.message.strip().partition("\n")[0]
        attempt = f"{job.key.env} episode {job.key.episode}: attempt {job.attempt}"
        self._print(f"{attempt} failed, trying again: {first_line}")

    def stopped(self, case: EvalCase, at: int, spared: int) -> None:
        """Print the number of episodes after which a case stopped."""
        self._left -= spared
        name = " ".join(filter(None, case.name))
        self._print(f"{name}: certain enough, stopped after {at} of {case.planned} episodes")

    def _print(self, text: str) -> None:
        self._console.print(
            text, markup=False, highlight=False, soft_wrap=not self._console.is_terminal
        )

    def _rows(self) -> list[tuple[str, str, str]]:
        """Return a row (name, "done/planned", success so far) for each case; if there are many
        cases, only for the cases in progress, i.e. with some but not all episodes finished.
        """
        show_all = len(self._cases) <= MOST_ROWS
        rows: list[tuple[str, str, str]] = []
        for case_id, case in self._cases.items():
            rate = self._rates[case_id]
            done = rate.episodes + self._infra_failed[case_id]
            # Without an interval: episodes that end early are a biased sample.
            so_far = "-" if rate.rate is None else f"{rate.rate:.0%}"
            is_being_played = 0 < done < case.planned
            if len(rows) < MOST_ROWS and (show_all or is_being_played):
                policy_id, suite, env = case.name
                names = (suite, env) if self._is_one_policy else (policy_id, suite, env)
                rows.append((" ".join(filter(None, names)), f"{done}/{case.planned}", so_far))
        return rows

    def _overall(self) -> str:
        elapsed_s = monotonic() - self._started
        parts = ["waiting for the first episode"]
        if self._played:
            parts = [f"{self._steps / elapsed_s:.0f} steps/s"]
            left_s = seconds_left(self._left, self._played, elapsed_s)
            if left_s is not None:
                parts.append(f"{datetime.timedelta(seconds=round(left_s))} left")
        if self._retries:
            noun = "retry" if self._retries == 1 else "retries"
            parts.append(f"{self._retries} infrastructure {noun}")
        if any(self._infra_failed.values()):
            parts.append(f"{sum(self._infra_failed.values())} infrastructure failures")
        return " · ".join(parts)


class LiveProgress(_CountedProgress):
    """Updates a table on a terminal, and prints errors and retries above the table."""

    def __init__(self, console: Console) -> None:
        super().__init__(console)
        self._live = Live(
            console=console, auto_refresh=True, refresh_per_second=4, get_renderable=self._drawing
        )

    def begin(self, cases: Sequence[EvalCase], recorded: Mapping[str, Rate], left: int) -> None:
        super().begin(cases, recorded, left)
        self._live.start()

    def end(self) -> None:
        self._live.stop()  # the last state of the table remains on the terminal

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
    """Return the display for `console`: a live table on a terminal, otherwise a line every five
    seconds.
    """
    return LiveProgress(console) if console.is_terminal else LineProgress(console)


def seconds_left(episodes: int, played: int, elapsed_s: float) -> float | None:
    """Estimate the duration of `episodes` further episodes, s; None if no episode is left, or if no
    episode has ended yet.
    """
    return episodes * elapsed_s / played if episodes > 0 and played else None


def results_table(summary: Summary) -> Table:
    """Return the table of success, length and speed. Each policy id has a row for each env, and a
    row for all envs together.
    """
    names = summary.results.policy_ids
    interval = "the Wilson 95 % interval"
    error_rate = summary.total.success_once.error_rate
    if error_rate is not None:
        interval = f"a confidence sequence (error rate {error_rate:.2g})"
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
        rows = [(group, "") for group in summary.cases if group.policy_id == name]
        if len(rows) > 1:
            groups_by_timing = summary.parts(name)
            if len(groups_by_timing) == 1:
                rows.append((total, ""))
            else:
                rows += [(group, timing) for timing, group in groups_by_timing.items()]
        for group, timing in rows:
            cells = _cells(group, timing, some_lost=some_lost)
            table.add_row(*([name, *cells] if len(names) > 1 else cells))
        table.add_section()
    return table


def print_summary(console: Console, summary: Summary) -> None:
    """Print the table of results, failures of infrastructure, and the paths of all written
    files.

    Args:
        console: The console.
        summary: The result of `evaluate`.
    """
    # Import Jinja late, since it is needed only after the last episode.
    from vlagents_ray.evaluate.report.page import FILE

    console.print(results_table(summary))
    if summary.total.policy_errors:
        console.print(_errors_table(summary))

    lines = [*_speed(summary), *_losses(summary)]
    for change in summary.results.accepted_changes:
        kind = "changed after the first results" if change.is_of_plan else "accepted change"
        lines.append(f"{kind}: {change}")
    lines += _intervals(summary)
    lines += [*_pushed_weights(summary), *_early_stops(summary), *_clock_gaps(summary)]
    lines += [*modes(summary.results), *_times(summary)]
    if summary.state == RUNNING:
        lines.append("still running")
    elif summary.state != "complete":
        lines.append(f"{summary.state}: continue with --resume")

    lines.append(f"results: {summary.out}")
    written = {"report": summary.out / FILE, "videos": summary.out / "videos"}
    lines += [f"{name}: {path}" for name, path in written.items() if path.exists()]
    unsolved = next((case for case in summary.results.cases if _unsolved(case) is not None), None)
    if unsolved is not None and not written["videos"].exists():
        lines.append(
            "videos: none; --video failures writes them, and `vlagents-ray replay "
            f"{summary.out} '{unsolved.env}#{_unsolved(unsolved)}'` films a failure now"
        )
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def _unsolved(case: CaseResults) -> int | None:
    """Return the number of the first unsolved episode in simulation; None if there is none."""
    if "robot" in case.settings:
        return None
    numbers = (result.key.episode for result in case.counted if not result.success_once)
    return next(numbers, None)


def _errors_table(summary: Summary) -> Table:
    table = Table(title="Errors of policies", box=SIMPLE_HEAD, padding=0, pad_edge=False)
    for title in ("policy", "env", "error"):
        table.add_column(title, overflow="fold")
    table.add_column("episodes", justify="right", no_wrap=True)
    for (policy, task, error), number in errors_of_policies(summary.results):
        table.add_row(policy, task, Text(error.strip().partition("\n")[0]), str(number))
    return table


def _speed(summary: Summary) -> list[str]:
    lines = [f"{summary.total.steps} steps in {summary.wall_seconds:.1f} s"]
    speed = summary.rollout_steps_per_second
    if speed is not None:
        lines[0] += f", {speed:.1f} a second once the workers had started"
    if summary.env_busy is not None and summary.policy_busy is not None:
        lines.append(
            f"envs busy for {summary.env_busy:.0%} of the workers' time, "
            f"the policy for {summary.policy_busy:.0%} of one replica's time"
        )
    return lines


def _losses(summary: Summary) -> list[str]:
    """Return the lines about episodes and attempts that ended with errors."""
    total = summary.total
    lines = []
    if total.policy_errors:
        lines.append(
            f"{total.policy_errors} episodes ended with an error of the policy; they count as "
            "failures"
        )
    if total.retries:
        lines.append(f"{total.retries} attempts lost to infrastructure and repeated")
    if total.infra_failures:
        lines.append(
            f"{total.infra_failures} episodes lost to infrastructure and excluded from all rates; "
            "--resume tries them again"
        )
        lines.append(
            "once with lost: the bounds if all lost episodes had failed, or had been solved"
        )
    return lines


def _intervals(summary: Summary) -> list[str]:
    """Return the reasons why intervals are wider than those of as many independent episodes."""
    lines = []
    for group in summary.totals:
        once = group.success_once
        if once.independent is not None:
            lines.append(
                f"{group.policy_id}: {once.episodes + once.lost} episodes repeat initial states, "
                f"and count as {once.independent:.0f} independent ones"
            )
    reasons = summary.reasons_of_sequence
    if reasons and summary.state != RUNNING:
        lines.append(
            f"intervals are confidence sequences, and tests sequential: {', '.join(reasons)}"
        )
    return lines


def _pushed_weights(summary: Summary) -> list[str]:
    weights: dict[str, str] = {}  # keys: policy ids
    for case in summary.results.cases:
        versions = pushed_of(case)
        if versions is not None:
            weights[case.policy_id] = versions
    return [
        f"{name}: weights pushed by a learner, {versions}" for name, versions in weights.items()
    ]


def _early_stops(summary: Summary) -> list[str]:
    lines = []
    for group in summary.cases:
        if group.stopped:
            name = " ".join(filter(None, (group.policy_id, group.suite, group.env)))
            error_rate = group.success_once.error_rate or 0
            lines.append(
                f"{name}: stopped after {group.episodes} of {group.planned} (error rate "
                f"{100 * error_rate:.2g} %)"
            )
    if not summary.has_one_rate_each:
        lines.append(
            "cases that stopped after different numbers of episodes have no common rate: report "
            "each rate separately"
        )
    return lines


def _clock_gaps(summary: Summary) -> list[str]:
    """Return a line for each gap between real-time and synchronous success rates in the report."""
    lines = []
    for gap in clock_gaps(summary.results):
        counted: list[EpisodeResult] = []
        for case in gap.cases:
            counted += case.counted
        # The number of steps is 0 if the policy failed before the first step of every episode.
        steps = max(1, sum(result.steps for result in counted))
        waited = sum(result.ticks_waited for result in counted) / steps
        low, high = gap.total.interval
        pairs = gap.total.pairs
        lines.append(
            f"{gap.a}: {100 * (pairs.difference or 0):+.1f} points to the synchronous "
            f"score ({100 * low:+.1f} to {100 * high:+.1f}, {pairs.total} pairs); "
            f"{waited:.0%} of its ticks waited for an answer"
        )
        if pairs.failures_of_a:
            lines.append(
                f"{gap.a}: {pairs.only_b} of {pairs.failures_of_a} failures under delay were "
                "solved synchronously on the same starts"
            )
    return lines


def _times(summary: Summary) -> list[str]:
    """Return a line for each case in real time or on a robot, with the share of ticks in time and
    the ages of actions.
    """
    lines = []
    for group in summary.cases:
        if group.time_share is not None and group.time_share.ticks:
            name = " ".join(filter(None, (group.policy_id, group.suite, group.env)))
            lines.append(f"{name}: {in_words(group.time_share)}")
    return lines


def _cells(group: Group, timing: str, *, some_lost: bool) -> list[str]:
    """Return the cells of a row, beginning with the column "env"."""
    cells = [
        " ".join(filter(None, (group.suite, group.env, timing))),
        f"{group.episodes}/{group.planned}",
        str(group.success_once),
    ]
    if some_lost:
        bounds = group.with_lost(group.success_once)
        if bounds is None:
            cells.append("-")
        else:
            low, high = bounds
            cells.append(f"{100 * low:.0f} to {100 * high:.0f}%")
    at_end = group.success_at_end.rate
    return [
        *cells,
        "-" if at_end is None else f"{at_end:.0%}",
        _number(group.mean_steps),
        _number(group.policy_ms, 2),
        _number(group.env_step_ms, 2),
    ]


def _number(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
