"""A recorder of a robot's observations and actions, which does not delay the control loop."""

from __future__ import annotations

import contextlib
import os
import queue
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vlagents_ray.interface import CAPTURED, Obs, copied
from vlagents_ray.robot.dataset import Dataset
from vlagents_ray.robot.episode import RobotEpisode

if TYPE_CHECKING:
    from typing_extensions import Self

_NICE = 5  # the writing thread runs after the control loop's


@dataclass(frozen=True, slots=True)
class _Frame:
    obs: Obs
    action: np.ndarray
    tick: int
    safe: bool


@dataclass(frozen=True, slots=True)
class _Begin:
    instruction: str


@dataclass(frozen=True, slots=True)
class _End:
    pass


class Recorder:
    """A recorder of episodes in a LeRobotDataset v3.0; it needs the extra "record".

        with Recorder(Path("demos"), fps=50) as recorder:
            with recorder.episode("stack the cups"):
                recorder.add(obs, action, tick=0)

    `add` copies the frame into a queue and returns; a thread encodes and writes it. If the queue is full, the frame is
    dropped and counted in `dropped`, and the column `tick` shows the gap. An episode is part of the dataset as soon as
    it ends, so a crash loses at most the running one. If writing fails, for instance on a full disk, the episode is
    lost, and `close` raises the error.

    Args:
        root: The dataset's folder, which is created or continued.
        fps: The rate of the frames, Hz.
        robot_type: The robot's name, for the dataset's `info.json`.
        frames: The largest number of frames in the queue.

    Raises:
        ConfigError: The folder has other files, or a dataset of another rate or version.
        MissingDependency: The extra "record" is not installed.
    """

    def __init__(self, root: str | Path, fps: float, *, robot_type: str | None = None, frames: int = 100) -> None:
        self.dropped = 0
        self.error: Exception | None = None  # the first error in writing
        self._dataset = Dataset(Path(root), fps, robot_type)
        self._frames = frames
        self._queue: queue.SimpleQueue[_Frame | _Begin | _End | None] = queue.SimpleQueue()
        self._put = 0  # frames added, counted by the loop's thread
        self._got = 0  # frames taken from the queue, counted by the writing thread
        self._thread = threading.Thread(target=self._run, name="vlagents-ray-recorder", daemon=True)
        self._thread.start()

    @property
    def episodes(self) -> int:
        """The number of episodes in the dataset."""
        return self._dataset.episodes

    @contextlib.contextmanager
    def episode(self, instruction: str) -> Iterator[None]:
        """Make the frames that are added within the context one episode, which is kept however the context ends."""
        self._queue.put(_Begin(instruction))
        try:
            yield
        finally:
            self._queue.put(_End())

    def add(self, obs: Obs, action: np.ndarray, *, tick: int, safe: bool = False) -> None:
        """Record a frame; never waits.

        Args:
            obs: The observation.
            action: The action that was applied after it, (D,) float32.
            tick: The tick of the control loop.
            safe: Whether the action is a safe one, not the policy's.
        """
        if self._put - self._got >= self._frames:
            self.dropped += 1
            return
        if CAPTURED not in obs.info:
            obs = Obs(obs.cameras, obs.gripper, obs.state, {CAPTURED: time.time()})
        self._put += 1
        self._queue.put(_Frame(copied(obs), np.array(action), tick, safe))

    def close(self) -> None:
        """Write the frames in the queue, and raise the first error that occurred."""
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()
        if self.error is not None:
            error, self.error = self.error, None
            raise error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        with contextlib.suppress(Exception) if exc[0] is not None else contextlib.nullcontext():
            self.close()

    def _run(self) -> None:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        episode: RobotEpisode | None = None
        while (item := self._queue.get()) is not None:
            self._got += isinstance(item, _Frame)
            try:
                episode = self._handle(item, episode)
            except Exception as error:  # noqa: BLE001 - raised by `close`; the robot continues
                self.error = self.error or error
                if episode is not None:
                    episode.abandon()
                episode = None
        if episode is not None:
            episode.abandon()

    def _handle(self, item: _Frame | _Begin | _End, episode: RobotEpisode | None) -> RobotEpisode | None:
        if isinstance(item, _Begin):
            return self._dataset.begin(item.instruction)
        if episode is None:  # abandoned after an error
            return None
        if isinstance(item, _Frame):
            episode.add(item.obs, item.action, float(item.obs.info[CAPTURED]), item.tick, item.safe)
            return episode
        if episode.rows:
            self._dataset.save(episode.finish())
        else:
            episode.abandon()
        return None
