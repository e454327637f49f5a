"""The latest answers and observations of a replica's sessions, kept only while a reader renews its
lease.

Clients determine the data, so all of it is bounded in bytes. Answers keep numbers and short texts.
Of each session only the latest observation is kept, at most `RATE` per second. The oldest answers
and observations are dropped beyond `ANSWER_BYTES` and `OBSERVATION_BYTES`. The live page, the last
seconds of each session and the viewers read the data on their own threads.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from vlagents_ray.images.codecs import JPEG
from vlagents_ray.protocol.messages import Reply
from vlagents_ray.serve.engine.observer import Observer, Observers
from vlagents_ray.serve.requests import PendingRequest
from vlagents_ray_live.commands import CommandBoard

ENCODING_SHARE = 0.04  # the maximum share of a core for encoding pictures
RATE = 10.0  # maximum rate of kept observations per session, Hz
LEASE_S = 2.0  # the time for which data are kept after they were last read
ANSWER_BYTES = 2**25  # maximum size of the kept answers
# Maximum size of the observations: 70 sessions of four unencoded VGA cameras.
OBSERVATION_BYTES = 2**28
VALUES = 64  # maximum number of values of one part of a state, or of one action
ROWS = 128  # maximum number of actions of a chunk
TEXT = 200  # maximum length of a text, characters
SHOWN_OPS = ("act", "reset")
_ACTION = 4096  # maximum number of values of an action that is kept with its observation
_NAMES = 64  # maximum number of cameras and parts of the state of a kept observation
_INFO = 24  # maximum number of entries of an action's info
# Entries of an action's info that are not shown: the page shows them elsewhere, or they are
# internal.
_HIDDEN = ("timing", "policy", "behaviour", "distribution")
_MOST = 2**53  # largest integer that JSON represents exactly
# Estimated size of an answer or an observation without its arrays, files and texts, bytes.
_OBJECTS = 1000
_ENCODING = threading.Lock()
_KEPT_S = 1.0  # the time for which pixels are kept for a reader


class Answer(NamedTuple):
    """The data that are kept for one reply."""

    number: int  # increases with every answer of the replica
    session: str
    op: str  # "act" or "reset"
    priority: str
    timing: Mapping[str, float]  # times in ms by stage; complete when the answer is sent
    error: str = ""  # the code of an error; empty without an error
    detail: str = ""  # the message of an error
    rows: int = 0  # the number of rows of the chunk
    # (rows, D) float32, truncated to `ROWS` and `VALUES`; None without an action.
    action: np.ndarray | None = None
    done: bool = False
    # the numbers and short texts in the policy's info
    info: Mapping[str, Any] = MappingProxyType({})

    @property
    def size(self) -> int:
        """The size of its memory, bytes."""
        arrays = 0 if self.action is None else self.action.nbytes
        values = (self.session, self.detail, *self.info, *self.info.values())
        texts = sum(4 * len(value) for value in values if isinstance(value, str))
        return _OBJECTS + arrays + texts


@dataclass(slots=True)
class KeptObservation:
    """An observation as the policy received it."""

    number: int  # increases with every answer and observation of the replica
    time: float  # time of arrival, s, of `time.monotonic`
    state: dict[str, np.ndarray]  # parts of the state, (D,) float32; the gripper is one of them
    cameras: dict[str, np.ndarray]  # (H, W, 3) uint8 RGB; empty after they are encoded
    # JPEG or PNG files by camera, which the client sent, or which are encoded for the reader.
    files: dict[str, bytes]
    # (D,) float32, the first row of the answer; None before the answer is sent.
    action: np.ndarray | None = None
    counted: int = 0  # the size that the observer's sum includes for this observation, bytes

    @property
    def size(self) -> int:
        """The size of its memory, bytes."""
        arrays = sum(vector.nbytes for vector in self.state.values())
        if self.action is not None:
            arrays += self.action.nbytes
        files = sum(len(file) for file in self.files.values())

        # Several images may share the same memory.
        pixels: dict[int, int] = {}
        for image in self.cameras.values():
            owner, size = _owner(image)
            pixels[id(owner)] = size
        return _OBJECTS + arrays + files + sum(pixels.values())

    def pictures(self) -> dict[str, bytes]:
        """Return the files of all cameras by name, after raw pixels are encoded, which may take
        milliseconds.
        """
        with _ENCODING:  # several readers may call this method at the same time
            for camera, image in self.cameras.items():
                self.files[camera] = JPEG.file(image)
            self.cameras = {}
            return dict(self.files)


class LiveObserver(Observer):
    """Keeps the latest answers and observations of a replica, from `renew` to the end of the
    lease. Thread-safe.

    Args:
        observers: The observers of the replica, to which `renew` adds this one.
        commands: The commands that are sent in the answers.
        clock: Returns the current time, s.
    """

    def __init__(
        self,
        observers: Observers,
        commands: CommandBoard | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._observers = observers
        self._commands = commands
        self._clock = clock
        self._until = float("-inf")  # the end of the lease, s
        self._active = False
        self._numbers = itertools.count(1)
        self._answers: deque[Answer] = deque()
        self._observations: dict[str, KeptObservation] = {}  # the answers by session, oldest first
        self._answer_bytes = 0
        self._observation_bytes = 0
        self._lock = threading.Lock()

    def renew(self, lease_s: float = LEASE_S) -> None:
        """Keep data for `lease_s` more seconds."""
        self._until = max(self._until, self._clock() + lease_s)
        if not self._active:
            self._active = True
            self._observers.add(self)

    def expire(self) -> None:
        """Drop all data after the end of the lease, and pixels that were not read; called every
        half second.
        """
        if self._active and self._clock() >= self._until:
            self.close()
        with self._lock:
            if not self._active:
                self._answers.clear()
                self._observations.clear()
                self._answer_bytes = 0

            self._observation_bytes = 0
            for observation in self._observations.values():
                if observation.time < self._clock() - _KEPT_S:
                    observation.cameras = {}
                observation.counted = observation.size  # pictures may have been encoded
                self._observation_bytes += observation.counted

    def close(self) -> None:
        """End the lease."""
        self._active = False
        self._observers.remove(self)

    def on_request(self, pending: PendingRequest) -> None:
        """Keep the request's observation, and read the outcomes of commands."""
        pending.observer_data[self] = self._keep(pending)
        if self._commands is not None:
            self._commands.read_outcomes(pending.session_id, pending.request)

    def before_answer(self, pending: PendingRequest, reply: Reply) -> None:
        """Add a command for the session's robot to the answer."""
        if self._commands is not None:
            self._commands.send(pending.session_id, reply)

    def on_answer(self, pending: PendingRequest, reply: Reply) -> None:
        """Add the answer to its session's observation."""
        observation = pending.observer_data.pop(self, None)
        if observation is not None and reply.act is not None:
            row = reply.act.rows()[0]
            if row.size <= _ACTION:
                observation.action = np.array(row)

        answer = _answer(next(self._numbers), pending, reply)
        with self._lock:
            self._answers.append(answer)
            self._answer_bytes += answer.size
            while self._answer_bytes > ANSWER_BYTES:
                self._answer_bytes -= self._answers.popleft().size

    def answers(self, since: int) -> list[Answer]:
        """Return the answers with numbers above `since`, oldest first."""
        with self._lock:
            answers = self._answers.copy()

        newest_first: list[Answer] = []
        for answer in reversed(answers):
            if answer.number <= since:
                break
            newest_first.append(answer)
        return newest_first[::-1]

    def observation(self, session: str) -> KeptObservation | None:
        """Return the session's latest kept observation, or None."""
        return self._observations.get(session)

    def forget_others(self, sessions: Collection[str]) -> None:
        """Drop the data of all other sessions, which have ended."""
        with self._lock:
            for session in self._observations.keys() - set(sessions):
                self._observation_bytes -= self._observations.pop(session).counted

    def _keep(self, pending: PendingRequest) -> KeptObservation | None:
        """Keep a request's observation, unless one was kept just before."""
        session = pending.session_id
        obs = pending.request.obs
        now = self._clock()
        last = self._observations.get(session)
        if obs is None or (last is not None and now - last.time < 1 / RATE):
            return None
        names = (*obs.state, *obs.cameras)
        if len(names) > _NAMES or any(len(name) > TEXT for name in names):
            return None

        state = {name: np.array(vector) for name, vector in obs.state.items()}
        if obs.gripper is not None:
            state["gripper"] = np.array([obs.gripper], np.float32)

        # The client may have sent some images as files.
        sent_files = pending.files or {}
        files: dict[str, bytes] = {}
        cameras: dict[str, np.ndarray] = {}
        for name, image in obs.cameras.items():
            if id(image) in sent_files:
                files[name] = bytes(sent_files[id(image)][1])
            else:
                cameras[name] = image

        observation = KeptObservation(next(self._numbers), now, state, cameras, files)
        observation.counted = observation.size
        with self._lock:
            replaced = self._observations.pop(session, None)
            if replaced is not None:
                self._observation_bytes -= replaced.counted
            self._observations[session] = observation
            self._observation_bytes += observation.counted

            while self._observation_bytes > OBSERVATION_BYTES:
                oldest = self._observations.pop(next(iter(self._observations)))
                self._observation_bytes -= oldest.counted
        return observation


def _answer(number: int, pending: PendingRequest, reply: Reply) -> Answer:
    """Return the data of a reply that are kept."""
    answer = Answer(
        number=number,
        session=pending.session_id,
        op=pending.request.op,
        priority=pending.priority.name.lower(),
        timing=reply.timing,
    )
    if reply.error is not None:
        return answer._replace(error=reply.error.code, detail=str(reply.error)[:TEXT])

    act = reply.act
    if act is None:
        return answer
    rows = act.rows()
    action = np.array(rows[:ROWS, :VALUES], np.float32)
    return answer._replace(rows=len(rows), action=action, done=bool(act.done), info=_info(act.info))


def _info(info: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of an action's info that are numbers or texts; texts are truncated."""
    entries: list[tuple[str, Any]] = []
    for name, value in info.items():
        if name in _HIDDEN:
            continue
        if len(entries) == _INFO:
            break

        plain = value.item() if isinstance(value, np.generic) else value
        if isinstance(plain, str):
            entries.append((name[:TEXT], plain[:TEXT]))
        elif isinstance(plain, float) or (isinstance(plain, int) and -_MOST <= plain <= _MOST):
            entries.append((name[:TEXT], plain))
    return dict(entries)


def _owner(image: np.ndarray) -> tuple[object, int]:
    """Return the object whose memory an image keeps alive, and its size in bytes: a small image may
    be part of a large message.

    If a client shares the memory, only the image itself counts, as the client keeps the memory in
    any case.
    """
    owner: Any = image
    while True:
        attribute = "base" if isinstance(owner, np.ndarray) else "obj"
        inner_owner = getattr(owner, attribute, None)
        if inner_owner is None:
            break
        owner = inner_owner
    size = len(owner) if isinstance(owner, (bytes, bytearray)) else getattr(owner, "nbytes", 0)
    return owner, max(size, image.nbytes)
