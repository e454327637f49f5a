"""TensorBoard: event files in `out/tensorboard/POLICY`."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vlagents_ray.evaluate.trackers.base import About, TrackerRun
from vlagents_ray.naming import plain
from vlagents_ray.registry import require

FOLDER = "tensorboard"


class TensorboardRun(TrackerRun):
    """Scalars and texts. TensorBoard plays no MP4, so that the paths of videos are logged."""

    def __init__(self, about: About) -> None:
        self._event: Any = require("tensorboard.compat.proto.event_pb2").Event
        self._summary: Any = require("tensorboard.compat.proto.summary_pb2").Summary
        self._tensor: Any = require("tensorboard.compat.proto.tensor_pb2").TensorProto
        self._text_metadata: Any = require("tensorboard.plugins.text.metadata").create_summary_metadata
        writer = require("tensorboard.summary.writer.event_file_writer").EventFileWriter
        self._writer = writer(str(about.out / FOLDER / plain(about.name)))
        self._out = about.out
        self._text("config", json.dumps(about.config, indent=1, default=str), 0)

    def log(self, metrics: Mapping[str, float], step: int | None) -> None:
        """Add a point to each curve; without a training step at 0."""
        values = [self._summary.Value(tag=name, simple_value=value) for name, value in metrics.items()]
        self._add(values, step or 0)

    def videos(self, label: str, paths: Sequence[Path], step: int | None) -> None:
        """Log the paths of the videos in the folder of results, as a text."""
        self._text(f"{label}/videos", "\n".join(str(path.relative_to(self._out)) for path in paths), step or 0)

    def finish(self) -> None:
        """Write what is buffered, and close the file."""
        self._writer.close()

    def _text(self, tag: str, text: str, step: int) -> None:
        indented = "\n".join(f"    {line}" for line in text.splitlines())  # Markdown for text as it stands
        tensor = self._tensor(
            dtype="DT_STRING", string_val=[indented.encode()], tensor_shape={"dim": [{"size": 1}]}
        )  # fmt: skip
        self._add([self._summary.Value(tag=tag, metadata=self._text_metadata(tag, ""), tensor=tensor)], step)

    def _add(self, values: Sequence[Any], step: int) -> None:
        event = self._event(step=step, wall_time=time.time(), summary=self._summary(value=values))
        self._writer.add_event(event)
        self._writer.flush()
