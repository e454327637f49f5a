"""trackio: in its own folder on this machine (TRACKIO_DIR), which `trackio show` displays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vlagents_ray.evaluate.trackers.base import About, TrackerRun
from vlagents_ray.registry import require


class TrackioRun(TrackerRun):
    """A run named after the policy and the first digits of its id, as trackio identifies runs by name."""

    def __init__(self, about: About) -> None:
        self._trackio: Any = require("trackio")
        self._run = self._trackio.init(
            project=about.project, name=f"{about.name}-{about.id[:6]}", group=about.group, config=about.config,
            resume="allow", embed=False, auto_log_gpu=False, auto_log_cpu=False,
        )  # fmt: skip

    def log(self, metrics: Mapping[str, float], step: int | None) -> None:
        """Add a point to each curve; without a training step at 0, as trackio has no summary."""
        self._run.log(dict(metrics), step=step or 0)

    def videos(self, label: str, paths: Sequence[Path], step: int | None) -> None:
        """Show the videos beside the curves."""
        shown = {f"{label}/{path.stem}": self._trackio.Video(path) for path in paths}
        self._run.log(shown, step=step or 0)

    def finish(self) -> None:
        """Send what is buffered, and end the run."""
        self._run.finish()
