"""What is kept of an episode beside its result: videos for people, a trajectory for programs."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from vlagents_ray.evaluate.cells import Cell
from vlagents_ray.evaluate.config import EpisodeChoice, EvalConfig
from vlagents_ray.evaluate.episode import EpisodeResult
from vlagents_ray.evaluate.trajectory import TrajectoryRecorder, save_trajectory
from vlagents_ray.evaluate.video import Footage, VideoRecorder, save_videos
from vlagents_ray.interface import Obs


@dataclass(frozen=True, slots=True)
class Kept:
    """What travels from the worker to the driver with an episode's result."""

    footage: Footage = field(default_factory=Footage)
    trajectory: bytes | None = None  # a `Trajectory` as .npz


class Recording:
    """Records one episode as `config` wants it. Use as a context manager: leaving it frees the encoders."""

    def __init__(self, config: EvalConfig, fps: float | None) -> None:
        self._wants_video, self._wants_trajectory = config.video, config.record
        self._video = VideoRecorder(fps, seen=config.record != "none")
        self._trajectory = TrajectoryRecorder()

    @property
    def wants_images(self) -> bool:
        """Are the images of every step kept, for a while at least?"""
        return {self._wants_video, self._wants_trajectory} != {"none"}

    def see(self, obs: Obs) -> None:
        """An observation, the first one included."""
        if self._wants_video != "none":
            self._video.add(obs)
        elif self._wants_trajectory != "none":
            self._video.add(replace(obs, info={}))  # without the views for people
        if self._wants_trajectory != "none":
            self._trajectory.see(obs)

    def do(self, action: np.ndarray, reward: float, success: bool) -> None:
        """An action that was executed, (D,), and what it led to."""
        if self._wants_trajectory != "none":
            self._trajectory.do(action, reward, success)

    def finish(self, result: EpisodeResult) -> Kept:
        """What is to be kept of the episode, now that its outcome is known."""
        video, trajectory = _wanted(self._wants_video, result), _wanted(self._wants_trajectory, result)
        if not video and not trajectory:
            return Kept()
        footage = self._video.finish()
        return Kept(
            Footage(footage.shown if video else {}, footage.seen if trajectory else {}),
            self._trajectory.finish().to_bytes() if trajectory else None,
        )

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *exc: object) -> None:
        self._video.close()


def save(out: Path, cell: Cell, result: EpisodeResult, kept: Kept) -> tuple[list[str], str | None]:
    """Write the files of an episode below `out`; paths of its videos and of its trajectory, relative to that."""
    videos = save_videos(out, cell, result, kept.footage.shown)
    return videos, save_trajectory(out, cell, result, kept.trajectory, kept.footage, videos)


def _wanted(which: EpisodeChoice, result: EpisodeResult) -> bool:
    return which == "all" or (which == "failures" and not result.success_once)
