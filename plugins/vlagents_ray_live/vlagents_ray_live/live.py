"""The latest answers and observations of a replica's sessions, kept only while a reader renews its
lease.

Clients determine the data, so all of it is bounded in bytes: answers keep numbers and short texts;
observations are the latest of each session, at most `RATE` per second; and of both, the oldest are
dropped beyond `ANSWER_BYTES` and `OBSERVATION_BYTES`. The live page, the last seconds of each
session and the viewers read the data on their own threads.
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

ENCODING_SHARE = 0.04  # share of a core for encoding pictures
RATE = 10.0  # maximum rate of kept observations per session, Hz
LEASE_S = 2.0  # time after the last reading for which data are kept
ANSWER_BYTES = 2**25  # maximum size of the kept answers
# Maximum size of the observations: 70 sessions of four unencoded VGA cameras.
OBSERVATION_BYTES = 2**28
VALUES = 64  # maximum number of values of one part of a state, or of one action
ROWS = 128  # maximum number of actions of a chunk
TEXT = 200  # maximum length of a text
SHOWN_OPS = ("act", "reset")
_ACTION = 4096  # maximum number of values of an action that is kept with its observation
_PARTS = 64  # maximum number of cameras, and of parts of the state, of a kept observation
_INFO = 24  # maximum number of entries of an act's info
# Entries of an act's info: shown elsewhere, or internal.
_OWN = ("timing", "policy", "behaviour", "distribution")
_MOST = 2**53  # largest integer that JSON represents exactly
# Estimated size of an answer or an observation besides its arrays, files and texts, bytes.
_OBJECTS = 1000
_ENCODING = threading.Lock()
_KEPT_S = 1.0  # time for which pixels are kept for a reader


class Answer(NamedTuple):
    """The kept data of one answer."""

    number: int  # increases with every answer of the replica
    session: str
    op: str
    priority: str
    timing: Mapping[str, float]  # ms by stage; completed when the answer was sent
    error: str = ""  # error code; empty without an error
    detail: str = ""
    rows: int = 0  # number of rows of the chunk
    # (rows, D) float32, truncated to `ROWS` and `VALUES`; None without an act.
    action: np.ndarray | None = None
    done: bool = False
    # The numbers and short texts in the policy's info.
    info: Mapping[str, Any] = MappingProxyType({})

    @property
    def size(self) -> int:
        """The size of its memory, bytes."""
        arrays = 0 if self.action is None else self.action.nbytes
        texts = (self.session, self.detail, *self.info, *self.info.values())
        return _OBJECTS + arrays + sum(4 * len(text) for text in texts if isinstance(text, str))


@dataclass(slots=True)
class KeptObservation:
    """An observation as received by the policy."""

    number: int
    time: float  # s, of `time.monotonic`
    state: dict[str, np.ndarray]  # (D,) float32, with the gripper as a part
    cameras: dict[str, np.ndarray]  # (H, W, 3) uint8 RGB; empty after they are encoded
    # JPEG or PNG files by camera: those of the client, or those encoded for the reader.
    files: dict[str, bytes]
    # (D,) float32, the first row of its answer, after that was sent.
    action: np.ndarray | None = None
    counted: int = 0  # size that is included in the observer's sum, bytes

    @property
    def size(self) -> int:
        """The size of its memory, bytes."""
        arrays = sum(part.nbytes for part in self.state.values()) + (
            0 if self.action is None else self.action.nbytes
        )
        pixels = {id(owner): size for owner, size in map(_owner, self.cameras.values())}
        return (
            _OBJECTS
            + arrays
            + sum(pixels.values())
            + sum(len(file) for file in self.files.values())
        )

    def pictures(self) -> dict[str, bytes]:
        """Return the files of all cameras; raw pixels are encoded first, which may take
        milliseconds.
        """
        with _ENCODING:  # there may be several readers
            for camera, image in self.cameras.items():
                self.files[camera] = JPEG.file(image)
            self.cameras = {}
            return dict(self.files)


class LiveObserver(Observer):
    """Keeps the latest answers and observations of a replica, from `renew` to the end of the
    lease. Thread-safe.
    """

    def __init__(
        self,
        observers: Observers,
        commands: CommandBoard | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Create an inactive observer, which `renew` adds to `observers`; `commands` are sent in
        the answers.
        """
        self._observers, self._commands, self._clock = observers, commands, clock
        self._until = float("-inf")  # end of the lease, s
        self._active = False
        self._numbers = itertools.count(1)
        self._answers: deque[Answer] = deque()
        self._observations: dict[str, KeptObservation] = {}  # by session, oldest first
        self._answer_bytes = self._observation_bytes = 0
        self._lock = threading.Lock()

    def renew(self, lease_s: float = LEASE_S) -> None:
        """Keep recording for `lease_s` more seconds."""
        self._until = max(self._until, self._clock() + lease_s)
        if not self._active:
            self._active = True
            self._observers.add(self)

    def expire(self) -> None:
        """Drop all data after the last lease, and pixels that were not read; called every half
        second.
        """
        if self._active and self._clock() >= self._until:
            self.close()
        with self._lock:
            if not self._active:
                self._answers.clear()
                self._observations.clear()
                self._answer_bytes = 0
            for kept in self._observations.values():
                if kept.time < self._clock() - _KEPT_S:
                    kept.cameras = {}
                kept.counted = kept.size  # the pictures have been encoded
            self._observation_bytes = sum(kept.counted for kept in self._observations.values())

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
        """Add a command to the session's robot."""
        if self._commands is not None:
            self._commands.send(pending.session_id, reply)

    def on_answer(self, pending: PendingRequest, reply: Reply) -> None:
        """Add the answer to its session's observation."""
        observation = pending.observer_data.pop(self, None)
        if (
            observation is not None
            and reply.act is not None
            and (row := reply.act.rows()[0]).size <= _ACTION
        ):
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
            held = self._answers.copy()
        return list(itertools.takewhile(lambda one: one.number > since, reversed(held)))[::-1]

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
        session, obs, now = pending.session_id, pending.request.obs, self._clock()
        before = self._observations.get(session)
        if obs is None or (before is not None and now - before.time < 1 / RATE):
            return None
        names = (*obs.state, *obs.cameras)
        if len(names) > _PARTS or any(len(name) > TEXT for name in names):
            return None
        state = {name: np.array(part) for name, part in obs.state.items()}
        if obs.gripper is not None:
            state["gripper"] = np.array([obs.gripper], np.float32)
        files = pending.files or {}
        sent = {
            name: bytes(files[id(image)][1])
            for name, image in obs.cameras.items()
            if id(image) in files
        }
        cameras = {name: image for name, image in obs.cameras.items() if name not in sent}
        kept = KeptObservation(next(self._numbers), now, state, cameras, sent)
        kept.counted = kept.size
        with self._lock:
            if (old := self._observations.pop(session, None)) is not None:
                self._observation_bytes -= old.counted
            self._observations[session] = kept
            self._observation_bytes += kept.counted
            while self._observation_bytes > OBSERVATION_BYTES:
                self._observation_bytes -= self._observations.pop(
                    next(iter(self._observations))
                ).counted
        return kept


def _answer(number: int, pending: PendingRequest, reply: Reply) -> Answer:
    request, act, error = pending.request, reply.act, reply.error
    answer = Answer(
        number, pending.session_id, request.op, pending.priority.name.lower(), reply.timing
    )
    if error is not None:
        return answer._replace(error=error.code, detail=str(error)[:TEXT])
    if act is None:
        return answer
    rows = act.rows()
    kept = np.array(rows[:ROWS, :VALUES], np.float32)
    return answer._replace(rows=len(rows), action=kept, done=bool(act.done), info=_info(act.info))


def _info(info: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of an act's info that are numbers or texts; texts are truncated."""
    stated = ((name[:TEXT], value) for name, value in info.items() if name not in _OWN)
    plain = (
        (name, value.item() if isinstance(value, np.generic) else value) for name, value in stated
    )
    shown = (
        (name, value[:TEXT] if isinstance(value, str) else value)
        for name, value in plain
        if isinstance(value, (str, float)) or (isinstance(value, int) and -_MOST <= value <= _MOST)
    )
    return dict(itertools.islice(shown, _INFO))


def _owner(image: np.ndarray) -> tuple[object, int]:
    """Return the object whose memory an image keeps alive, and its size: a small image may be part
    of a large message.

    Of memory shared by a client only the image itself counts, as the rest belongs to the client in
    any case.
    """
    owner: Any = image
    while (
        further := getattr(owner, "base" if isinstance(owner, np.ndarray) else "obj", None)
    ) is not None:
        owner = further
    size = len(owner) if isinstance(owner, (bytes, bytearray)) else getattr(owner, "nbytes", 0)
    return owner, max(size, image.nbytes)
