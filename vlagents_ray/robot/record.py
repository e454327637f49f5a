"""A recorder of a robot's observations and actions that does not delay the control loop."""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np

from vlagents_ray.datasets.episode import ACTION, Label, RunningEpisode
from vlagents_ray.datasets.writer import Dataset
from vlagents_ray.disk import require_free, storing
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import CAPTURED, Obs, copied

logger = logging.getLogger(__name__)

# A recording does not begin with less free space, bytes: about a minute of a camera of 640 x 480
# pixels at 30 Hz.
LEAST_FREE_BYTES = 50e6
_NICE = 5  # niceness of the writing thread, so that its priority is lower than the control loop's


class Recorder:
    """A recorder of episodes in a LeRobotDataset v3.0; it needs the extra "record".

        with Recorder(Path("demos"), fps=50) as recorder:
            with recorder.episode("stack the cups"):
                recorder.add(obs, action, tick=0)

    `add` copies the frame into a queue and returns; a thread encodes and writes it. If the queue is
    full, the frame is dropped and counted in `dropped`, and the column `tick` shows the gap. An
    episode is part of the dataset as soon as it ends, so a crash loses at most the running episode.
    If writing fails, for instance on a full disk, the episode is lost, and `close` raises the
    error. The robot continues, and later episodes are recorded if there is room again.

    Args:
        root: The dataset's folder, which is created or continued.
        fps: The rate of the frames, Hz.
        frames: The largest number of frames in the queue.
        interventions: Whether an operator may take over: frames then also have `intervention`
            (bool), `policy_action` and `policy_known` (bool), and episodes a label. If an existing
            dataset has these columns, they are always written.

    Raises:
        ConfigError: The folder contains other files, or a dataset with another rate or version or
            without these columns.
        StorageFailed: The folder cannot be written to, or its disk has less free space than
            `LEAST_FREE_BYTES`.
        MissingDependency: The extra "record" is not installed.
    """

    def __init__(
        self, root: str | Path, fps: float, *, frames: int = 100, interventions: bool = False
    ) -> None:
        self.dropped = 0
        self.lost = 0  # the number of frames of episodes that could not be written
        self.error: Exception | None = None  # the first error of writing
        self._root = Path(root)
        try:
            with storing(self._root, "then record again"):
                self.free_bytes = require_free(self._root, LEAST_FREE_BYTES)
                self._dataset = Dataset(self._root, fps, interventions=interventions)
                # This raises the error of an unusable folder now, not with the first frame.
                self._root.mkdir(parents=True, exist_ok=True)
        except ConfigError:
            raise
        except (OSError, ValueError, KeyError) as error:
            # The folder does not exist, is not accessible, or has damaged files.
            raise ConfigError(
                f"recorder {root}: {type(error).__name__}: {error}; record into a new folder that "
                "can be written to"
            ) from error
        self._label: Label | None = None
        self._frames = frames

        # The steps that the writing thread executes: functions that take the running episode and
        # return the episode that runs afterwards. None ends the thread.
        self._queue: queue.SimpleQueue[
            Callable[[RunningEpisode | None], RunningEpisode | None] | None
        ]
        self._queue = queue.SimpleQueue()
        self._added = 0  # the number of frames added, counted by the thread of the control loop
        self._taken = 0  # the number of frames taken from the queue, counted by the writing thread

        self._thread = threading.Thread(target=self._run, name="vlagents-ray-recorder", daemon=True)
        self._thread.start()

    @property
    def episodes(self) -> int:
        """The number of episodes in the dataset."""
        return self._dataset.episodes

    @property
    def interventions(self) -> bool:
        """Whether the frames have the columns of interventions."""
        return self._dataset.interventions

    @property
    def description(self) -> str:
        """The folder and the free space at the beginning, for the operator."""
        return f"records into {self._root}, whose disk has {self.free_bytes / 1e9:.1f} GB free"

    @contextlib.contextmanager
    def episode(self, instruction: str) -> Iterator[None]:
        """Record the frames that are added within the context as one episode.

        The episode is saved even if the context ends with an exception, unless it has the label
        "discard".

        Args:
            instruction: The task in words.
        """
        self._label = None
        self._queue.put(lambda _: self._dataset.begin(instruction))
        try:
            yield
        finally:
            self._queue.put(partial(self._end, self._label))

    def label(self, label: Label) -> None:
        """Label the running episode; a later label replaces an earlier one. May be called from any
        thread.

        Args:
            label: "success" or "failure", which is written to the column `label` of the dataset's
                episodes; or "discard", which drops the episode.

        Raises:
            ConfigError: The label is unknown, or the dataset has no columns of interventions.
        """
        if label not in get_args(Label):
            raise ConfigError(f"label: expected one of {list(get_args(Label))}, got {label!r}")
        if label != "discard" and not self.interventions:
            raise ConfigError(
                f"label: expected a dataset with labels for {label!r}, got a dataset without "
                f"labels; pass interventions=True"
            )
        self._label = label

    def add(
        self,
        obs: Obs,
        action: np.ndarray,
        *,
        tick: int,
        safe: bool = False,
        intervention: bool = False,
        policy_action: np.ndarray | None = None,
    ) -> None:
        """Record a frame; never waits.

        Args:
            obs: The observation.
            action: The action that was applied after it, (D,) float32.
            tick: The tick of the control loop.
            safe: Whether the action is a safe action, not the policy's action.
            intervention: Whether an operator moved the robot at this tick.
            policy_action: The policy's action, (D,), if another action was applied; None if
                unknown.
        """
        if self._added - self._taken >= self._frames:
            self.dropped += 1
            return
        if CAPTURED not in obs.info:
            obs = Obs(obs.cameras, obs.gripper, obs.state, {CAPTURED: time.time()})
        obs_copy, action_copy = copied(obs), np.array(action)

        def write(episode: RunningEpisode | None) -> RunningEpisode | None:
            """Add the frame to the running episode."""
            self._taken += 1
            if episode is None:  # it was abandoned after an error
                self.lost += 1
            else:
                captured_at = float(obs_copy.info[CAPTURED])
                try:
                    episode.add(
                        obs_copy, action_copy, captured_at, tick, safe, intervention, policy_action
                    )
                except Exception:
                    self.lost += 1
                    raise
            return episode

        self._added += 1
        self._queue.put(write)

    def close(self) -> None:
        """Write the frames in the queue, and raise the first error that occurred.

        Raises:
            StorageFailed: The disk is full, or cannot be written to.
            InvalidObservation: The cameras or shapes of an episode differ.
        """
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()
        if self.error is not None:
            error, self.error = self.error, None
            kept = (
                f"complete episodes kept: {self.episodes}, frames of others lost: {self.lost}; "
                "then continue in this folder"
            )
            with storing(self._root, kept):
                raise error

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *exc: object) -> None:
        has_failed = exc[0] is not None  # otherwise an error of `close` would hide the first error
        with contextlib.suppress(Exception) if has_failed else contextlib.nullcontext():
            self.close()

    def _run(self) -> None:
        """Execute the steps in the queue, until the recorder is closed; runs on its own thread."""
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        episode: RunningEpisode | None = None

        while True:
            step = self._queue.get()
            if step is None:
                break
            try:
                episode = step(episode)
            except Exception as error:  # noqa: BLE001 - raised by `close`; the robot continues
                self.error = self.error or error
                logger.warning("an episode is not recorded, but the robot continues: %s", error)
                if episode is not None:
                    self.lost += len(episode.rows.get(ACTION, ()))
                    episode.abandon()
                episode = None

        if episode is not None:
            episode.abandon()

    def _end(self, label: Label | None, episode: RunningEpisode | None) -> None:
        """Save the running episode, or abandon it if it is empty or has the label "discard"."""
        if episode is not None and episode.rows and label != "discard":
            self._dataset.save(episode.finish(label))
        elif episode is not None:
            episode.abandon()
