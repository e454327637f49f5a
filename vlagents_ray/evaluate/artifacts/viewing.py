"""Shows an episode of an evaluation in viewers; their files travel to the driver with its result."""

from __future__ import annotations

import logging
import tempfile
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.evaluate.artifacts.storage import episode_folder, outcome, stem, whole
from vlagents_ray.evaluate.artifacts.video import DEFAULT_FPS
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.config import EvalConfig
from vlagents_ray.evaluate.plan.jobs import Job
from vlagents_ray.interface import Act, Obs
from vlagents_ray.viewers.frame import ViewerFrame, numbers_of
from vlagents_ray.viewers.targets import SUFFIXES, is_live, open_target
from vlagents_ray.viewers.viewer import EpisodeViewer

log = logging.getLogger(__name__)


class EpisodeViews:
    """Shows one episode in the viewers that the settings name. Use as a context manager, which closes them."""

    def __init__(self, config: EvalConfig, hz: float | None) -> None:
        """Open the viewers; `hz` is the control rate of the env."""
        self._period_s = 1 / (hz or DEFAULT_FPS)
        self._begun = time.time()
        self._seen: list[ViewerFrame] = []  # observations whose action is not executed yet, at most two
        self._ticks = 0  # observations so far
        self._rows: np.ndarray | None = None  # of the newest chunk, (H, D)
        self._row = 0  # of that chunk, for the next action
        self._numbers: dict[str, float] = {}
        self._folders: dict[str, Path] = {}  # of files, by the name of the viewer
        self._viewers: list[EpisodeViewer] = []
        self._shown = ExitStack()
        targets = _targets(config)
        with ExitStack() as stack:
            for name in targets:
                if not is_live(name, targets[name]):
                    self._folders[name] = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            stack.enter_context(self._shown)  # closed before its folders are removed
            for name, target in targets.items():
                opened = open_target(name, str(self._folders.get(name, target)))
                self._viewers.append(self._shown.enter_context(EpisodeViewer(opened)))
            self._opened = stack.pop_all()

    def begin(self, job: Job) -> None:
        """Begin the episode of a job."""
        name = "_".join([*(part.replace("/", "_") for part in job.cell.name if part), stem(job.key)])
        for viewer in self._viewers:
            self._shown.enter_context(viewer.episode(name))

    def add_observation(self, obs: Obs) -> None:
        """Add an observation, beginning with that of the reset."""
        if self._viewers:
            self._seen.append(ViewerFrame.of(obs, self._ticks, time=self._begun + self._ticks * self._period_s))
            self._ticks += 1

    def add_act(self, act: Act) -> None:
        """Add an answer of the policy to the last observation; row k of its chunk is for k actions later."""
        if self._viewers:
            self._rows, self._row, self._numbers = np.array(act.rows()), 0, numbers_of(act.info)

    def add_action(self, action: np.ndarray, reward: float, success: bool) -> None:
        """Show the step of an executed action, (D,)."""
        if not self._viewers:
            return
        rows, row = self._rows, self._row
        self._show(
            executed=np.array(action),
            planned=None if rows is None or row >= len(rows) else rows[row],
            chunk=rows if row == 0 else None,
            numbers={**self._numbers, "reward": float(reward), "success": float(success)},
        )
        self._row, self._numbers = row + 1, {}

    def finish(self) -> dict[str, bytes]:
        """Show the last observation, and return the files by the name of the viewer."""
        while self._seen:
            self._show()
        self._shown.close()
        for viewer in self._viewers:
            if viewer.dropped or viewer.error is not None:
                log.warning("%s", viewer.report())
        files = {name: file.read_bytes() for name, folder in self._folders.items() for file in folder.iterdir()}
        self.close()
        return files

    def close(self) -> None:
        """Close the viewers, and remove what is left of their files."""
        self._opened.close()

    def _show(self, **what: Any) -> None:
        frame = replace(self._seen.pop(0), **what)
        for viewer in self._viewers:
            viewer.add(frame)


def save_views(config: EvalConfig, cell: EvalCase, result: EpisodeResult, files: dict[str, bytes]) -> None:
    """Write the files of an episode as `FOLDER/POLICY/SUITE/ENV/epNNNN_seedS_OUTCOME.rrd`, and `.mcap` likewise."""
    for name, target in _targets(config).items():
        if name in files:
            folder = episode_folder(Path(target), ".", cell)
            path = folder / f"{stem(result.key)}_{outcome(result)}{SUFFIXES[name]}"
            for old in folder.glob(f"{stem(result.key)}_*{SUFFIXES[name]}"):  # of an earlier attempt
                old.unlink()
            with whole(path) as part:
                part.write_bytes(files[name])


def _targets(config: EvalConfig) -> dict[str, str]:
    return {name: target for name, target in (("rerun", config.rerun), ("foxglove", config.foxglove)) if target}
