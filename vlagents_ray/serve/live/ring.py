"""The last seconds of each session, of which a press on the live page makes an episode of a LeRobotDataset.

A thread reads the tap ten times a second, as a viewer does, and keeps pictures as files: those that clients sent as
they came, others encoded with at most 4 % of a core, for which frames are left out. All sessions together hold at most
`memory_mb`; beyond that the oldest frames go first.
"""

from __future__ import annotations

import hashlib
import threading
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vlagents_ray.dataset_contract import GRIPPER
from vlagents_ray.errors import InvalidInput
from vlagents_ray.images.jpeg_png import decode
from vlagents_ray.interface import CAPTURED, Obs
from vlagents_ray.registry import require
from vlagents_ray.robot.record import Recorder
from vlagents_ray.serve.config.live import LiveArgs
from vlagents_ray.serve.live.tap import ENCODING_SHARE, RATE, LiveTap
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.sessions import SessionTable

_PIXELS = 2**24  # most of a picture that is decoded for an episode
_OBJECTS = 1000  # bytes of a frame besides its arrays and files, estimated


@dataclass(frozen=True, slots=True)
class HeldFrame:
    """An observation, and the action that answered it."""

    number: int  # of the observation in the tap
    at: float  # s since 1970
    state: dict[str, np.ndarray]  # (D,) float32, with the gripper as a part
    files: dict[str, bytes]  # JPEG or PNG by camera
    action: np.ndarray  # (D,) float32, the first row of the answer

    @property
    def size(self) -> int:
        """The memory that it takes, bytes."""
        arrays = sum(part.nbytes for part in (*self.state.values(), self.action))
        return _OBJECTS + arrays + sum(len(file) for file in self.files.values())

    @property
    def shapes(self) -> object:
        """What the frames of one dataset have in common, but for the sizes of the pictures."""
        state = [(name, part.shape) for name, part in sorted(self.state.items())]
        return state, sorted(self.files), self.action.shape


class Ring:
    """The last seconds of the sessions of one replica, from `open` to `close`."""

    def __init__(self, tap: LiveTap, sessions: SessionTable[LoadedModel], settings: LiveArgs, name: str) -> None:
        """Create an empty ring; its episodes go to datasets whose names begin with `name`, the replica's.

        Raises:
            MissingDependency: The extra "record" is not installed.
        """
        for module in ("av", "pyarrow"):
            require(module)
        self.bytes = 0  # that are held now
        self._tap = tap
        self._sessions = sessions
        self._settings = settings
        self._name = name
        self._frames: dict[str, deque[HeldFrame]] = {}  # by session
        self._lock = threading.Lock()  # of `_frames`
        self._saving = threading.Lock()  # a dataset is written by one thread
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="vlagents-ray-ring", daemon=True)

    @property
    def seconds(self) -> float:
        """How long a frame is kept, s."""
        return self._settings.ring_s

    def open(self) -> None:
        """Begin to keep frames."""
        self._thread.start()

    def close(self) -> None:
        """Stop that."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()

    def read(self) -> None:
        """Keep what the tap has now, and drop what is too old or too much."""
        self._tap.renew()
        held = self._sessions.ids()
        begun = time.thread_time()
        longest_without = sorted(held, key=self._newest)
        for name in longest_without:
            seen = self._tap.seen(name)
            reply = None if seen is None else seen.reply
            if seen is None or reply is None or reply.act is None or seen.number == self._newest(name):
                continue
            if seen.cameras and time.thread_time() - begun >= ENCODING_SHARE / RATE:
                continue
            at = time.time() - (time.monotonic() - seen.time)
            frame = HeldFrame(seen.number, at, seen.state, seen.pictures(), np.array(reply.act.rows()[0]))
            with self._lock:
                self._frames.setdefault(name, deque()).append(frame)
                self.bytes += frame.size
        with self._lock:
            self._drop(held)

    def save(self, session: str) -> str:
        """Write the session's frames as an episode, and return the path of its dataset.

        Raises:
            InvalidInput: Nothing of the session is held.
            VLAgentsError: The episode cannot be written.
        """
        with self._lock:
            frames = list(self._frames.get(session, ()))
        frames = [one for one in frames if one.shapes == frames[-1].shapes]
        if not frames:
            raise InvalidInput(f"session {session!r}: nothing to save yet; it has acted on nothing")
        found = next((one for one in self._sessions.all() if one.id == session), None)
        observations = [_observation(frame) for frame in frames]
        sizes = {name: image.shape for name, image in observations[0].cameras.items()}
        kind = hashlib.sha256(repr((frames[0].shapes, sorted(sizes.items()))).encode()).hexdigest()[:8]
        root = Path(self._settings.folder) / f"{self._name}-{kind}"
        with self._saving:
            root.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            instruction = "" if found is None else found.instruction
            with Recorder(root, RATE, frames=len(frames)) as recorder, recorder.episode(instruction):
                for obs, frame in zip(observations, frames, strict=True):
                    recorder.add(obs, frame.action, tick=frame.number)
        return str(root)

    def _run(self) -> None:
        while not self._over.wait(1 / RATE):
            self.read()

    def _newest(self, session: str) -> int:
        frames = self._frames.get(session)
        return frames[-1].number if frames else 0

    def _drop(self, held: list[str]) -> None:
        """Drop ended sessions, old frames, and the oldest ones beyond the memory; the caller holds the lock."""
        for name in self._frames.keys() - set(held):
            self.bytes -= sum(frame.size for frame in self._frames.pop(name))
        oldest = time.time() - self._settings.ring_s
        for frames in self._frames.values():
            while frames and frames[0].at < oldest:
                self.bytes -= frames.popleft().size
        while self.bytes > self._settings.memory_mb * 1e6:
            first = min((frames for frames in self._frames.values() if frames), key=lambda frames: frames[0].at)
            self.bytes -= first.popleft().size


def _observation(frame: HeldFrame) -> Obs:
    cameras = {name: decode(file, _PIXELS) for name, file in frame.files.items()}
    state = dict(frame.state)
    gripper = float(state.pop(GRIPPER)[0]) if GRIPPER in state else None
    return Obs(cameras, gripper, state, {CAPTURED: frame.at})
