"""The document of a results folder while an evaluation of this process writes it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.jobs import Job
from vlagents_ray.evaluate.report.progress import Progress, SilentProgress
from vlagents_ray.evaluate.report.results_document import STARTING, ResultsDocument
from vlagents_ray.evaluate.results.database import RUNNING
from vlagents_ray.evaluate.results.reader import Results
from vlagents_ray.evaluate.results.statistics import Rate

WAITING, ENDED, STOPPED = "waiting", "ended", "stopped"


class ProgressDocument(ResultsDocument, Progress):
    """Describes an evaluation that calls it as its `Progress`. The page's thread may read it meanwhile."""

    def __init__(self, out: Path, shown: Progress | None = None, *, goes_on: bool = False) -> None:
        """Describe the results in a folder.

        Args:
            out: The folder, which may not be there yet.
            shown: Gets each call, too: the progress on the terminal.
            goes_on: Whether further evaluations follow each other, as those of a training's checkpoints.
        """
        super().__init__(out)
        self.goes_on = goes_on
        self._shown = shown or SilentProgress()
        self._state = STARTING
        self._changed = True

    def begin(self, cells: Sequence[EvalCase], recorded: Mapping[str, Rate], left: int) -> None:
        """Note that an evaluation runs."""
        self._change(RUNNING)
        self._shown.begin(cells, recorded, left)

    def episode(self, cell: EvalCase, result: EpisodeResult) -> None:
        """Note that there is a result."""
        self._changed = True
        self._shown.episode(cell, result)

    def retry(self, job: Job, failure: Failure) -> None:
        """Note that there was a retry."""
        self._changed = True
        self._shown.retry(job, failure)

    def stopped(self, cell: EvalCase, at: int, spared: int) -> None:
        """Note that fewer episodes are planned."""
        self._changed = True
        self._shown.stopped(cell, at, spared)

    def end(self) -> None:
        """Note that this evaluation has ended."""
        if self.goes_on:
            self._change(WAITING)
        else:
            self.close()
        self._shown.end()

    def close(self) -> None:
        """Note that no evaluation follows: the state is that of the last run."""
        if self._state != STOPPED:
            self._change(ENDED)

    def fail(self, reason: str) -> None:
        """Note that an error ended the evaluation."""
        self.reason = reason
        self._change(STOPPED)

    def is_due(self, *, rested: bool) -> bool:
        """Return whether there is something new; how it ended is told at once."""
        final = self._changed and self._state in (ENDED, STOPPED)
        due = final or (rested and (self._changed or self._state == RUNNING))
        if due:
            self._changed = False
        return due

    def state(self, results: Results | None) -> str:
        """Return how the evaluation stands: once it has ended, as its last run says."""
        return super().state(results) if self._state == ENDED else self._state

    def _change(self, state: str) -> None:
        self._state = state
        self._changed = True
