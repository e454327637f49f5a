"""How an evaluation shows its progress: live on a terminal, in plain lines elsewhere."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from time import monotonic
from typing import Protocol

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


class Progress(Protocol):
    """Callbacks of a running evaluation, which it calls from one thread. Any class with these methods will do."""

    def begin(self, cells: Sequence[EvalCase], recorded: Mapping[str, Rate], left: int) -> None:
        """The evaluation begins.

        Args:
            cells: All planned cells.
            recorded: The success rates of earlier runs, by the cell's fingerprint.
            left: The number of episodes to be played.
        """

    def episode(self, cell: EvalCase, result: EpisodeResult) -> None:
        """An episode was recorded.

        Args:
            cell: The cell that it belongs to.
            result: Its result.
        """

    def retry(self, job: Job, failure: Failure) -> None:
        """Infrastructure failed an attempt; the episode will be played again.

        Args:
            job: The episode.
            failure: What failed.
        """

    def stopped(self, cell: EvalCase, at: int, spared: int) -> None:
        """A cell stopped early.

        Args:
            cell: The cell.
            at: The number of episodes that were played.
            spared: The number of those that were still to come, and will not be played.
        """

    def end(self) -> None:
        """The evaluation has ended; no call follows."""


class SilentProgress(Progress):
    """A `Progress` that shows nothing; also a base class for one that needs only some of the calls."""

    def begin(self, cells: Sequence[EvalCase], recorded: Mapping[str, Rate], left: int) -> None:
        """Ignore the beginning."""

    def episode(self, cell: EvalCase, result: EpisodeResult) -> None:
        """Ignore an episode."""

    def retry(self, job: Job, failure: Failure) -> None:
        """Ignore a failed attempt."""

    def stopped(self, cell: EvalCase, at: int, spared: int) -> None:
        """Ignore a cell that stopped."""

    def end(self) -> None:
        """Ignore the end."""


class _Counts:
    """The counts that both displays show."""

    def __init__(self, cells: Sequence[EvalCase], recorded: Mapping[str, Rate], left: int) -> None:
        self._started = monotonic()
        self._cells = {cell.fingerprint: cell for cell in cells}
        self._rates = {cell: recorded.get(cell, Rate(0, 0)) for cell in self._cells}
        self._infra_failed = dict.fromkeys(self._cells, 0)
        self._steps = 0
        self._played = 0  # in this run
        self._left = left
        self._causes: set[tuple[str, str]] = set()  # (policy id, cause) of errors that were shown
        self._alone = len({cell.contender for cell in cells}) == 1
        self.retries = 0

    def add(self, cell: EvalCase, result: EpisodeResult) -> None:
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

    def new_error(self, cell: EvalCase, result: EpisodeResult) -> str | None:
        """A line with the error of the policy that ended an episode, at the first of each cause."""
        if result.status != "policy_error":
            return None
        error = (result.error or "").strip().partition("\n")[0]
        cause = cell.contender, cause_of(error)
        if cause in self._causes:
            return None
        self._causes.add(cause)
        return f"{cell.contender} failed in {cell.env} episode {result.key.episode}, counted as no success: {error}"

    def spare(self, episodes: int) -> None:
        self._left -= episodes

    def rows(self) -> list[tuple[str, str, str]]:
        """(name, "done/planned", success so far); if there are many cells, of those that are being played."""
        cells = list(self._cells)
        if len(cells) > MOST_ROWS:
            cells = [cell for cell in cells if 0 < self._done(cell) < self._cells[cell].planned][:MOST_ROWS]
        return [
            (self._name(cell), f"{self._done(cell)}/{self._cells[cell].planned}", str(self._rates[cell]))
            for cell in cells
        ]

    def _done(self, cell: str) -> int:
        return self._rates[cell].episodes + self._infra_failed[cell]

    def _name(self, cell: str) -> str:
        contender, suite, env = self._cells[cell].name
        return " ".join(filter(None, ("" if self._alone else contender, suite, env)))

    def overall(self) -> str:
        elapsed_s = monotonic() - self._started
        parts = ["waiting for the first episode"]
        if self._played:
            parts = [f"{self._steps / elapsed_s:.0f} steps/s", _left(self._left, self._played, elapsed_s)]
        if self.retries:
            parts.append(f"{self.retries} infrastructure {'retry' if self.retries == 1 else 'retries'}")
        if any(self._infra_failed.values()):
            parts.append(f"{sum(self._infra_failed.values())} infrastructure failures")
        return " · ".join(filter(None, parts))


class LiveProgress:
    """A `Progress` for terminals: a table that is drawn again and again."""

    def __init__(self, console: Console) -> None:
        self._counts = _Counts([], {}, 0)
        self._live = Live(console=console, auto_refresh=True, refresh_per_second=4, get_renderable=self._drawing)

    def begin(self, cells: Sequence[EvalCase], recorded: Mapping[str, Rate], left: int) -> None:
        """Start drawing the table."""
        self._counts = _Counts(cells, recorded, left)
        self._live.start()

    def episode(self, cell: EvalCase, result: EpisodeResult) -> None:
        """Count the episode; print an error of the policy above the table, once for each cause."""
        self._counts.add(cell, result)
        if (line := self._counts.new_error(cell, result)) is not None:
            self._live.console.print(line, markup=False, highlight=False)

    def retry(self, job: Job, failure: Failure) -> None:
        """Count the retry, and print its reason above the table."""
        self._counts.retries += 1
        self._live.console.print(_retry_line(job, failure), markup=False, highlight=False)

    def stopped(self, cell: EvalCase, at: int, spared: int) -> None:
        """Print above the table that the cell stopped."""
        self._counts.spare(spared)
        self._live.console.print(_stopped_line(cell, at), markup=False, highlight=False)

    def end(self) -> None:
        """Stop drawing; the last state stays on the terminal."""
        self._live.stop()

    def _drawing(self) -> Group:
        table = Table(box=None)
        for title in ("env", "episodes", "success so far"):
            table.add_column(title)
        for row in self._counts.rows():
            table.add_row(*row)
        return Group(table, Text(self._counts.overall()))


class LineProgress:
    """A `Progress` for logs: a line every few seconds."""

    def __init__(self, console: Console, every_s: float = LINE_EVERY_S) -> None:
        self._console = console
        self._every_s = every_s
        self._last = 0.0
        self._counts = _Counts([], {}, 0)

    def begin(self, cells: Sequence[EvalCase], recorded: Mapping[str, Rate], left: int) -> None:
        """Print the first line."""
        self._counts = _Counts(cells, recorded, left)
        self._last = monotonic()
        self._line()

    def episode(self, cell: EvalCase, result: EpisodeResult) -> None:
        """Print a line, unless the last one is recent, and errors of the policy, once for each cause."""
        self._counts.add(cell, result)
        if (line := self._counts.new_error(cell, result)) is not None:
            self._print(line)
        if monotonic() - self._last >= self._every_s:
            self._last = monotonic()
            self._line()

    def retry(self, job: Job, failure: Failure) -> None:
        """Print a line with the reason."""
        self._counts.retries += 1
        self._print(_retry_line(job, failure))

    def stopped(self, cell: EvalCase, at: int, spared: int) -> None:
        """Print a line."""
        self._counts.spare(spared)
        self._print(_stopped_line(cell, at))

    def end(self) -> None:
        """Print the last line."""
        self._line()

    def _line(self) -> None:
        envs = " · ".join(f"{env} {done}, success {rate}" for env, done, rate in self._counts.rows())
        self._print(f"{envs} · {self._counts.overall()}")

    def _print(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)


def progress_for(console: Console) -> Progress:
    """Choose the display for `console`: a live table on a terminal, else a line every five seconds."""
    return LiveProgress(console) if console.is_terminal else LineProgress(console)


def _retry_line(job: Job, failure: Failure) -> str:
    first_line = failure.message.strip().partition("\n")[0]
    return f"{job.key.env} episode {job.key.episode}: attempt {job.attempt} failed, trying again: {first_line}"


def _stopped_line(cell: EvalCase, at: int) -> str:
    return f"{' '.join(filter(None, cell.name))}: certain enough, stopped after {at} of {cell.planned} episodes"


def seconds_left(episodes: int, played: int, elapsed_s: float) -> float | None:
    """Estimate how long so many further episodes take, s; None if nothing is left or nothing was played yet."""
    return episodes * elapsed_s / played if episodes > 0 and played else None


def _left(episodes: int, played: int, elapsed_s: float) -> str:
    left_s = seconds_left(episodes, played, elapsed_s)
    if left_s is None:
        return ""
    seconds = round(left_s)
    return f"{seconds // 3600}:{seconds // 60 % 60:02d}:{seconds % 60:02d} left"
