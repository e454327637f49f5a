"""The last seconds of each session, of which a press on the live page makes an episode of a LeRobotDataset.

A thread reads the tap ten times a second, as a viewer does, and keeps pictures as files: those that clients sent as
they came, others encoded with at most 4 % of a core, for which frames are left out. All sessions together hold at most
`memory_mb`; beyond that the oldest frames go first. One session is saved at a time, and one frame of it decoded at a
time, until the folder holds `most_gb`.
"""

from __future__ import annotations

import hashlib
import os
import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vlagents_ray.dataset_contract import GRIPPER
from vlagents_ray.errors import InvalidInput, Overloaded, StorageFailed
from vlagents_ray.images.jpeg_png import decode
from vlagents_ray.interface import Obs
from vlagents_ray.registry import require
from vlagents_ray.robot.dataset import Dataset
from vlagents_ray.serve.config.deployment import LiveArgs
from vlagents_ray.serve.live.tap import ENCODING_SHARE, RATE, LiveTap
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.sessions import SessionTable

_PIXELS = 2**25  # most of all pictures of a frame
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
        self._tap.forget_others(held)
        begun = time.thread_time()
        longest_without = sorted(held, key=self._newest)
        for name in longest_without:
            seen = self._tap.seen(name)
            if seen is None or seen.action is None or seen.number == self._newest(name):
                continue
            if seen.cameras and time.thread_time() - begun >= ENCODING_SHARE / RATE:
                continue
            at = time.time() - (time.monotonic() - seen.time)
            frame = HeldFrame(seen.number, at, seen.state, seen.pictures(), seen.action)
            with self._lock:
                self._frames.setdefault(name, deque()).append(frame)
                self.bytes += frame.size
        with self._lock:
            self._drop(held)

    def save(self, session: str) -> str:
        """Write the session's frames as an episode, and return the path of its dataset.

        Raises:
            InvalidInput: Nothing of the session is held.
            Overloaded: Another session is being saved.
            StorageFailed: The folder is full.
            VLAgentsError: The episode cannot be written.
        """
        if not self._saving.acquire(blocking=False):
            raise Overloaded("save: another session is being saved; press again when that is done")
        try:
            return self._save(session)
        finally:
            self._saving.release()

    def _save(self, session: str) -> str:
        folder, most_gb = Path(self._settings.folder), self._settings.most_gb
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        size = _bytes_in(folder)
        if size >= most_gb * 1e9:
            raise StorageFailed(
                f"live.folder: {folder} holds {size / 1e9:.3g} GB, want less than most_gb: {most_gb:g}; make room there"
            )
        with self._lock:
            held = list(self._frames.get(session, ()))
        frames = deque(one for one in held if one.shapes == held[-1].shapes)
        del held
        if not frames:
            raise InvalidInput(f"session {session!r}: nothing to save yet; it has acted on nothing")
        found = next((one for one in self._sessions.all() if one.id == session), None)
        sizes = sorted((name, image.shape) for name, image in _observation(frames[0]).cameras.items())
        kind = hashlib.sha256(repr((frames[0].shapes, sizes)).encode()).hexdigest()[:8]
        root = folder / f"{self._name}-{kind}"
        dataset = Dataset(root, RATE)
        episode = dataset.begin("" if found is None else found.instruction)
        try:
            while frames:
                frame = frames.popleft()
                episode.add(_observation(frame), frame.action, frame.at, frame.number, safe=False)
            dataset.save(episode.finish())
        except BaseException:
            episode.abandon()
            raise
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


def _bytes_in(folder: Path) -> int:
    size = 0
    for inside, _, names in os.walk(folder):
        for name in names:
            with suppress(OSError):  # another replica has just renamed it
                size += os.lstat(os.path.join(inside, name)).st_size
    return size


def _observation(frame: HeldFrame) -> Obs:
    cameras, left = {}, _PIXELS
    for name, file in frame.files.items():
        cameras[name] = decode(file, left)
        left -= cameras[name].shape[0] * cameras[name].shape[1]
    state = dict(frame.state)
    gripper = float(state.pop(GRIPPER)[0]) if GRIPPER in state else None
    return Obs(cameras, gripper, state)
