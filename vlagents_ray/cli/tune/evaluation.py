"""`vlagents-ray tune` for a file of runs: how many workers, and environments a worker."""

from __future__ import annotations

import datetime
import os
import shlex
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vlagents_ray.cli.console import out, progress, table

if TYPE_CHECKING:
    from vlagents_ray.bench.evaluation import MeasuredEvaluation
    from vlagents_ray.evaluate import EvalConfig

_HEAD = ("", "workers", "envs a worker", "episodes/min", "start s", "memory MiB", "whole evaluation, min")


def tune_evaluation(file: Path, where: Path, *, minutes: float, max_workers: int | None, began: float) -> None:
    """Serve the policies of a file of runs, measure, and write the file with the chosen numbers.

    Args:
        file: The file of runs.
        where: The file to write.
        minutes: That the measurements may take, from `began`.
        max_workers: The most workers to try; None: twice as many as this machine has cores.
        began: s of `time.monotonic`.
    """
    from vlagents_ray.bench.evaluation import EvaluationTuner
    from vlagents_ray.bench.tuning.yaml_text import with_comments, with_values_in_text
    from vlagents_ray.cli.evaluation.command import read_run
    from vlagents_ray.cli.evaluation.policies import served
    from vlagents_ray.evaluate import EvalConfig

    config = EvalConfig.model_validate(read_run(file))
    most = max(max_workers or 2 * (os.cpu_count() or 1), config.workers)
    with served(config.model_copy(update={"workers": most})) as ready:
        own = ready.model_copy(update={"workers": config.workers})
        tuner = EvaluationTuner(own, began + 60 * minutes, most, progress=progress)
        tuner.measure()
    rows = [_row(one, tuner.chosen) for one in tuner.found]
    shown = table(*_HEAD[1:], title=f"{file}, on {os.cpu_count()} cores")
    for row in rows:
        shown.add_row(*row[1:])
    out.print(shown)
    for sentence in tuner.left_out:
        out.print(f"left out: {sentence}", style="yellow")
    took = f"{time.monotonic() - began:.0f} s"
    lines = [f"chosen: {_words(tuner.chosen)}", f"the file as it was: {_words(tuner.found[0])}"]
    for line in lines:
        out.print(line)
    command = f"vlagents-ray {shlex.join(sys.argv[1:])}"
    head = f"Tuned on {datetime.date.today()} in {took} on {os.cpu_count()} cores, by {command}"
    left_out = [f"left out: {sentence}" for sentence in tuner.left_out]
    text = with_values_in_text(file.read_text(), _changes(config, tuner.found[0], tuner.chosen))
    where.write_text(with_comments(text, [head, *lines, *left_out], [list(_HEAD), *rows]))
    out.print(f"wrote {where}, after {took}")


def _changes(
    config: EvalConfig, own: MeasuredEvaluation, chosen: MeasuredEvaluation
) -> dict[tuple[str | int, ...], Any]:
    """Return the values of the file to change, by their places."""
    changes: dict[tuple[str | int, ...], Any] = {}
    if chosen.workers != own.workers:
        changes["workers",] = chosen.workers
    if chosen.num_envs != own.num_envs:
        changes |= {("suites", number, "num_envs"): chosen.num_envs for number in range(len(config.suites))}
    return changes


def _row(one: MeasuredEvaluation, chosen: MeasuredEvaluation) -> list[str]:
    numbers = [f"{one.episodes_per_min:.1f}", f"{one.start_s:.1f}", f"{one.memory_mib:.0f}", f"{one.total_s / 60:.1f}"]
    return ["*" if one == chosen else "", str(one.workers), str(one.num_envs), *numbers]


def _words(one: MeasuredEvaluation) -> str:
    workers = f"{one.workers} worker{'s' if one.workers > 1 else ''}"
    envs = f"{one.num_envs} environment{'s' if one.num_envs > 1 else ''} each"
    return f"{workers} with {envs}, {one.total_s / 60:.1f} minutes"
