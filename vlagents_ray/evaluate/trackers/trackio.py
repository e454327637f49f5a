"""trackio: in its own folder on this machine (TRACKIO_DIR), which `trackio show` displays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vlagents_ray.evaluate.trackers.base import About, TrackerRun
from vlagents_ray.registry import require


class TrackioRun(TrackerRun):
    """A run of the policy's name with the begin of its id: trackio knows runs by name. It has no summary."""

    def __init__(self, about: About) -> None:
        self._trackio: Any = require("trackio")
        self._run = self._trackio.init(
            project=about.project, name=f"{about.name}-{about.id[:6]}", group=about.group, config=about.config,
            resume="allow", embed=False, auto_log_gpu=False, auto_log_cpu=False,
        )  # fmt: skip

    def log(self, metrics: Mapping[str, float], step: int | None) -> None:
        """A point of each curve; without a training step at 0."""
        self._run.log(dict(metrics), step=step or 0)

    def videos(self, label: str, paths: Sequence[Path], step: int | None) -> None:
        """Videos beside the curves."""
        shown = {f"{label}/{path.stem}": self._trackio.Video(path) for path in paths}
        self._run.log(shown, step=step or 0)

    def finish(self) -> None:
        """Write what is left."""
        self._run.finish()
