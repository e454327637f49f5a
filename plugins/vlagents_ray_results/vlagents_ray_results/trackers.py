"""Trackers of evaluations: wandb, trackio and TensorBoard."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vlagents_ray.evaluate.trackers import TrackedPolicy
from vlagents_ray.naming import plain
from vlagents_ray.registry import require

STEP = "training_step"  # the name of the x axis of the curves in wandb
FOLDER = "tensorboard"  # folder of TensorBoard's event files, in the folder of results


class WandbRun:
    """A run of wandb whose curves are drawn against `training_step`; values without a step are in
    the run's summary.
    """

    def __init__(self, subject: TrackedPolicy) -> None:
        self._wandb: Any = require("wandb")
        self._id = subject.id
        # Code is stored in the config and in an artifact, as wandb would only read the driver's
        # folder.
        quiet = self._wandb.Settings(
            silent=True, console="off", disable_git=True, disable_code=True
        )
        self._run = self._wandb.init(
            project=subject.project,
            group=subject.group,
            name=subject.name,
            id=subject.id,
            dir=str(subject.out),
            config=subject.config,
            job_type="eval",
            resume="allow",
            reinit="create_new",
            settings=quiet,
        )
        self._run.define_metric(STEP)
        self._run.define_metric("*", step_metric=STEP)
        if subject.diffs:
            self._artifact("code", "code", subject.diffs)

    def log(self, metrics: Mapping[str, float], step: int | None) -> None:
        """Log values at a training step, or without one as the run's summary."""
        if step is None:
            self._run.summary.update(dict(metrics))
        else:
            self._run.log({STEP: step, **metrics})

    def videos(self, label: str, paths: Sequence[Path], step: int | None) -> None:
        """Upload the videos as an artifact."""
        suffix = "" if step is None else f"-{step}"
        self._artifact(f"videos-{plain(label.replace('/', '_'))}{suffix}", "videos", paths)

    def finish(self) -> None:
        self._run.finish()

    def _artifact(self, name: str, kind: str, paths: Sequence[Path]) -> None:
        artifact = self._wandb.Artifact(f"{self._id}-{name}"[-128:], type=kind)
        for path in paths:
            artifact.add_file(str(path))
        self._run.log_artifact(artifact)


class TrackioRun(WandbRun):
    """A run of trackio, like one of wandb but without a summary and artifacts. Its name contains
    the id, as trackio identifies runs by name.
    """

    def __init__(self, subject: TrackedPolicy) -> None:
        self._trackio: Any = require("trackio")
        self._run = self._trackio.init(
            project=subject.project,
            name=f"{subject.name}-{subject.id[:6]}",
            group=subject.group,
            config=subject.config,
            resume="allow",
            embed=False,
            auto_log_gpu=False,
            auto_log_cpu=False,
        )

    def log(self, metrics: Mapping[str, float], step: int | None) -> None:
        self._run.log(dict(metrics), step=step or 0)

    def videos(self, label: str, paths: Sequence[Path], step: int | None) -> None:
        shown = {f"{label}/{path.stem}": self._trackio.Video(path) for path in paths}
        self._run.log(shown, step=step or 0)


class TensorboardRun:
    """A run of TensorBoard, with scalars and texts. TensorBoard does not show MP4 files, so only
    the paths of videos are logged.
    """

    def __init__(self, subject: TrackedPolicy) -> None:
        self._event: Any = require("tensorboard.compat.proto.event_pb2").Event
        self._summary: Any = require("tensorboard.compat.proto.summary_pb2").Summary
        self._tensor: Any = require("tensorboard.compat.proto.tensor_pb2").TensorProto
        self._text_metadata: Any = require(
            "tensorboard.plugins.text.metadata"
        ).create_summary_metadata
        writer = require("tensorboard.summary.writer.event_file_writer").EventFileWriter
        self._writer = writer(str(subject.out / FOLDER / plain(subject.name)))
        self._out = subject.out
        self._text("config", json.dumps(subject.config, indent=1, default=str), 0)

    def log(self, metrics: Mapping[str, float], step: int | None) -> None:
        """Log values as scalars at a training step; without a step, at 0."""
        values = [
            self._summary.Value(tag=name, simple_value=value) for name, value in metrics.items()
        ]
        self._add(values, step or 0)

    def videos(self, label: str, paths: Sequence[Path], step: int | None) -> None:
        """Log the paths of the videos, relative to the folder of results."""
        lines = [str(path.relative_to(self._out)) for path in paths]
        self._text(f"{label}/videos", "\n".join(lines), step or 0)

    def finish(self) -> None:
        self._writer.close()

    def _text(self, tag: str, text: str, step: int) -> None:
        # Indented lines are preformatted text in Markdown.
        indented = "\n".join(f"    {line}" for line in text.splitlines())
        tensor = self._tensor(
            dtype="DT_STRING", string_val=[indented.encode()], tensor_shape={"dim": [{"size": 1}]}
        )  # fmt: skip
        metadata = self._text_metadata(tag, "")
        self._add([self._summary.Value(tag=tag, metadata=metadata, tensor=tensor)], step)

    def _add(self, values: Sequence[Any], step: int) -> None:
        event = self._event(step=step, wall_time=time.time(), summary=self._summary(value=values))
        self._writer.add_event(event)
        self._writer.flush()
