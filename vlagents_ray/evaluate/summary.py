"""`summary.json`: what came out, with what certainty, and what it was made with."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.evaluate.episode import EpisodeResult
from vlagents_ray.evaluate.results import CellResults, Results, Run, rate_of, synchronous_twin
from vlagents_ray.evaluate.statistics import Rate

FILE = "summary.json"
TOTAL = "total"


@dataclass(frozen=True, slots=True)
class Group:
    """The episodes of one cell, or of all of a contender. Rates count policy errors, but no infrastructure failure."""

    contender: str
    suite: str
    env: str  # or "total"
    planned: int
    stopped: int  # cells that stopped early
    success_once: Rate
    success_at_end: Rate
    policy_errors: int  # episodes that the policy broke off; not successes
    infra_failures: int  # episodes that infrastructure kept from ending; in no rate
    retries: int  # attempts that infrastructure failed and that were repeated
    steps: int
    mean_steps: float | None
    mean_return: float | None
    env_step_ms: float | None  # median of the episodes' medians
    policy_ms: float | None  # likewise
    policy_p95_ms: float | None  # median of the episodes' 95th percentiles

    @property
    def episodes(self) -> int:
        """Finished episodes."""
        return self.success_once.episodes

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        rates = {"success_once": self.success_once.to_json(), "success_at_end": self.success_at_end.to_json()}
        return asdict(self) | {"episodes": self.episodes} | rates


@dataclass(frozen=True, slots=True)
class Summary:
    """The outcome of an evaluation; `to_json` is what stands in summary.json."""

    results: Results
    cells: tuple[Group, ...]
    totals: tuple[Group, ...]  # one a contender
    wall_seconds: float  # all runs together, workers' start included
    rollout_seconds: float  # from the first reset to the last step, of all runs together

    @property
    def out(self) -> Path:
        """The folder of the results."""
        return self.results.out

    @property
    def state(self) -> str:
        """Of the last run: "complete" if it went through every planned episode, or why not."""
        return self.results.runs[-1].state

    @property
    def total(self) -> Group:
        """All episodes together, of whichever contender."""
        return group_of((TOTAL, "", TOTAL), self.results.cells)

    @property
    def transports(self) -> list[str]:
        """How the observations went to the policies."""
        return sorted({result.transport for cell in self.results.cells for result in cell.counted})

    @property
    def steps_per_second(self) -> float | None:
        """Env steps of all workers together, over the whole wall time."""
        return self.total.steps / self.wall_seconds if self.wall_seconds else None

    @property
    def rollout_steps_per_second(self) -> float | None:
        """The same without the time before the first reset."""
        return self.total.steps / self.rollout_seconds if self.rollout_seconds else None

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        cells = [
            group.to_json() | {"checkpoint": checkpoint_of(cell), "settings": cell.settings, "env": cell.env}
            | {"described": cell.described, "contract": cell.contract, "code": cell.code}
            | {"stopped_at": cell.stopped_at, "gap_to_synchronous": gap_to_synchronous(self.results, cell)}
            for group, cell in zip(self.cells, self.results.cells, strict=True)
        ]  # fmt: skip
        last = self.results.runs[-1]
        return {
            "state": self.state,
            "cells": cells,
            "totals": [group.to_json() for group in self.totals],
            "wall_seconds": self.wall_seconds,
            "rollout_seconds": self.rollout_seconds,
            "steps_per_second": self.steps_per_second,
            "rollout_steps_per_second": self.rollout_steps_per_second,
            "transports": self.transports,
            "policies": self.results.policies,
            "versions": last.versions,
            "config": last.config,
        }


def summarize(results: Results) -> Summary:
    """What the results say, those of earlier runs included."""
    return Summary(
        results,
        tuple(group_of((cell.contender, cell.suite, cell.env), [cell]) for cell in results.cells),
        tuple(group_of((name, "", TOTAL), results.of(name)) for name in results.contenders),
        wall_seconds=sum(_wall_seconds(results, run) for run in results.runs),
        rollout_seconds=sum(_rollout_seconds(results, run) for run in results.runs),
    )


def checkpoint_of(cell: CellResults) -> str | None:
    """The checkpoint that the episodes of a cell were played by; None if no reset named one."""
    return next((one.checkpoint for one in cell.counted if one.checkpoint is not None), None)


def gap_to_synchronous(results: Results, cell: CellResults) -> float | None:
    """What a real-time cell's success rate is above that of its synchronous twin; None without one, or episodes."""
    twin = synchronous_twin(results, cell)
    if twin is None:
        return None
    ours, theirs = (rate_of([one], "success_once").rate for one in (cell, twin))
    return None if ours is None or theirs is None else ours - theirs


def write_summary(summary: Summary) -> Path:
    """Write `summary.json`, whole or not at all."""
    path = summary.out / FILE
    part = path.with_suffix(".part")
    part.write_text(json.dumps(summary.to_json(), indent=2) + "\n")
    os.replace(part, path)
    return path


def group_of(name: tuple[str, str, str], cells: Sequence[CellResults]) -> Group:
    """What came of these cells together, under the name (contender, suite, env)."""
    finished: list[EpisodeResult] = [result for cell in cells for result in cell.counted]
    return Group(
        *name,
        planned=sum(cell.planned for cell in cells),
        stopped=sum(cell.stopped_at is not None for cell in cells),
        success_once=rate_of(cells, "success_once"),
        success_at_end=rate_of(cells, "success_at_end"),
        policy_errors=sum(one.status == "policy_error" for one in finished),
        infra_failures=sum(
            one.result.status == "infra_failed" and not one.beyond for cell in cells for one in cell.episodes
        ),
        retries=sum(attempt.retried for cell in cells for attempt in cell.attempts),
        steps=sum(one.steps for one in finished),
        mean_steps=_mean([one.steps for one in finished]),
        mean_return=_mean([one.episode_return for one in finished]),
        env_step_ms=_median([one.env_step_ms for one in finished]),
        policy_ms=_median([one.policy_ms for one in finished]),
        policy_p95_ms=_median([one.policy_p95_ms for one in finished]),
    )


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def _wall_seconds(results: Results, run: Run) -> float:
    """How long a run took; one that was killed, until its last episode."""
    if run.ended is not None:
        return run.ended - run.started
    return max((finished for finished, _ in _played(results, run)), default=run.started) - run.started


def _rollout_seconds(results: Results, run: Run) -> float:
    played = _played(results, run)
    return max(finished for finished, _ in played) - min(begun for _, begun in played) if played else 0.0


def _played(results: Results, run: Run) -> list[tuple[float, float]]:
    """When each episode of a run ended and began."""
    mine = [one for cell in results.cells for one in cell.episodes if one.run == run.run]
    return [(one.finished, one.finished - one.result.seconds) for one in mine]
