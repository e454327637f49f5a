"""The progress of an evaluation: live on a terminal, in plain lines elsewhere."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from time import monotonic

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.jobs import Job
from vlagents_ray.evaluate.results.statistics import Rate
from vlagents_ray.evaluate.results.stopping import confidence_sequence
from vlagents_ray.evaluate.results.summary import cause_of

LINE_EVERY_S = 5.0
MOST_ROWS = 12


class Progress:
    """The callbacks of a running evaluation, from one thread. This class shows nothing: override some.

    The classes of `progress_for` show them: live on a terminal, in plain lines elsewhere.
    """

    def begin(self, cells: Sequence[EvalCase], recorded: Mapping[str, Rate], left: int) -> None:
        """Note that the evaluation begins.

        Args:
            cells: All planned cells.
            recorded: The success rates of earlier runs, by the cell's fingerprint.
            left: The number of episodes to be played.
        """

    def episode(self, cell: EvalCase, result: EpisodeResult) -> None:
        """Note that an episode was recorded.

        Args:
            cell: The cell that it belongs to.
            result: Its result.
        """

    def retry(self, job: Job, failure: Failure) -> None:
        """Note that an attempt failed by infrastructure; the episode will be played again.

        Args:
            job: The episode.
            failure: The failure.
        """

    def stopped(self, cell: EvalCase, at: int, spared: int) -> None:
        """Note that a cell stopped early.

        Args:
            cell: The cell.
            at: The number of played episodes.
            spared: The number of episodes that will not be played.
        """

    def end(self) -> None:
        """Note that the evaluation has ended; no call follows."""


class _CountedProgress(Progress):
    """Counts for both displays, and prints errors and retries as lines."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._start([], {}, 0)

    def begin(self, cells: Sequence[EvalCase], recorded: Mapping[str, Rate], left: int) -> None:
        self._start(cells, recorded, left)

    def _start(self, cells: Sequence[EvalCase], recorded: Mapping[str, Rate], left: int) -> None:
        self._started = monotonic()
        self._cells = {cell.fingerprint: cell for cell in cells}
        self._rates = {cell: recorded.get(cell, Rate(0, 0)) for cell in self._cells}
        self._infra_failed = dict.fromkeys(self._cells, 0)
        self._steps = 0
        self._played = 0  # in this run
        self._left = left
        self._retries = 0
        self._causes: set[tuple[str, str]] = set()  # (policy id, cause) of errors that were shown
        self._alone = len({cell.contender for cell in cells}) == 1

    def episode(self, cell: EvalCase, result: EpisodeResult) -> None:
        self._played += 1
        self._left -= 1
        self._steps += result.steps
        if result.status == "infra_failed":
            self._infra_failed[cell.fingerprint] += 1
            return
        before = self._rates[cell.fingerprint]
        successes, episodes = before.successes + bool(result.success_once), before.episodes + 1
        error_rate = before.error_rate  # of a cell that may stop early
        bounds = None if error_rate is None else confidence_sequence(successes, episodes, error_rate)
        self._rates[cell.fingerprint] = Rate(successes, episodes, bounds, error_rate)
        if result.status == "policy_error":
            error = (result.error or "").strip().partition("\n")[0]
            cause = cell.contender, cause_of(error)
            if cause not in self._causes:
                self._causes.add(cause)
                where = f"{cell.contender} failed in {cell.env} episode {result.key.episode}"
                self._print(f"{where}, counted as no success: {error}")

    def retry(self, job: Job, failure: Failure) -> None:
        self._retries += 1
        first_line = failure.message.strip().partition("\n")[0]
        attempt = f"{job.key.env} episode {job.key.episode}: attempt {job.attempt}"
        self._print(f"{attempt} failed, trying again: {first_line}")

    def stopped(self, cell: EvalCase, at: int, spared: int) -> None:
        self._left -= spared
        name = " ".join(filter(None, cell.name))
        self._print(f"{name}: certain enough, stopped after {at} of {cell.planned} episodes")

    def _print(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=not self._console.is_terminal)

    def _rows(self) -> list[tuple[str, str, str]]:
        """Return (name, "done/planned", success so far), of many cells only for those being played."""
        done = {cell: self._rates[cell].episodes + self._infra_failed[cell] for cell in self._cells}
        cells = list(self._cells)
        if len(cells) > MOST_ROWS:
            cells = [cell for cell in cells if 0 < done[cell] < self._cells[cell].planned][:MOST_ROWS]
        return [
            (self._name(cell), f"{done[cell]}/{self._cells[cell].planned}", str(self._rates[cell])) for cell in cells
        ]

    def _name(self, cell: str) -> str:
        contender, suite, env = self._cells[cell].name
        return " ".join(filter(None, ("" if self._alone else contender, suite, env)))

    def _overall(self) -> str:
        elapsed_s = monotonic() - self._started
        parts = ["waiting for the first episode"]
        if self._played:
            parts = [f"{self._steps / elapsed_s:.0f} steps/s"]
            if (left_s := seconds_left(self._left, self._played, elapsed_s)) is not None:
                parts.append(f"{datetime.timedelta(seconds=round(left_s))} left")
        if self._retries:
            parts.append(f"{self._retries} infrastructure {'retry' if self._retries == 1 else 'retries'}")
        if any(self._infra_failed.values()):
            parts.append(f"{sum(self._infra_failed.values())} infrastructure failures")
        return " · ".join(parts)


class LiveProgress(_CountedProgress):
    """Updates a table on a terminal, with errors and retries above it."""

    def __init__(self, console: Console) -> None:
        super().__init__(console)
        self._live = Live(console=console, auto_refresh=True, refresh_per_second=4, get_renderable=self._drawing)

    def begin(self, cells: Sequence[EvalCase], recorded: Mapping[str, Rate], left: int) -> None:
        super().begin(cells, recorded, left)
        self._live.start()

    def end(self) -> None:
        self._live.stop()  # the last state stays on the terminal

    def _drawing(self) -> Group:
        table = Table(box=None)
        for title in ("env", "episodes", "success so far"):
            table.add_column(title)
        for row in self._rows():
            table.add_row(*row)
        return Group(table, Text(self._overall()))


class LineProgress(_CountedProgress):
    """Prints a line every few seconds, for logs."""

    def __init__(self, console: Console, every_s: float = LINE_EVERY_S) -> None:
        super().__init__(console)
        self._every_s = every_s
        self._last = 0.0

    def begin(self, cells: Sequence[EvalCase], recorded: Mapping[str, Rate], left: int) -> None:
        super().begin(cells, recorded, left)
        self._print_state()

    def episode(self, cell: EvalCase, result: EpisodeResult) -> None:
        super().episode(cell, result)
        if monotonic() - self._last >= self._every_s:
            self._print_state()

    def end(self) -> None:
        self._print_state()

    def _print_state(self) -> None:
        self._last = monotonic()
        envs = " · ".join(f"{env} {done}, success {rate}" for env, done, rate in self._rows())
        self._print(f"{envs} · {self._overall()}")


def progress_for(console: Console) -> Progress:
    """Choose the display for `console`: a live table on a terminal, else a line every five seconds."""
    return LiveProgress(console) if console.is_terminal else LineProgress(console)


def seconds_left(episodes: int, played: int, elapsed_s: float) -> float | None:
    """Estimate the time of `episodes` further episodes, s; None if none are left or none was played."""
    return episodes * elapsed_s / played if episodes > 0 and played else None
