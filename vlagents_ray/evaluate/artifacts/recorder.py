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
from vlagents_ray.viewers import EpisodeViewer, ViewerFrame, is_live, numbers_of, open_viewer

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Artifacts:
    """The recorded files of an episode, as the worker sends them to the driver with its result."""

    footage: Footage = field(default_factory=Footage)
    trajectory: bytes | None = None  # a `Trajectory` as .npz
    transitions: Any = None  # a pyarrow.RecordBatch, for a learner
    rerun: bytes | None = None  # the file of Rerun
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
        self._video = VideoRecorder(fps)
        self._trajectory, self._played = TrajectoryRecorder(), PlayedEpisode()
        self._view = EpisodeView(config.rerun, fps)
        self._is_viewed = bool(config.rerun)
        self._observers: list[EpisodeObserver] = [self._view]
        self._observers += [self._played] if self.wants_images == "failures" else []
        self._observers += [self._trajectory] if self._wants_trajectory != "none" else []

    @property
    def wants_images(self) -> EpisodeChoice:
        wanted = {self._wants_video, self._wants_trajectory}
        return "all" if "all" in wanted or self._is_viewed else "failures" if "failures" in wanted else "none"

    def begin(self, job: Job) -> None:
        self._view.begin(job)

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
        rerun = self._view.finish()
        if not video and not trajectory:
            return Artifacts(rerun=rerun)
        if self._played.lacks_images:
            self._video.close()
            if (reason := second_pass(self._played, self._show)) is not None:
                return Artifacts(not_repeatable=reason)
        videos = self._video.finish()
        return Artifacts(
            Footage(videos if video else {}, videos if trajectory else {}),
            self._trajectory.finish().to_bytes() if trajectory else None,
            rerun=rerun,
        )

    def _show(self, obs: Obs) -> None:
        if self._wants_video != "none" or self._wants_trajectory != "none":
            self._video.add(obs)

    def __exit__(self, *exc: object) -> None:
        self._video.close()
        self._view.close()


def save(out: Path, cell: EvalCase, result: EpisodeResult, kept: Artifacts) -> tuple[list[str], str | None]:
    """Write the files of an episode below `out`; returns the paths of its videos and its trajectory, relative to it."""
    videos = save_videos(out, cell, result, kept.footage.shown)
    return videos, save_trajectory(out, cell, result, kept.trajectory, kept.footage, videos)


def _wanted(which: EpisodeChoice, result: EpisodeResult) -> bool:
    return which == "all" or (which == "failures" and not result.success_once)


class EpisodeView(EpisodeObserver):
    """Shows one episode in Rerun, if the settings have a target."""

    def __init__(self, target: str | None, hz: float | None) -> None:
        """Open the viewer; `hz` is the control rate of the env."""
        self._period_s = 1 / (hz or DEFAULT_FPS)
        self._begun = time.time()
        self._seen: list[ViewerFrame] = []  # observations whose action is not executed yet, at most two
        self._ticks = 0  # observations so far
        self._rows: np.ndarray | None = None  # of the newest chunk, (H, D)
        self._row = 0  # of that chunk, for the next action
        self._numbers: dict[str, float] = {}
        self._folder: Path | None = None  # of the file
        self._viewer: EpisodeViewer | None = None
        self._shown = ExitStack()
        with ExitStack() as stack:
            if target and not is_live(target):
                self._folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            stack.enter_context(self._shown)  # closed before its folder is removed
            if target:
                self._viewer = self._shown.enter_context(open_viewer(str(self._folder or target)))
            self._opened = stack.pop_all()

    def begin(self, job: Job) -> None:
        name = "_".join([*(part.replace("/", "_") for part in job.cell.name if part), stem(job.key)])
        if self._viewer is not None:
            self._shown.enter_context(self._viewer.episode(name))

    def add_observation(self, obs: Obs) -> None:
        if self._viewer is not None:
            self._seen.append(ViewerFrame.of(obs, self._ticks, time=self._begun + self._ticks * self._period_s))
            self._ticks += 1

    def add_act(self, act: Act, ticks_waited: int = 0) -> None:
        if self._viewer is not None:
            self._rows, self._row, self._numbers = np.array(act.rows()), 0, numbers_of(act.info)

    def add_action(self, action: np.ndarray, reward: float, success: bool) -> None:
        if self._viewer is None:
            return
        rows, row = self._rows, self._row
        shown = replace(
            self._seen.pop(0),
            executed=np.array(action),
            planned=None if rows is None or row >= len(rows) else rows[row],
            chunk=rows if row == 0 else None,
            numbers={**self._numbers, "reward": float(reward), "success": float(success)},
        )
        self._viewer.add(shown)
        self._row, self._numbers = row + 1, {}

    def finish(self) -> bytes | None:
        """Show the last observation, and return the file, if there is one."""
        if self._viewer is not None:
            for frame in self._seen:
                self._viewer.add(frame)
            self._seen.clear()
            self._shown.close()
            if self._viewer.dropped or self._viewer.error is not None:
                log.warning("%s", self._viewer.report())
        files = [] if self._folder is None else [file.read_bytes() for file in self._folder.iterdir()]
        self.close()
        return files[0] if files else None

    def close(self) -> None:
        """Close the viewer, and remove what is left of its file."""
        self._opened.close()


def save_view(folder: str, cell: EvalCase, result: EpisodeResult, file: bytes) -> None:
    """Write the file of an episode as `FOLDER/POLICY/SUITE/ENV/epNNNN_seedS_OUTCOME.rrd`."""
    below = episode_folder(Path(folder), ".", cell)
    for old in below.glob(f"{stem(result.key)}_*.rrd"):  # of an earlier attempt
        old.unlink()
    with whole(below / f"{stem(result.key)}_{outcome(result)}.rrd") as part:
        part.write_bytes(file)
