"""Records the artifacts of an episode: videos for people, a trajectory for programs."""

from __future__ import annotations

import logging
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from typing_extensions import Self

from vlagents_ray.evaluate.artifacts.storage import episode_folder, outcome, stem, whole
from vlagents_ray.evaluate.artifacts.trajectory import TrajectoryRecorder, save_trajectory
from vlagents_ray.evaluate.artifacts.video import DEFAULT_FPS, Footage, VideoRecorder, save_videos
from vlagents_ray.evaluate.episode.records import EpisodeObserver, EpisodeResult
from vlagents_ray.evaluate.episode.second_pass import PlayedEpisode, SecondPass
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.config import EpisodeChoice, EvalConfig
from vlagents_ray.evaluate.plan.jobs import Job
from vlagents_ray.interface import Act, Obs
from vlagents_ray.viewers.targets import SUFFIXES, is_live, open_target
from vlagents_ray.viewers.viewer import EpisodeViewer, ViewerFrame, numbers_of

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Artifacts:
    """The recorded files of an episode, as the worker sends them to the driver with its result."""

    footage: Footage = field(default_factory=Footage)
    trajectory: bytes | None = None  # a `Trajectory` as .npz
    transitions: Any = None  # a pyarrow.RecordBatch, for a learner
    views: dict[str, bytes] = field(default_factory=dict)  # the viewers' files, by the name of the viewer
    not_repeatable: str | None = None  # why images are missing that were to be rendered in a second pass


class EpisodeRecorder(EpisodeObserver):
    """Records one episode. Use as a context manager, which frees what it holds. This one keeps nothing."""

    @property
    def wants_images(self) -> EpisodeChoice:
        """The episodes of which the images of every step are needed."""
        return "none"

    def begin(self, job: Job) -> None:
        """Begin the episode of a job; called before anything is added."""

    def finish(self, result: EpisodeResult, second_pass: SecondPass) -> Artifacts:
        """Return what is kept of an episode with this result; `second_pass` renders images that are missing."""
        return Artifacts()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        pass


RecorderFactory = Callable[[EvalConfig, float | None], EpisodeRecorder]  # called with the env's control_hz


class Recording(EpisodeRecorder):
    """Records one episode as `config` says, for people and for files."""

    def __init__(self, config: EvalConfig, fps: float | None) -> None:
        self._wants_video, self._wants_trajectory = config.video, config.record
        self._video = VideoRecorder(fps, seen=config.record != "none")
        self._trajectory, self._played = TrajectoryRecorder(), PlayedEpisode()
        self._views = EpisodeViews(config, fps)
        self._is_viewed = bool(config.rerun or config.foxglove)
        self._observers: list[EpisodeObserver] = [self._views]
        self._observers += [self._played] if self.wants_images == "failures" else []
        self._observers += [self._trajectory] if self._wants_trajectory != "none" else []

    @property
    def wants_images(self) -> EpisodeChoice:
        wanted = {self._wants_video, self._wants_trajectory}
        return "all" if "all" in wanted or self._is_viewed else "failures" if "failures" in wanted else "none"

    def begin(self, job: Job) -> None:
        self._views.begin(job)

    def add_observation(self, obs: Obs) -> None:
        self._show(obs)
        for observer in self._observers:
            observer.add_observation(obs)

    def add_act(self, act: Act, ticks_waited: int = 0) -> None:
        for observer in self._observers:
            observer.add_act(act, ticks_waited)

    def add_action(self, action: np.ndarray, reward: float, success: bool) -> None:
        for observer in self._observers:
            observer.add_action(action, reward, success)

    def finish(self, result: EpisodeResult, second_pass: SecondPass) -> Artifacts:
        video, trajectory = _wanted(self._wants_video, result), _wanted(self._wants_trajectory, result)
        views = self._views.finish()
        if not video and not trajectory:
            return Artifacts(views=views)
        if self._played.lacks_images:
            self._video.close()
            if (reason := second_pass(self._played, self._show)) is not None:
                return Artifacts(not_repeatable=reason)
        footage = self._video.finish()
        return Artifacts(
            Footage(footage.shown if video else {}, footage.seen if trajectory else {}),
            self._trajectory.finish().to_bytes() if trajectory else None,
            views=views,
        )

    def _show(self, obs: Obs) -> None:
        if self._wants_video != "none":
            self._video.add(obs)
        elif self._wants_trajectory != "none":
            self._video.add(replace(obs, info={}))  # without the views for people

    def __exit__(self, *exc: object) -> None:
        self._video.close()
        self._views.close()


def save(out: Path, cell: EvalCase, result: EpisodeResult, kept: Artifacts) -> tuple[list[str], str | None]:
    """Write the files of an episode below `out`; returns the paths of its videos and its trajectory, relative to it."""
    videos = save_videos(out, cell, result, kept.footage.shown)
    return videos, save_trajectory(out, cell, result, kept.trajectory, kept.footage, videos)


def _wanted(which: EpisodeChoice, result: EpisodeResult) -> bool:
    return which == "all" or (which == "failures" and not result.success_once)


class EpisodeViews(EpisodeObserver):
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
        name = "_".join([*(part.replace("/", "_") for part in job.cell.name if part), stem(job.key)])
        for viewer in self._viewers:
            self._shown.enter_context(viewer.episode(name))

    def add_observation(self, obs: Obs) -> None:
        if self._viewers:
            self._seen.append(ViewerFrame.of(obs, self._ticks, time=self._begun + self._ticks * self._period_s))
            self._ticks += 1

    def add_act(self, act: Act, ticks_waited: int = 0) -> None:
        if self._viewers:
            self._rows, self._row, self._numbers = np.array(act.rows()), 0, numbers_of(act.info)

    def add_action(self, action: np.ndarray, reward: float, success: bool) -> None:
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
    """Write the files of an episode as `FOLDER/POLICY/SUITE/ENV/epNNNN_seedS_OUTCOME.rrd`, or `.mcap`."""
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
