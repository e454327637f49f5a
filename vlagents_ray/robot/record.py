"""Recording what a robot saw and did, without disturbing what it does."""

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

from vlagents_ray.client.session import copied
from vlagents_ray.interface import CAPTURED, Obs
from vlagents_ray.robot.dataset import Dataset
from vlagents_ray.robot.episode import Episode

if TYPE_CHECKING:
    from typing_extensions import Self

_NICE = 5  # the writing thread lets the loop's go first


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
    """Episodes into a LeRobotDataset v3.0 at `root`, made or continued; needs the extra "record".

        with Recorder(Path("demos"), fps=50) as recorder:
            with recorder.episode("stack the cups"):
                recorder.add(obs, action, tick=0)

    `add` copies the frame into a queue of `frames` at most and returns; a thread encodes and writes. A frame that
    finds the queue full is dropped and counted in `dropped`, and the column `tick` shows the gap. An episode is
    part of the dataset as soon as it ended, so a crash loses the running one at most. Trouble in writing, a full
    disk for instance, costs its episode, and is raised by `close`.
    """

    def __init__(self, root: str | Path, fps: float, *, robot_type: str | None = None, frames: int = 100) -> None:
        self.dropped = 0
        self.error: Exception | None = None  # the first
        self._dataset = Dataset(Path(root), fps, robot_type)
        self._frames = frames
        self._queue: queue.SimpleQueue[_Frame | _Begin | _End | None] = queue.SimpleQueue()
        self._put = 0  # frames, by the loop's thread
        self._got = 0  # and by ours
        self._thread = threading.Thread(target=self._run, name="vlagents-ray-recorder", daemon=True)
        self._thread.start()

    @property
    def episodes(self) -> int:
        """How many the dataset has."""
        return self._dataset.episodes

    @contextlib.contextmanager
    def episode(self, instruction: str) -> Iterator[None]:
        """Frames added inside belong to one episode, kept however it ends."""
        self._queue.put(_Begin(instruction))
        try:
            yield
        finally:
            self._queue.put(_End())

    def add(self, obs: Obs, action: np.ndarray, *, tick: int, safe: bool = False) -> None:
        """Record that `action`, (D,), was applied after seeing `obs`; never waits."""
        if self._put - self._got >= self._frames:
            self.dropped += 1
            return
        if CAPTURED not in obs.info:
            obs = Obs(obs.cameras, obs.gripper, obs.state, {CAPTURED: time.time()})
        self._put += 1
        self._queue.put(_Frame(copied(obs), np.array(action), tick, safe))

    def close(self) -> None:
        """Write what is left, and raise the first error that was met."""
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
        episode: Episode | None = None
        while (item := self._queue.get()) is not None:
            self._got += isinstance(item, _Frame)
            try:
                episode = self._handle(item, episode)
            except Exception as error:  # noqa: BLE001 - raised by `close`; the robot goes on
                self.error = self.error or error
                if episode is not None:
                    episode.abandon()
                episode = None
        if episode is not None:
            episode.abandon()

    def _handle(self, item: _Frame | _Begin | _End, episode: Episode | None) -> Episode | None:
        if isinstance(item, _Begin):
            return self._dataset.begin(item.instruction)
        if episode is None:  # given up
            return None
        if isinstance(item, _Frame):
            episode.add(item.obs, item.action, float(item.obs.info[CAPTURED]), item.tick, item.safe)
            return episode
        if episode.rows:
            self._dataset.save(episode.finish())
        else:
            episode.abandon()
        return None
