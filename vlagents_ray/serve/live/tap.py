"""What the sessions of a replica do, kept for viewers while one looks, and only then.

The tap is one of `Engine.watchers` while a viewer looks; otherwise a message costs one comparison. While somebody
looks, the thread that handles a message stores references; `vlagents_ray.serve.live.snapshot` reads them on another. An
observation is stored at most `RATE` times a second for each session, and until it is read: it may lie in memory that
its client wants back.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vlagents_ray.chunking.execution import PLAYED, WATCHED
from vlagents_ray.images.codecs import JPEG, DecodedFiles
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.responses import Done
from vlagents_ray.serve.live.commands import CommandBoard

ENCODING_SHARE = 0.04  # of a core, for encoding pictures
RATE = 10.0  # observations a second and session that are kept
LEASE_S = 2.0  # time after the last reading at which nobody looks any more
_ANSWERS = 4096  # most answers that are kept
VALUES = 64  # most numbers of one part of a state, or of one action
ROWS = 128  # most actions of a chunk, or executed before a request
_SAID = ("step", "age_ms", "safe", "safe_ticks", "safe_spells", "late", "reconnects")
_ENCODING = threading.Lock()
_TELL_S = 2.0  # interval at which a session is told that it is watched
_KEPT_S = 1.0  # time for which the pictures of an observation are kept if nobody reads them


@dataclass(frozen=True, slots=True)
class Played:
    """What a client states of the actions that it executed: `vlagents_ray.chunking.execution`."""

    steps: np.ndarray  # (n,) int64, the steps of the rows
    rows: np.ndarray  # (n, D) float32
    said: dict[str, Any]  # `step`, `age_ms`, `safe`, … as far as they are numbers and texts

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
        said = {name: stated[name] for name in _SAID if isinstance(stated.get(name), (int, float, str))}
        return cls(np.array(steps[:ROWS]), np.array(rows[:ROWS, :VALUES]), said)


class Answer(NamedTuple):
    """The answer to one request."""

    number: int  # increases with every answer of the replica
    session: str
    op: str
    rank: str
    reply: Reply
    played: Played | None = None  # what the client executed before this request


@dataclass(slots=True)
class Seen:
    """An observation as the policy got it."""

    number: int
    time: float  # s, of `time.monotonic`
    state: dict[str, np.ndarray]  # (D,) float32, with the gripper as a part
    cameras: dict[str, np.ndarray]  # (H, W, 3) uint8 RGB; empty once they are encoded
    files: dict[str, bytes]  # JPEG or PNG files by camera: those that the client sent, or encoded by the reader
    reply: Reply | None = None  # its answer, once that was sent

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
        """Create a tap that nobody looks at.

        Args:
            show: Makes the tap the one of the engine, or takes it away (None).
            clock: The time, s.
            commands: What is to be said to the sessions in their answers.
        """
        self._show = show
        self._commands = commands
        self._clock = clock
        self._until = float("-inf")  # end of the lease, s
        self._viewed_until = float("-inf")  # end of that of the last viewer
        self._shown = False
        self._numbers = itertools.count(1)
        self._answers: deque[Answer] = deque(maxlen=_ANSWERS)
        self._seen: dict[str, Seen] = {}
        self._told: dict[str, float] = {}  # when a session was told last that it is watched

    @property
    def watched(self) -> bool:
        """Whether anything reads."""
        return self._clock() < self._until

    def renew(self, lease_s: float = LEASE_S, *, viewer: bool = False) -> None:
        """Keep what happens for `lease_s` more.

        Args:
            lease_s: The time, s.
            viewer: Whether a person looks, who is to see what the players execute; a recording does without.
        """
        until = self._clock() + lease_s
        self._until = max(self._until, until)
        if viewer:
            self._viewed_until = until
        if not self._shown:
            self._shown = True
            self._show(self)

    def expire(self) -> None:
        """Drop everything if nobody looks any more, and pictures that nobody reads; called every half second."""
        if self.watched:
            oldest = self._clock() - _KEPT_S
            for seen in list(self._seen.values()):
                if seen.time < oldest:
                    seen.cameras = {}
        elif self._shown:
            self._shown = False
            self._show(None)
            self._answers.clear()
            self._seen.clear()
            self._told.clear()

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
                if seen is not None:
                    seen.reply = reply
                self._answers.append(Answer(next(self._numbers), session, op, rank, reply, played))

        return answer

    def answers(self, since: int) -> list[Answer]:
        """Return the answers with numbers above `since`, oldest first."""
        newest_first = itertools.takewhile(lambda one: one.number > since, reversed(self._answers.copy()))
        return list(newest_first)[::-1]

    def seen(self, session: str) -> Seen | None:
        """Return the session's latest observation that was kept; None if there is none."""
        return self._seen.get(session)

    def forget_others(self, sessions: Collection[str]) -> None:
        """Drop the observations of all sessions but these, since those have ended."""
        for held in (self._seen, self._told):
            for session in held.keys() - set(sessions):
                held.pop(session, None)

    def _tell(self, session: str, reply: Reply) -> None:
        """Say from time to time that a viewer looks, so that a chunk player states what it executed."""
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
        state = {name: np.array(part) for name, part in obs.state.items()}
        if obs.gripper is not None:
            state["gripper"] = np.array([obs.gripper], np.float32)
        sent = {name: bytes(files[id(image)][1]) for name, image in obs.cameras.items() if id(image) in files}
        cameras = {name: image for name, image in obs.cameras.items() if name not in sent}
        seen = self._seen[session] = Seen(next(self._numbers), now, state, cameras, sent)
        return seen
