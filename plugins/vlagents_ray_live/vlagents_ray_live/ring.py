"""The last seconds of each session, which a button of the live page saves as an episode of a
LeRobotDataset.

A thread reads the live observer ten times a second, as a viewer does, and keeps pictures as files:
those of clients unchanged, others encoded with at most 4 % of a core, by omitting frames. All
sessions together hold at most `memory_mb`; beyond that the oldest frames are dropped. One session
is saved at a time, and one frame of it decoded at a time, until the folder holds `most_gb`.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from pathlib import Path

import numpy as np
from pydantic import Field, model_validator

from vlagents_ray.dataset_contract import GRIPPER
from vlagents_ray.errors import InvalidInput, Overloaded, StorageFailed
from vlagents_ray.images.jpeg_png import decode
from vlagents_ray.interface import Obs
from vlagents_ray.registry import require
from vlagents_ray.serve.config.deployment import AbsolutePath
from vlagents_ray.serve.config.parts import PartConfig
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.periodic import Periodic
from vlagents_ray.serve.sessions import SessionTable
from vlagents_ray_live.episodes import EpisodeWriter, RecordedAct, RecordingEnded
from vlagents_ray_live.live import ENCODING_SHARE, RATE, KeptObservation, LiveObserver

_PIXELS = 2**25  # maximum number of pixels of all pictures of a frame


class LiveConfig(PartConfig):
    """The settings of the live page: the last seconds of each session, which a button of the
    page saves.
    """

    folder: AbsolutePath | None = Field(
        default=None,
        description="folder of the datasets, on each replica's own node or shared; each replica "
        "writes its own below "
        "it. Unset: nothing is kept",
    )
    ring_s: float = Field(
        default=30.0, gt=0, le=600, description="how much of each session is held, s"
    )
    memory_mb: float = Field(
        default=256.0,
        gt=0,
        le=1_000_000,
        description="memory that all sessions of a replica take at most, MB; the oldest goes first",
    )
    most_gb: float = Field(
        default=50.0,
        gt=0,
        le=1_000_000,
        description="size of the folder at which nothing more is saved, GB",
    )

    @model_validator(mode="after")
    def _with_a_folder(self) -> LiveConfig:
        if self.folder is None:
            changed = []
            for name, field in type(self).model_fields.items():
                if getattr(self, name) != field.default:
                    changed.append(name)
            if changed:
                raise ValueError(
                    f"got {', '.join(changed)} without `folder`, so that nothing is kept; name a "
                    "folder"
                )
        return self


class Ring:
    """The last seconds of the sessions of one replica, from `open` to `close`."""

    def __init__(
        self,
        live: LiveObserver,
        sessions: SessionTable[LoadedModel],
        folder: Path,
        settings: LiveConfig,
        name: str,
    ) -> None:
        """Create an empty buffer.

        Its episodes go to datasets below `folder`, whose names begin with the replica's `name`.

        Raises:
            MissingDependency: The extra "record" is not installed.
        """
        for module in ("av", "pyarrow"):
            require(module)
        self.bytes = 0  # size of the held frames
        self._live, self._sessions, self._settings = live, sessions, settings
        self._writer = EpisodeWriter(
            folder, name, RATE, lossless=False, most_bytes=settings.most_gb * 1e9
        )
        self._frames: dict[str, deque[KeptObservation]] = {}  # by session
        self._lock = threading.Lock()  # guards `_frames`
        self._saving = threading.Lock()  # guards `_writer`
        self._periodic = Periodic(1 / RATE)

    def open(self) -> None:
        """Begin to keep frames."""
        self._periodic.add(self.read)

    def close(self) -> None:
        """Stop keeping frames."""
        self._periodic.remove(self.read)

    def read(self) -> None:
        """Keep the live observer's latest observations, and drop those that are too old or too
        many.
        """
        self._live.renew()
        session_ids = self._sessions.ids()
        self._live.forget_others(session_ids)

        begun = time.thread_time()
        longest_without = sorted(session_ids, key=self._newest)
        for session_id in longest_without:
            frame = self._live.observation(session_id)
            if frame is None or frame.action is None or frame.number == self._newest(session_id):
                continue
            if frame.cameras and time.thread_time() - begun >= ENCODING_SHARE / RATE:
                continue

            frame.pictures()
            with self._lock:
                self._frames.setdefault(session_id, deque()).append(frame)
                self.bytes += frame.size

        with self._lock:
            self._drop(session_ids)

    def save(self, session: str) -> str:
        """Write the session's frames as an episode, and return the path of its dataset.

        Raises:
            InvalidInput: No frame of the session is held.
            Overloaded: Another session is being saved.
            StorageFailed: The folder is full.
        """
        if not self._saving.acquire(blocking=False):
            raise Overloaded("save: another session is being saved; press again when that is done")

        try:
            self._writer.require_room()
            with self._lock:
                frames = deque(self._frames.get(session, ()))
            if not frames:
                raise InvalidInput(
                    f"session {session!r}: nothing to save yet; it has acted on nothing"
                )

            instruction = ""
            for candidate in self._sessions.all():
                if candidate.id == session:
                    instruction = candidate.instruction
                    break

            self._writer.begin(session, instruction)
            while frames:
                self._writer.add(session, _recorded(frames.popleft()))
            return str(self._writer.end(session))
        except RecordingEnded as error:
            raise StorageFailed(f"parts.live.folder: {error}; make room there") from error
        finally:
            self._writer.drop(session)  # remains of a failed attempt
            self._saving.release()

    def _newest(self, session: str) -> int:
        frames = self._frames.get(session)
        return frames[-1].number if frames else 0

    def _drop(self, session_ids: list[str]) -> None:
        """Drop ended sessions, old frames, and the oldest ones over the memory limit; the caller
        holds the lock.
        """
        for session_id in self._frames.keys() - set(session_ids):
            self.bytes -= sum(frame.size for frame in self._frames.pop(session_id))

        oldest = time.monotonic() - self._settings.ring_s
        for frames in self._frames.values():
            while frames and frames[0].time < oldest:
                self.bytes -= frames.popleft().size

        while self.bytes > self._settings.memory_mb * 1e6:
            first = min(
                (frames for frames in self._frames.values() if frames),
                key=lambda frames: frames[0].time,
            )
            self.bytes -= first.popleft().size


def _recorded(frame: KeptObservation) -> RecordedAct:
    """Decode the pictures of a frame, and convert it for the writer."""
    cameras, left = {}, _PIXELS
    for name, file in frame.pictures().items():
        cameras[name] = decode(file, left)
        left -= cameras[name].shape[0] * cameras[name].shape[1]
    state = dict(frame.state)
    gripper = float(state.pop(GRIPPER)[0]) if GRIPPER in state else None
    action = np.zeros(0, np.float32) if frame.action is None else frame.action
    at = time.time() - (time.monotonic() - frame.time)
    return RecordedAct(Obs(cameras, gripper, state), action[np.newaxis], at, frame.number, {})
