"""Writing the episodes of sessions into datasets."""

from __future__ import annotations

import logging
import os
import shutil
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.dataset_contract import CHUNK, ROWS, SESSION, TRACE
from vlagents_ray.datasets.episode import RunningEpisode
from vlagents_ray.datasets.writer import Dataset
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.interface import Obs

logger = logging.getLogger(__name__)

# Maximum number of frames of an episode, whose numbers are in memory; then another episode begins.
_FRAMES = 2000
_BYTES = 16 * 2**20  # maximum size of these numbers
# Maximum number of sessions that are recorded at once; each has an encoder per camera.
_SESSIONS = 32
_FREE_BYTES = 2**30  # space that the recording leaves free on its disk
_LOOK_S = 10.0  # interval of the checks of the folder's size
# Of the metadata.
_STATED = ("policy", "checkpoint", "weights", "policy_version", "contract", "version", "code")


class RecordingEnded(Exception):
    """Raised when nothing more is recorded, with the reason."""


@dataclass(frozen=True, slots=True)
class RecordedAct:
    """One act of a session: the observation, and the chunk in its answer."""

    obs: Obs
    chunk: np.ndarray  # (H, D) float32
    captured_at: float  # s since 1970
    tick: int  # number of acts of the session since its reset
    columns: Mapping[str, Any]  # see `RunningEpisode.add`

    @property
    def shapes(self) -> tuple[Any, ...]:
        """The shapes that all frames of one dataset have in common."""
        obs = self.obs
        cameras = tuple((name, obs.cameras[name].shape) for name in sorted(obs.cameras))
        state = tuple((name, obs.state[name].shape) for name in sorted(obs.state))
        return cameras, state, obs.gripper is None, self.chunk.shape[1]


@dataclass(frozen=True, slots=True)
class _Shelf:
    """A dataset, with the shapes that its frames have in common."""

    dataset: Dataset
    shapes: tuple[Any, ...]
    rows: int  # number of rows of `CHUNK`
    meaning: ActionSpec  # specification of the actions

    def fits(self, frame: RecordedAct) -> bool:
        return self.shapes == frame.shapes and self.rows >= len(frame.chunk)


@dataclass(slots=True)
class _Running:
    number: int  # number of the session, the same in all its episodes
    instruction: str
    reset: str  # options of the reset, as `to_text` writes them; empty once they are recorded
    weights: str  # the loaded weights in the reset's info, as text; empty once recorded
    shelf: _Shelf | None = None  # dataset of `episode`
    episode: RunningEpisode | None = None  # None before the first frame
    frames: int = 0  # number of frames of `episode`
    size: int = 0  # size of its numbers, bytes


class EpisodeWriter:
    """Writes the episodes of one replica. Not thread-safe.

    Frames with other cameras, states or actions are written to another dataset: `FOLDER/NAME-0`,
    `FOLDER/NAME-1`, …
    """

    def __init__(
        self,
        folder: Path,
        name: str,
        fps: float,
        *,
        lossless: bool,
        most_bytes: float,
        describe: Callable[[], Mapping[str, Any]] | None = None,
    ) -> None:
        """Create a writer; its first file is created with the first frame.

        Args:
            fps: The rate of frames that timestamps assume, Hz.
            lossless: Whether videos are encoded without loss.
            most_bytes: Maximum size of the folder, over which recording ends.
            describe: Returns the metadata of the policy, for a trace; None if the frames make no
                trace.
        """
        self.saved = 0  # number of frames in complete episodes
        self.lost = 0  # number of frames in episodes that could not be written
        self._folder, self._name, self._fps = folder, name, fps
        self._lossless, self._most_bytes, self._describe = lossless, most_bytes, describe
        self._shelves: list[_Shelf] = []
        self._running: dict[str, _Running] = {}
        self._numbers = 0
        self._looked = float("-inf")  # time of the last check of the folder's size, s

    def begin(self, session: str, instruction: str, reset: str = "", weights: str = "") -> None:
        """Begin to record a session, and end its previous episode.

        The options of the `reset`, and the checkpoint and `weights` that act, are texts; empty if
        unknown.
        """
        self.end(session)
        if len(self._running) >= _SESSIONS:
            return
        self._running[session] = _Running(self._numbers, instruction, reset, weights)
        self._numbers += 1

    def __contains__(self, session: str) -> bool:
        return session in self._running

    def add(self, session: str, frame: RecordedAct) -> None:
        """Append a frame to a session that is being recorded.

        Raises:
            RecordingEnded: The folder, or its disk, is full; the recorded episodes are complete.
            OSError: The frame cannot be written.
        """
        running = self._running[session]
        full = running.frames >= _FRAMES or running.size >= _BYTES
        if full or running.shelf is None or not running.shelf.fits(frame):
            self._save(running)
        if time.monotonic() - self._looked >= _LOOK_S:
            self.require_room()
        if running.shelf is None or running.episode is None:
            running.shelf = self._shelf(frame)
            running.episode = running.shelf.dataset.begin(
                running.instruction, running.shelf.meaning
            )
        missing = running.shelf.rows - len(frame.chunk)
        columns = {
            **frame.columns,
            "reset": running.reset,
            "weights": running.weights,
            SESSION: running.number,
            ROWS: len(frame.chunk),
            # Repeats the last row.
            CHUNK: np.pad(frame.chunk, ((0, missing), (0, 0)), mode="edge").ravel(),
        }
        running.episode.add(
            frame.obs, frame.chunk[0], frame.captured_at, frame.tick, False, more=columns
        )
        running.reset = running.weights = ""
        running.frames += 1
        running.size += columns[CHUNK].nbytes + sum(
            len(text) for text in columns.values() if isinstance(text, str)
        )

    def end(self, session: str) -> Path | None:
        """End the session's episode, and return the folder of the dataset that contains it; None
        without an episode.
        """
        running = self._running.pop(session, None)
        return None if running is None else self._save(running)

    def drop(self, session: str) -> None:
        """Drop the session's current episode, which cannot be written."""
        running = self._running.pop(session, None)
        if running is not None and running.episode is not None:
            self.lost += running.frames
            running.episode.abandon()

    def close(self) -> None:
        """End all episodes; drop those that cannot be written."""
        for session in list(self._running):
            try:
                self.end(session)
            except (OSError, VLAgentsError) as error:
                logger.warning(
                    "recording: the last episode of session %s is lost: %s", session, error
                )

    def require_room(self) -> None:
        """Raise `RecordingEnded` if the folder, or its disk, is full."""
        self._looked = time.monotonic()
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        size = 0
        for root, _, names in os.walk(self._folder):
            for name in names:
                with suppress(OSError):  # renamed a moment ago
                    size += os.stat(os.path.join(root, name)).st_size
        if size > self._most_bytes:
            raise RecordingEnded(
                f"{self._folder} holds {size / 1e9:.3g} GB, want {self._most_bytes / 1e9:g} at most"
            )
        if (free := shutil.disk_usage(self._folder).free) < _FREE_BYTES:
            raise RecordingEnded(f"the disk of {self._folder} has {free / 1e9:.1f} GB left")

    def _save(self, running: _Running) -> Path | None:
        episode, shelf, frames = running.episode, running.shelf, running.frames
        running.episode, running.shelf, running.frames, running.size = None, None, 0, 0
        if episode is None or shelf is None:
            return None
        try:
            shelf.dataset.save(episode.finish())
        except BaseException:
            self.lost += frames
            episode.abandon()
            raise
        self.saved += frames
        return shelf.dataset.root

    def _shelf(self, frame: RecordedAct) -> _Shelf:
        """Return the dataset for such frames, with at least as many rows per chunk."""
        for shelf in self._shelves:
            if shelf.fits(frame):
                return shelf
        root = self._folder / f"{self._name}-{len(self._shelves)}"
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        root.mkdir(mode=0o700)  # other users must not read the pictures
        dataset = Dataset(root, self._fps, lossless=self._lossless)
        meaning = ActionSpec()
        if self._describe is not None:
            metadata = self._describe()
            dataset.info[TRACE] = {key: metadata[key] for key in _STATED if key in metadata}
            dataset.info[TRACE] |= {"rows": len(frame.chunk), "action_dim": frame.chunk.shape[1]}
            if (stated := metadata.get("contract")) is not None:
                meaning = Contract.from_json(stated).action
        self._shelves.append(_Shelf(dataset, frame.shapes, len(frame.chunk), meaning))
        return self._shelves[-1]
