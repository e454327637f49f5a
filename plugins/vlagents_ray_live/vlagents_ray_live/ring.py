"""The last seconds of each session, which a button of the live page saves as an episode of a
LeRobotDataset.

A thread reads the live observer ten times a second, as a viewer does, and keeps pictures as files.
Files of clients are kept unchanged; other pictures are encoded; frames are omitted so that this
needs at most 4 % of a core. The frames of all sessions have at most `memory_mb`; beyond that the
oldest frames are dropped. One session is saved at a time, and one frame is decoded at a time.
Nothing is saved once the size of the folder is `most_gb`.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from pathlib import Path

import numpy as np
from pydantic import Field, model_validator

from vlagents_ray.dataset_contract import GRIPPER
from vlagents_ray.disk import storing
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
        "writes its own datasets in it. If it is not set, nothing is kept",
    )
    ring_s: float = Field(
        default=30.0, gt=0, le=600, description="time of each session that is kept, s"
    )
    memory_mb: float = Field(
        default=256.0,
        gt=0,
        le=1_000_000,
        description="most memory for the sessions of a replica, MB; beyond it, the oldest frames "
        "are dropped",
    )
    most_gb: float = Field(
        default=50.0,
        gt=0,
        le=1_000_000,
        description="size of the folder at which nothing more is saved, GB",
    )

    @model_validator(mode="after")
    def _with_a_folder(self) -> LiveConfig:
        """Reject settings that have no effect without a folder."""
        if self.folder is not None:
            return self

        changed = []
        for name, field in type(self).model_fields.items():
            if getattr(self, name) != field.default:
                changed.append(name)
        if changed:
            raise ValueError(
                f"expected a folder with {', '.join(changed)}, got none, so that nothing is kept; "
                "name one"
            )
        return self


class Ring:
    """The last seconds of the sessions of one replica, from `open` to `close`.

    Args:
        live: The live observer, whose observations are kept.
        sessions: The sessions of the replica.
        folder: The folder of the datasets.
        settings: The settings of the live page.
        name: The name of the replica, with which the names of the datasets begin.

    Raises:
        MissingDependency: The extra "record" is not installed.
    """

    def __init__(
        self,
        live: LiveObserver,
        sessions: SessionTable[LoadedModel],
        folder: Path,
        settings: LiveConfig,
        name: str,
    ) -> None:
        for module in ("av", "pyarrow"):
            require(module)

        self.bytes = 0  # the size of the kept frames, bytes
        self._live = live
        self._sessions = sessions
        self._settings = settings
        self._writer = EpisodeWriter(
            folder, name, RATE, lossless=False, most_bytes=settings.most_gb * 1e9
        )
        self._frames: dict[str, deque[KeptObservation]] = {}  # the frames by session
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
        # The session whose last frame is the oldest comes first.
        for session_id in sorted(session_ids, key=self._last_number):
            frame = self._live.observation(session_id)
            if frame is None or frame.action is None:
                continue
            if frame.number == self._last_number(session_id):
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
        """Write the frames of a session as an episode.

        Args:
            session: The id of the session.

        Returns:
            The path of the dataset.

        Raises:
            InvalidInput: No frame of the session is kept.
            Overloaded: Another session is being saved.
            StorageFailed: The folder or its disk is full, or cannot be written to.
        """
        if not self._saving.acquire(blocking=False):
            raise Overloaded("save: another session is being saved; press again when it is saved")

        try:
            self._writer.require_room()
            with self._lock:
                frames = deque(self._frames.get(session, ()))
            if not frames:
                raise InvalidInput(
                    f"session {session!r}: there is nothing to save yet, because the policy has "
                    "not acted in it"
                )

            instruction = ""
            for candidate in self._sessions.all():
                if candidate.id == session:
                    instruction = candidate.instruction
                    break

            with storing(self._writer.folder, "the saved episodes are kept; press again"):
                self._writer.begin(session, instruction)
                while frames:
                    self._writer.add(session, _recorded(frames.popleft()))
                return str(self._writer.end(session))
        except RecordingEnded as error:
            raise StorageFailed(f"parts.live.folder: {error}; make room there") from error
        finally:
            self._writer.drop(session)  # the remains of a failed attempt to save
            self._saving.release()

    def _last_number(self, session: str) -> int:
        """Return the number of the session's last frame; 0 without frames."""
        frames = self._frames.get(session)
        return frames[-1].number if frames else 0

    def _drop(self, session_ids: list[str]) -> None:
        """Drop the sessions that have ended, frames that are too old, and the oldest frames beyond
        the limit of memory; the caller holds the lock.
        """
        for session_id in self._frames.keys() - set(session_ids):
            self.bytes -= sum(frame.size for frame in self._frames.pop(session_id))

        oldest = time.monotonic() - self._settings.ring_s
        for frames in self._frames.values():
            while frames and frames[0].time < oldest:
                self.bytes -= frames.popleft().size

        while self.bytes > self._settings.memory_mb * 1e6:
            not_empty = [frames for frames in self._frames.values() if frames]
            oldest_frames = min(not_empty, key=lambda frames: frames[0].time)
            self.bytes -= oldest_frames.popleft().size


def _recorded(frame: KeptObservation) -> RecordedAct:
    """Decode the pictures of a frame, and convert it for the writer."""
    cameras = {}
    max_pixels = _PIXELS
    for name, file in frame.pictures().items():
        image = decode(file, max_pixels)
        max_pixels -= image.shape[0] * image.shape[1]
        cameras[name] = image

    state = dict(frame.state)
    gripper = float(state.pop(GRIPPER)[0]) if GRIPPER in state else None
    action = np.zeros(0, np.float32) if frame.action is None else frame.action
    age_s = time.monotonic() - frame.time
    return RecordedAct(
        obs=Obs(cameras, gripper, state),
        chunk=action[np.newaxis],
        captured_at=time.time() - age_s,
        tick=frame.number,
        columns={},
    )
