"""Writes the episodes of sessions into datasets."""

from __future__ import annotations

import itertools
import logging
import os
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
from vlagents_ray.disk import require_free, storing
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.interface import Obs

logger = logging.getLogger(__name__)

# Maximum number of frames of an episode, whose numbers are kept in memory; beyond it, another
# episode begins.
_FRAMES = 2000
_BYTES = 16 * 2**20  # maximum size of the numbers of an episode, bytes
# Maximum number of sessions that are recorded at the same time; each has an encoder per camera.
_SESSIONS = 32
_FREE_BYTES = 1e9  # the space that the recording leaves free on its disk, bytes
KEPT = "the saved episodes are kept; restart the server to record again"  # after a disk error
_CHECK_S = 10.0  # the interval of the checks of the folder's size
# The keys of the metadata that a trace contains.
_TRACE_KEYS = (
    "policy",
    "checkpoint",
    "weights",
    "policy_version",
    "contract",
    "version",
    "code",
    "program",
    "devices",
    "passes",
)


class RecordingEnded(Exception):
    """Recording has ended because its folder is full."""


@dataclass(frozen=True, slots=True)
class RecordedAct:
    """An observation of a session, and the chunk in the answer."""

    obs: Obs
    chunk: np.ndarray  # (H, D) float32
    captured_at: float  # capture time, s since 1970
    tick: int  # the number of the session's action requests since its reset
    columns: Mapping[str, Any]  # see `RunningEpisode.add`

    @property
    def shapes(self) -> tuple[Any, ...]:
        """The shapes that all frames of one dataset have in common."""
        obs = self.obs
        cameras = tuple((name, obs.cameras[name].shape) for name in sorted(obs.cameras))
        state = tuple((name, obs.state[name].shape) for name in sorted(obs.state))
        return cameras, state, obs.gripper is None, self.chunk.shape[1]


@dataclass(frozen=True, slots=True)
class _Target:
    """A dataset, with the shapes that its frames have in common."""

    dataset: Dataset
    shapes: tuple[Any, ...]
    rows: int  # the number of rows of the feature `CHUNK`
    action_spec: ActionSpec

    def fits(self, frame: RecordedAct) -> bool:
        """Return whether a frame can be written into the dataset."""
        return self.shapes == frame.shapes and self.rows >= len(frame.chunk)


@dataclass(slots=True)
class _RecordedSession:
    """A session that is being recorded."""

    number: int  # the number of the session, the same in all its episodes
    instruction: str
    reset: str  # the options of the reset, as text; empty once they have been recorded
    # The loaded weights in the reset's info, as text; empty once they have been recorded.
    weights: str
    target: _Target | None = None  # the dataset of `episode`
    episode: RunningEpisode | None = None  # None before the first frame
    frames: int = 0  # the number of frames of `episode`
    size: int = 0  # the size of the episode's numbers, bytes


class EpisodeWriter:
    """Writes the episodes of one replica. Not thread-safe.

    Frames with other cameras, states or actions are written to another dataset: `FOLDER/NAME-0`,
    `FOLDER/NAME-1`, … The first file is created with the first frame.

    Args:
        folder: The folder of the datasets.
        name: The beginning of the datasets' names.
        fps: The rate of the frames, from which their timestamps follow, Hz.
        lossless: Whether videos are encoded without loss.
        most_bytes: Maximum size of the folder, beyond which recording ends.
        describe: Returns the metadata of the policy, which a trace contains; None if the frames are
            not a trace.
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
        self.saved = 0  # the number of frames in complete episodes
        self.lost = 0  # the number of frames in episodes that could not be written
        self.folder = folder
        self._name = name
        self._fps = fps
        self._lossless = lossless
        self._most_bytes = most_bytes
        self._describe = describe
        self._targets: list[_Target] = []
        self._recorded: dict[str, _RecordedSession] = {}
        self._numbers = 0  # the number of sessions that were recorded
        self._checked_at = float("-inf")  # the time of the last check of the folder's size, s

    def begin(self, session: str, instruction: str, reset: str = "", weights: str = "") -> None:
        """Begin to record a session, and end its previous episode.

        The session is not recorded if too many others are.

        Args:
            session: The id of the session.
            instruction: The task in words.
            reset: The options of the reset, as text; empty if unknown.
            weights: The checkpoint and the weights of the session, as text; empty if unknown.
        """
        self.end(session)
        if len(self._recorded) >= _SESSIONS:
            return
        self._recorded[session] = _RecordedSession(self._numbers, instruction, reset, weights)
        self._numbers += 1

    def __contains__(self, session: str) -> bool:
        return session in self._recorded

    def add(self, session: str, frame: RecordedAct) -> None:
        """Append a frame to a session that is being recorded.

        Raises:
            RecordingEnded: The folder is full; the recorded episodes are complete.
            StorageFailed: The disk is full; the recorded episodes are complete.
            OSError: The frame cannot be written.
        """
        recorded = self._recorded[session]
        is_full = recorded.frames >= _FRAMES or recorded.size >= _BYTES
        if is_full or recorded.target is None or not recorded.target.fits(frame):
            self._save(recorded)
        if time.monotonic() - self._checked_at >= _CHECK_S:
            self.require_room()

        if recorded.target is None or recorded.episode is None:
            target = self._target(frame)
            recorded.target = target
            recorded.episode = target.dataset.begin(recorded.instruction, target.action_spec)

        missing_rows = recorded.target.rows - len(frame.chunk)
        columns = {
            **frame.columns,
            "reset": recorded.reset,
            "weights": recorded.weights,
            SESSION: recorded.number,
            ROWS: len(frame.chunk),
            # Shorter chunks are filled with their last row.
            CHUNK: np.pad(frame.chunk, ((0, missing_rows), (0, 0)), mode="edge").ravel(),
        }
        recorded.episode.add(
            frame.obs, frame.chunk[0], frame.captured_at, frame.tick, False, more=columns
        )

        recorded.reset = ""
        recorded.weights = ""
        recorded.frames += 1
        text_sizes = [len(text) for text in columns.values() if isinstance(text, str)]
        recorded.size += columns[CHUNK].nbytes + sum(text_sizes)

    def end(self, session: str) -> Path | None:
        """End the session's episode, and return the folder of the dataset that contains it; None if
        the session has no episode.
        """
        recorded = self._recorded.pop(session, None)
        return None if recorded is None else self._save(recorded)

    def drop(self, session: str) -> None:
        """Drop the session's current episode, which cannot be written."""
        recorded = self._recorded.pop(session, None)
        if recorded is not None and recorded.episode is not None:
            self.lost += recorded.frames
            recorded.episode.abandon()

    def close(self) -> None:
        """End all episodes; drop those that cannot be written."""
        for session in list(self._recorded):
            try:
                with storing(self.folder, KEPT):
                    self.end(session)
            except (OSError, VLAgentsError) as error:
                logger.warning(
                    "recording: the last episode of session %s is lost: %s", session, error
                )

    def require_room(self) -> None:
        """Raise `RecordingEnded` if the folder is full, and `StorageFailed` if its disk is."""
        self._checked_at = time.monotonic()
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        size = 0
        for root, _, names in os.walk(self.folder):
            for name in names:
                with suppress(OSError):  # the file has just been renamed
                    size += os.stat(os.path.join(root, name)).st_size
        if size > self._most_bytes:
            raise RecordingEnded(
                f"{self.folder}: expected at most {self._most_bytes / 1e9:g} GB, got "
                f"{size / 1e9:.3g}"
            )
        require_free(self.folder, _FREE_BYTES)

    def _save(self, recorded: _RecordedSession) -> Path | None:
        """Complete the current episode of a session, and return the folder of its dataset; None if
        the session has no episode.
        """
        episode, target, frames = recorded.episode, recorded.target, recorded.frames
        recorded.episode = None
        recorded.target = None
        recorded.frames = 0
        recorded.size = 0
        if episode is None or target is None:
            return None

        try:
            target.dataset.save(episode.finish())
        except BaseException:
            self.lost += frames
            episode.abandon()
            raise
        self.saved += frames
        return target.dataset.root

    def _target(self, frame: RecordedAct) -> _Target:
        """Return the dataset for a frame of these shapes, whose chunks have at least as many rows
        as the frame's.
        """
        for target in self._targets:
            if target.fits(frame):
                return target

        # A server that was restarted within a second has the same name.
        numbers = itertools.count(len(self._targets))
        roots = (self.folder / f"{self._name}-{number}" for number in numbers)
        root = next(root for root in roots if not root.exists())
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        root.mkdir(mode=0o700)  # other users must not read the pictures
        dataset = Dataset(root, self._fps, lossless=self._lossless)

        action_spec = ActionSpec()
        if self._describe is not None:
            metadata = self._describe()
            trace = {key: metadata[key] for key in _TRACE_KEYS if key in metadata}
            trace |= {"rows": len(frame.chunk), "action_dim": frame.chunk.shape[1]}
            dataset.info[TRACE] = trace
            contract = metadata.get("contract")
            if contract is not None:
                action_spec = Contract.from_json(contract).action

        target = _Target(dataset, frame.shapes, len(frame.chunk), action_spec)
        self._targets.append(target)
        return target
