"""Weights & Biases; with WANDB_MODE=offline into files below the folder of results, for `wandb sync`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vlagents_ray.evaluate.trackers.base import About, TrackerRun
from vlagents_ray.naming import plain
from vlagents_ray.registry import require

STEP = "training_step"


class WandbRun(TrackerRun):
    """A run whose curves are drawn against `training_step`; values without a step are in its summary."""

    def __init__(self, about: About) -> None:
        self._wandb: Any = require("wandb")
        self._id = about.id
        # Code is in the config and in an artifact: wandb would look at the driver's folder only.
        quiet = self._wandb.Settings(silent=True, console="off", disable_git=True, disable_code=True)
        self._run = self._wandb.init(
            project=about.project, group=about.group, name=about.name, id=about.id, dir=str(about.out),
            config=about.config, job_type="eval", resume="allow", reinit="create_new", settings=quiet,
        )  # fmt: skip
        self._run.define_metric(STEP)
        self._run.define_metric("*", step_metric=STEP)
        if about.diffs:
            self._artifact("code", "code", about.diffs)

    def log(self, metrics: Mapping[str, float], step: int | None) -> None:
        """Add a point to each curve; without a training step, write the summary."""
        if step is None:
            self._run.summary.update(dict(metrics))
        else:
            self._run.log({STEP: step, **metrics})

    def videos(self, label: str, paths: Sequence[Path], step: int | None) -> None:
        """Upload the videos as an artifact of type "videos"."""
        at = "" if step is None else f"-{step}"
        self._artifact(f"videos-{plain(label.replace('/', '_'))}{at}", "videos", paths)

    def finish(self) -> None:
        """Send what is buffered, and end the run."""
        self._run.finish()

    def _artifact(self, name: str, kind: str, paths: Sequence[Path]) -> None:
        artifact = self._wandb.Artifact(f"{self._id}-{name}"[-128:], type=kind)
        for path in paths:
            artifact.add_file(str(path))
        self._run.log_artifact(artifact)
