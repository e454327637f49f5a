"""How an evaluation shows where it stands: live on a terminal, in plain lines elsewhere."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from time import monotonic
from typing import Protocol

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from vlagents_ray.evaluate.cells import Cell
from vlagents_ray.evaluate.episode import EpisodeResult
from vlagents_ray.evaluate.failures import Failure
from vlagents_ray.evaluate.jobs import Job
from vlagents_ray.evaluate.statistics import Rate
from vlagents_ray.evaluate.stopping import confidence_sequence

LINE_EVERY_S = 5.0
MOST_ROWS = 12


class Progress(Protocol):
    """What an evaluation tells while it runs. The calls come from one thread."""

    def begin(self, cells: Sequence[Cell], recorded: Mapping[str, Rate], left: int) -> None:
        """What is planned, what earlier runs have finished, by a cell's fingerprint, and how many are to be played."""

    def episode(self, cell: Cell, result: EpisodeResult) -> None:
        """An episode is recorded."""

    def retry(self, job: Job, failure: Failure) -> None:
        """Infrastructure failed an attempt, and the episode will be tried again."""

    def stopped(self, cell: Cell, at: int, spared: int) -> None:
        """A cell is certain enough after `at` episodes; `spared` ones that waited will not be played."""

    def end(self) -> None:
        """Nothing follows."""


class SilentProgress:
    """Shows nothing."""

    def begin(self, cells: Sequence[Cell], recorded: Mapping[str, Rate], left: int) -> None:
        """Nothing."""

    def episode(self, cell: Cell, result: EpisodeResult) -> None:
        """Nothing."""

    def retry(self, job: Job, failure: Failure) -> None:
        """Nothing."""

    def stopped(self, cell: Cell, at: int, spared: int) -> None:
        """Nothing."""

    def end(self) -> None:
        """Nothing."""


class _Counts:
    """What both displays keep count of."""

    def __init__(self, cells: Sequence[Cell], recorded: Mapping[str, Rate], left: int) -> None:
        self._started = monotonic()
        self._cells = {cell.fingerprint: cell for cell in cells}
        self._rates = {cell: recorded.get(cell, Rate(0, 0)) for cell in self._cells}
        self._infra_failed = dict.fromkeys(self._cells, 0)
        self._steps = 0
        self._played = 0  # in this run
        self._left = left
        self._alone = len({cell.contender for cell in cells}) == 1
        self.retries = 0

    def add(self, cell: Cell, result: EpisodeResult) -> None:
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

    def spare(self, episodes: int) -> None:
        self._left -= episodes

    def rows(self) -> list[tuple[str, str, str]]:
        """(name, "done/planned", success so far); of many cells those that are under way."""
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
    """A table that is drawn anew, for terminals."""

    def __init__(self, console: Console) -> None:
        self._counts = _Counts([], {}, 0)
        self._live = Live(console=console, auto_refresh=True, refresh_per_second=4, get_renderable=self._drawing)

    def begin(self, cells: Sequence[Cell], recorded: Mapping[str, Rate], left: int) -> None:
        """Start drawing."""
        self._counts = _Counts(cells, recorded, left)
        self._live.start()

    def episode(self, cell: Cell, result: EpisodeResult) -> None:
        """Count it."""
        self._counts.add(cell, result)

    def retry(self, job: Job, failure: Failure) -> None:
        """Count it, and say why above the table."""
        self._counts.retries += 1
        self._live.console.print(_retry_line(job, failure), markup=False, highlight=False)

    def stopped(self, cell: Cell, at: int, spared: int) -> None:
        """Say so above the table."""
        self._counts.spare(spared)
        self._live.console.print(_stopped_line(cell, at), markup=False, highlight=False)

    def end(self) -> None:
        """Leave the last state standing."""
        self._live.stop()

    def _drawing(self) -> Group:
        table = Table(box=None)
        for title in ("env", "episodes", "success so far"):
            table.add_column(title)
        for row in self._counts.rows():
            table.add_row(*row)
        return Group(table, Text(self._counts.overall()))


class LineProgress:
    """A line every few seconds, for logs."""

    def __init__(self, console: Console, every_s: float = LINE_EVERY_S) -> None:
        self._console = console
        self._every_s = every_s
        self._last = 0.0
        self._counts = _Counts([], {}, 0)

    def begin(self, cells: Sequence[Cell], recorded: Mapping[str, Rate], left: int) -> None:
        """The first line."""
        self._counts = _Counts(cells, recorded, left)
        self._last = monotonic()
        self._line()

    def episode(self, cell: Cell, result: EpisodeResult) -> None:
        """A line, unless the last one is recent."""
        self._counts.add(cell, result)
        if monotonic() - self._last >= self._every_s:
            self._last = monotonic()
            self._line()

    def retry(self, job: Job, failure: Failure) -> None:
        """A line with the reason."""
        self._counts.retries += 1
        self._print(_retry_line(job, failure))

    def stopped(self, cell: Cell, at: int, spared: int) -> None:
        """A line."""
        self._counts.spare(spared)
        self._print(_stopped_line(cell, at))

    def end(self) -> None:
        """The last line."""
        self._line()

    def _line(self) -> None:
        envs = " · ".join(f"{env} {done}, success {rate}" for env, done, rate in self._counts.rows())
        self._print(f"{envs} · {self._counts.overall()}")

    def _print(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)


def progress_for(console: Console) -> Progress:
    """The display that suits `console`."""
    return LiveProgress(console) if console.is_terminal else LineProgress(console)


def _retry_line(job: Job, failure: Failure) -> str:
    first_line = failure.message.strip().partition("\n")[0]
    return f"{job.key.env} episode {job.key.episode}: attempt {job.attempt} failed, trying again: {first_line}"


def _stopped_line(cell: Cell, at: int) -> str:
    return f"{' '.join(filter(None, cell.name))}: certain enough, stopped after {at} of {cell.planned} episodes"


def _left(episodes: int, played: int, elapsed_s: float) -> str:
    if episodes <= 0 or not played:
        return ""
    seconds = round(episodes * elapsed_s / played)
    return f"{seconds // 3600}:{seconds // 60 % 60:02d}:{seconds % 60:02d} left"
