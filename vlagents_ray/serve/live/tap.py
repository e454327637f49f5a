"""The latest answers and observations of a replica's sessions, kept for viewers while one watches, and only then.

The tap is one of `Engine.watchers` while a viewer watches; otherwise a message costs one comparison. Clients choose
what it is given, so all that it keeps is bounded in bytes: of an answer, numbers and short texts; of observations, the
latest of each session, at most `RATE` times a second; and of both, the oldest are dropped beyond `ANSWER_BYTES` and
`SEEN_BYTES`. `vlagents_ray.serve.live.snapshot` reads them on another thread.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from vlagents_ray.chunking.execution import PLAYED, WATCHED
from vlagents_ray.images.codecs import JPEG, DecodedFiles
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.responses import Done
from vlagents_ray.serve.live.commands import CommandBoard

ENCODING_SHARE = 0.04  # of a core, for encoding pictures
RATE = 10.0  # observations a second and session that are kept
LEASE_S = 2.0  # time after the last reading at which nothing is kept any more
ANSWER_BYTES = 2**25  # most bytes of the answers that are kept
SEEN_BYTES = 2**28  # most bytes of the observations that are kept: 70 sessions of four unencoded VGA cameras
VALUES = 64  # most numbers of one part of a state, or of one action
ROWS = 128  # most actions of a chunk, or executed before a request
TEXT = 200  # most characters of a text
_ACTION = 4096  # an action of more numbers is not kept with its observation
_PARTS = 64  # an observation with more cameras, or parts of its state, is not kept
_INFO = 24  # most entries of an act's info
_OWN = (WATCHED, "timing", "policy", "behaviour", "distribution")  # of an act's info: shown elsewhere, or our own
_SAID = ("step", "age_ms", "safe_ticks", "safe_spells", "late", "reconnects")  # the numbers that a client states
_MOST = 2**53  # largest number that JSON keeps
_OBJECTS = 1000  # bytes of an answer or an observation besides its arrays, files and texts, estimated
_ENCODING = threading.Lock()
_TELL_S = 2.0  # interval at which a client is told that it is watched
_KEPT_S = 1.0  # time for which pixels are kept for a reader


@dataclass(frozen=True, slots=True)
class Played:
    """What a client states of the actions that it executed: `vlagents_ray.chunking.execution`."""

    steps: np.ndarray  # (n,) int64, the steps of the rows
    rows: np.ndarray  # (n, D) float32
    said: dict[str, float | str]  # `step`, `age_ms`, … as far as they are numbers, and the text `safe`

    @classmethod
    def of(cls, request: Request) -> Played | None:
        """Return a copy of what a request states; None if that is nothing, or has another form."""
        stated = None if request.obs is None else request.obs.info.get(PLAYED)
        if not isinstance(stated, dict):
            return None
        steps, rows = stated.get("steps"), stated.get("rows")
        if not isinstance(steps, np.ndarray) or not isinstance(rows, np.ndarray) or rows.ndim != 2:
            return None
        if steps.shape != rows.shape[:1] or steps.dtype.kind not in "iu" or rows.dtype.kind != "f":
            return None
        said: dict[str, float | str] = {name: stated[name] for name in _SAID if _is_number(stated.get(name))}
        if isinstance(safe := stated.get("safe"), str):
            said["safe"] = safe[:TEXT]
        return cls(steps[:ROWS].astype(np.int64), rows[:ROWS, :VALUES].astype(np.float32), said)


class Answer(NamedTuple):
    """What is kept of the answer to one request."""

    number: int  # increases with every answer of the replica
    session: str
    op: str
    rank: str
    timing: Mapping[str, float]  # ms by stage; still completed when the answer was sent
    error: str = ""  # its code; empty if there is none
    detail: str = ""
    rows: int = 0  # of the chunk
    action: np.ndarray | None = None  # (rows, D) float32, as far as `ROWS` and `VALUES` reach; None without an act
    done: bool = False
    info: Mapping[str, Any] = MappingProxyType({})  # the numbers and short texts that the policy says
    played: Played | None = None  # what the client executed before this request

    @property
    def size(self) -> int:
        """The memory that it takes, bytes."""
        arrays = 0 if self.action is None else self.action.nbytes
        if self.played is not None:
            arrays += self.played.steps.nbytes + self.played.rows.nbytes
        texts = (self.session, self.detail, *self.info, *self.info.values())
        return _OBJECTS + arrays + sum(4 * len(text) for text in texts if isinstance(text, str))


@dataclass(slots=True)
class Seen:
    """An observation as the policy got it."""

    number: int
    time: float  # s, of `time.monotonic`
    state: dict[str, np.ndarray]  # (D,) float32, with the gripper as a part
    cameras: dict[str, np.ndarray]  # (H, W, 3) uint8 RGB; empty once they are encoded
    files: dict[str, bytes]  # JPEG or PNG files by camera: those that the client sent, or encoded by the reader
    action: np.ndarray | None = None  # (D,) float32, the first row of its answer, once that was sent
    counted: int = 0  # bytes, in the tap's sum

    @property
    def size(self) -> int:
        """The memory that it takes, bytes."""
        arrays = sum(part.nbytes for part in self.state.values()) + (0 if self.action is None else self.action.nbytes)
        pixels = {id(owner): size for owner, size in map(_owner, self.cameras.values())}
        return _OBJECTS + arrays + sum(pixels.values()) + sum(len(file) for file in self.files.values())

    def pictures(self) -> dict[str, bytes]:
        """Return the files of all cameras; those that came as pixels are encoded now, which may take milliseconds."""
        with _ENCODING:  # several may read
            for camera, image in self.cameras.items():
                self.files[camera] = JPEG.file(image)
            self.cameras = {}
            return dict(self.files)


class LiveTap:
    """The latest answers and observations of a replica. Thread-safe."""

    def __init__(
        self,
        show: Callable[[LiveTap | None], None],
        clock: Callable[[], float] = time.monotonic,
        commands: CommandBoard | None = None,
    ) -> None:
        """Create a tap without a reader.

        Args:
            show: Makes the tap one of the engine's watchers, or takes it away (None).
            clock: The time, s.
            commands: The commands that are sent to the sessions in their answers.
        """
        self._show = show
        self._commands = commands
        self._clock = clock
        self._until = float("-inf")  # end of the lease, s
        self._viewed_until = float("-inf")  # end of that of the last viewer
        self._shown = False
        self._numbers = itertools.count(1)
        self._answers: deque[Answer] = deque()
        self._seen: dict[str, Seen] = {}  # by session, the oldest first
        self._told: dict[str, float] = {}  # when a session was told last that it is watched
        self._answer_bytes = self._seen_bytes = 0
        self._lock = threading.Lock()

    @property
    def watched(self) -> bool:
        """Whether anything reads."""
        return self._clock() < self._until

    def renew(self, lease_s: float = LEASE_S, *, viewer: bool = False) -> None:
        """Keep what happens for `lease_s` more.

        Args:
            lease_s: The time, s.
            viewer: Whether a person watches, who is to see what the players execute; a recording does without.
        """
        until = self._clock() + lease_s
        self._until = max(self._until, until)
        if viewer:
            self._viewed_until = until
        if not self._shown:
            self._shown = True
            self._show(self)

    def expire(self) -> None:
        """Drop everything after the last lease, and pixels that were not read; called every half second."""
        if not self.watched and self._shown:
            self._shown = False
            self._show(None)
            self._told.clear()
        with self._lock:
            if not self._shown:
                self._answers.clear()
                self._seen.clear()
                self._answer_bytes = 0
            for seen in self._seen.values():
                if seen.time < self._clock() - _KEPT_S:
                    seen.cameras = {}
                seen.counted = seen.size  # pictures were encoded meanwhile
            self._seen_bytes = sum(seen.counted for seen in self._seen.values())

    def note(
        self,
        sessions: Sequence[str],
        items: Sequence[Request | Reply],
        files: DecodedFiles,
        done: Done,
    ) -> Done:
        """Keep the observations of a message, and its answers once they are sent.

        Args:
            sessions: The session of each of `items`, as the engine names it.
            items: The requests of the message, and the replies to unreadable ones.
            files: The files of its images.
            done: Sends the answers.

        Returns:
            `done`, which also keeps the answers.
        """
        kinds: list[tuple[str, str, str, Played | None, Seen | None]] = []
        for session, item in zip(sessions, items, strict=True):
            if isinstance(item, Reply):
                kinds.append((session, "unknown", "robot", None, None))
                continue
            kinds.append((session, item.op, item.rank, Played.of(item), self._keep(session, item, files)))
            if self._commands is not None:
                self._commands.note(session, item)

        def answer(replies: list[Reply]) -> None:
            for session, reply in zip(sessions, replies, strict=True):
                self._tell(session, reply)
                if self._commands is not None:
                    self._commands.send(session, reply)
            done(replies)
            for (session, op, rank, played, seen), reply in zip(kinds, replies, strict=True):
                if seen is not None and reply.act is not None and (row := reply.act.rows()[0]).size <= _ACTION:
                    seen.action = np.array(row)
                self._add(_answer(next(self._numbers), session, op, rank, reply, played))

        return answer

    def answers(self, since: int) -> list[Answer]:
        """Return the answers with numbers above `since`, oldest first."""
        with self._lock:
            held = self._answers.copy()
        return list(itertools.takewhile(lambda one: one.number > since, reversed(held)))[::-1]

    def seen(self, session: str) -> Seen | None:
        """Return the session's latest observation that was kept; None if there is none."""
        return self._seen.get(session)

    def forget_others(self, sessions: Collection[str]) -> None:
        """Drop the observations of all sessions but these, since those have ended."""
        for session in self._told.keys() - set(sessions):
            self._told.pop(session, None)
        with self._lock:
            for session in self._seen.keys() - set(sessions):
                self._seen_bytes -= self._seen.pop(session).counted

    def _tell(self, session: str, reply: Reply) -> None:
        """Say from time to time that a viewer watches, so that a chunk player states what it executed."""
        now = self._clock()
        if (
            now < self._viewed_until
            and reply.act is not None
            and now - self._told.get(session, float("-inf")) > _TELL_S
        ):
            self._told[session] = now
            reply.act.info[WATCHED] = True

    def _keep(self, session: str, request: Request, files: DecodedFiles) -> Seen | None:
        """Keep a request's observation, unless one was kept just before."""
        obs, now, before = request.obs, self._clock(), self._seen.get(session)
        if obs is None or (before is not None and now - before.time < 1 / RATE):
            return None
        names = (*obs.state, *obs.cameras)
        if len(names) > _PARTS or any(len(name) > TEXT for name in names):
            return None
        state = {name: np.array(part) for name, part in obs.state.items()}
        if obs.gripper is not None:
            state["gripper"] = np.array([obs.gripper], np.float32)
        sent = {name: bytes(files[id(image)][1]) for name, image in obs.cameras.items() if id(image) in files}
        cameras = {name: image for name, image in obs.cameras.items() if name not in sent}
        seen = Seen(next(self._numbers), now, state, cameras, sent)
        seen.counted = seen.size
        with self._lock:
            if (old := self._seen.pop(session, None)) is not None:
                self._seen_bytes -= old.counted
            self._seen[session] = seen
            self._seen_bytes += seen.counted
            while self._seen_bytes > SEEN_BYTES:
                self._seen_bytes -= self._seen.pop(next(iter(self._seen))).counted
        return seen

    def _add(self, answer: Answer) -> None:
        with self._lock:
            self._answers.append(answer)
            self._answer_bytes += answer.size
            while self._answer_bytes > ANSWER_BYTES:
                self._answer_bytes -= self._answers.popleft().size


def _answer(number: int, session: str, op: str, rank: str, reply: Reply, played: Played | None) -> Answer:
    act, error = reply.act, reply.error
    if error is not None:
        return Answer(number, session, op, rank, reply.timing, error.code, str(error)[:TEXT], played=played)
    if act is None:
        return Answer(number, session, op, rank, reply.timing, played=played)
    rows = act.rows()
    kept = np.array(rows[:ROWS, :VALUES], np.float32)
    return Answer(
        number, session, op, rank, reply.timing, "", "", len(rows), kept, bool(act.done), _info(act.info), played
    )


def _info(info: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of an act's info that are numbers or texts, of those the first characters."""
    kept: dict[str, Any] = {}
    for name, stated in info.items():
        if len(kept) == _INFO:
            break
        if name in _OWN:
            continue
        value = stated.item() if isinstance(stated, np.generic) else stated
        if isinstance(value, str):
            kept[name[:TEXT]] = value[:TEXT]
        elif isinstance(value, float) or _is_number(value) or isinstance(value, bool):
            kept[name[:TEXT]] = value
    return kept


def _is_number(value: object) -> bool:
    """Whether it is a number of bounded size, and no NaN."""
    return type(value) in (int, float) and -_MOST <= value <= _MOST  # type: ignore[operator]


def _owner(image: np.ndarray) -> tuple[object, int]:
    """Return the object whose memory an image keeps, and its bytes: a small image may be a part of a large message.

    Of memory that a client shares only the image itself counts, as the rest is the client's in any case.
    """
    owner: Any = image
    while (further := getattr(owner, "base" if isinstance(owner, np.ndarray) else "obj", None)) is not None:
        owner = further
    size = len(owner) if isinstance(owner, (bytes, bytearray)) else getattr(owner, "nbytes", 0)
    return owner, max(size, image.nbytes)
