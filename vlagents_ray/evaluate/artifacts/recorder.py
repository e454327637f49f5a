"""Records the artifacts of an episode: videos for people, a trajectory for programs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from typing_extensions import Self

from vlagents_ray.evaluate.artifacts.trajectory import TrajectoryRecorder, save_trajectory
from vlagents_ray.evaluate.artifacts.video import Footage, VideoRecorder, save_videos
from vlagents_ray.evaluate.episode.records import EpisodeObserver, EpisodeResult
from vlagents_ray.evaluate.episode.second_pass import PlayedEpisode, SecondPass
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.config import EpisodeChoice, EvalConfig
from vlagents_ray.interface import Act, Obs


@dataclass(frozen=True, slots=True)
class Artifacts:
    """The recorded files of an episode, as the worker sends them to the driver with its result."""

    footage: Footage = field(default_factory=Footage)
    trajectory: bytes | None = None  # a `Trajectory` as .npz
    transitions: Any = None  # a pyarrow.RecordBatch, for a learner
    not_repeatable: str | None = None  # reason for images that the second pass did not render


class EpisodeRecorder(EpisodeObserver):
    """Records one episode. Use as a context manager, which frees its resources. This class records nothing."""

    @property
    def wants_images(self) -> EpisodeChoice:
        """The episodes that need the images of every step."""
        return "none"

    def finish(self, result: EpisodeResult, second_pass: SecondPass) -> Artifacts:
        """Return the artifacts of an episode with this result; `second_pass` renders missing images."""
        return Artifacts()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        pass


RecorderFactory = Callable[[EvalConfig, float | None], EpisodeRecorder]  # called with the env's control_hz


class Recording(EpisodeRecorder):
    """Records one episode by the settings `video` and `record`."""

    def __init__(self, config: EvalConfig, fps: float | None) -> None:
        self._wants_video, self._wants_trajectory = config.video, config.record
        self._video = VideoRecorder(fps)
        self._trajectory, self._played = TrajectoryRecorder(), PlayedEpisode()
        self._observers: list[EpisodeObserver] = [self._played] if self.wants_images == "failures" else []
        self._observers += [self._trajectory] if self._wants_trajectory != "none" else []

    @property
    def wants_images(self) -> EpisodeChoice:
        wanted = {self._wants_video, self._wants_trajectory}
        return "all" if "all" in wanted else "failures" if "failures" in wanted else "none"

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
        if not video and not trajectory:
            return Artifacts()
        if self._played.lacks_images:
            self._video.close()
            if (reason := second_pass(self._played, self._show)) is not None:
                return Artifacts(not_repeatable=reason)
        videos = self._video.finish()
        return Artifacts(
            Footage(videos if video else {}, videos if trajectory else {}),
            self._trajectory.finish().to_bytes() if trajectory else None,
        )

    def _show(self, obs: Obs) -> None:
        if self._wants_video != "none" or self._wants_trajectory != "none":
            self._video.add(obs)

    def __exit__(self, *exc: object) -> None:
        self._video.close()


def save(out: Path, cell: EvalCase, result: EpisodeResult, kept: Artifacts) -> tuple[list[str], str | None]:
    """Write the files of an episode below `out`; returns the paths of its videos and its trajectory, relative to it."""
    videos = save_videos(out, cell, result, kept.footage.shown)
    return videos, save_trajectory(out, cell, result, kept.trajectory, kept.footage, videos)


def _wanted(which: EpisodeChoice, result: EpisodeResult) -> bool:
    return which == "all" or (which == "failures" and not result.success_once)
