"""A watcher that records what sessions ask and get, while other threads copy, encode and write it.

The thread that handles a message only puts references into a queue. A second thread copies the observations, since they
may lie in memory that their client wants back, and a third one encodes and writes. If these fall behind, or the disk is
full, frames are dropped and counted; no answer waits for them.
"""

from __future__ import annotations

import logging
import os
import queue
import random
import threading
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from vlagents_ray.errors import PolicyFailed, UnknownSession
from vlagents_ray.images.codecs import DecodedFiles
from vlagents_ray.interface import CAPTURED, POLICY, Obs, copied
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.protocol.values import to_text
from vlagents_ray.serve.engine.metrics_buffer import STAGES
from vlagents_ray.serve.engine.responses import Done
from vlagents_ray.serve.recording.episodes import EpisodeWriter, RecordedAct, RecordingEnded

logger = logging.getLogger(__name__)

NO_VERSION = -1  # of an answer whose policy names no version of its weights
_HELD_BYTES = 256 * 2**20  # most bytes of observations that wait to be written
_OTHER_BYTES = 16 * 2**10  # counted for an act beside its pictures and the bytes in its `info`
_CLOSING_S = 30.0  # time that the threads get to write what waits
_NICE = 5  # the threads run after the policy's
_LOOK_S = 1.0  # time after which ended sessions are looked up


class _Asked:
    """A request that is to be recorded; its memory counts as held until nothing refers to it."""

    __slots__ = ("_recorder", "at", "info", "instruction", "obs", "op", "options", "session", "size")

    def __init__(self, recorder: SessionRecorder, session: str, request: Request, obs: Obs | None, size: int) -> None:
        self._recorder = recorder
        self.session, self.op, self.at, self.size = session, request.op, time.time(), size
        self.obs = obs
        self.instruction = request.instruction or ""
        self.options: Any = request.kwargs  # before the queue removes some of them; text once it is `own`
        self.info = ""  # the observation's, as text

    def own(self) -> None:
        """Copy what may lie in the client's memory."""
        self.options = to_text(self.options) if self.op == "reset" else ""
        if (obs := self.obs) is not None:
            info = dict(obs.info)
            captured = info.pop(CAPTURED, None)
            self.info = to_text(info) if info else ""
            captured_at = float(captured) if isinstance(captured, (int, float)) else self.at
            self.obs = copied(replace(obs, info={CAPTURED: captured_at}, prepared=None))
        texts = len(self.options) + len(self.info)
        self.size += texts
        self._recorder._held_more(texts)

    def __del__(self) -> None:
        self._recorder._held_more(-self.size)


class _Answered(NamedTuple):
    asked: list[_Asked | None]
    replies: list[Reply]


class _Held(NamedTuple):
    """The sessions that the replica has, after all that was put into the queue before."""

    sessions: frozenset[str]


class SessionRecorder:
    """A watcher of one replica, which records a share of its sessions until `close`."""

    def __init__(
        self,
        writer: EpisodeWriter,
        sessions: Callable[[], Collection[str]],
        find: Callable[[str], tuple[str, int]],
        *,
        share: float = 1.0,
        held_bytes: int = _HELD_BYTES,
    ) -> None:
        """Create a recorder, and start its threads.

        Args:
            writer: Writes the episodes.
            sessions: Returns the ids of the replica's sessions.
            find: Returns the instruction and the first step of a session; raises `VLAgentsError` if it has gone.
            share: The share of the episodes that are recorded, drawn at each reset.
            held_bytes: The most bytes of requests that wait.
        """
        self.dropped = 0  # acts for which there was no memory, or which came in an episode that could not be written
        self.ended: str | None = None  # why nothing more is recorded
        self._writer = writer
        self._sessions = sessions
        self._find = find
        self._share = share
        self._held_bytes = held_bytes
        self._held = 0
        self._lock = threading.RLock()  # of `_held`, which the garbage collector may lower at any time
        self._looked = float("-inf")  # time at which ended sessions were looked up, s
        self._missing: set[str] = set()  # sessions in `_first` that were not here when they were looked up
        self._first: dict[str, int | None] = {}  # step at the reset of each session; None if it is not recorded
        self._inbox: queue.SimpleQueue[list[_Asked | None] | _Answered | _Held | None] = queue.SimpleQueue()
        self._ready: queue.SimpleQueue[tuple[_Asked, Reply] | _Held | None] = queue.SimpleQueue()
        self._threads = [
            threading.Thread(target=run, name=name, daemon=True)
            for run, name in ((self._copy, "record-copy"), (self._write, "record-write"))
        ]
        for thread in self._threads:
            thread.start()

    @property
    def saved(self) -> int:
        """The number of frames in complete episodes."""
        return self._writer.saved

    @property
    def lost(self) -> int:
        """The number of acts that are missing in the recording."""
        return self.dropped + self._writer.lost

    def note(self, sessions: Sequence[str], items: Sequence[Request | Reply], files: DecodedFiles, done: Done) -> Done:
        """See `vlagents_ray.serve.engine.responses.Watcher`."""
        if self.ended is not None:
            return done
        asked = [self._asked(session, item) for session, item in zip(sessions, items, strict=True)]
        if not any(asked):
            return done
        self._inbox.put(asked)

        def answer(replies: list[Reply]) -> None:
            done(replies)
            self._inbox.put(_Answered(asked, replies))

        return answer

    def close(self) -> None:
        """Write what waits, and complete all episodes, as far as the disk is fast enough."""
        self._inbox.put(None)
        until = time.monotonic() + _CLOSING_S
        for thread in self._threads:
            thread.join(max(0.0, until - time.monotonic()))

    def _asked(self, session: str, item: Request | Reply) -> _Asked | None:
        """Return what is to be recorded of a request; None if there is nothing, or no memory for it."""
        if isinstance(item, Reply) or item.op not in ("act", "reset", "close"):
            return None
        if item.op != "act" or item.obs is None:
            return _Asked(self, session, item, None, 0)
        size = _OTHER_BYTES + sum(image.nbytes for image in item.obs.cameras.values()) + _bytes_in(item.obs.info)
        if not self._hold(size):
            self.dropped += 1
            return None
        return _Asked(self, session, item, item.obs, size)

    def _hold(self, size: int) -> bool:
        with self._lock:
            if self._held + size > self._held_bytes:
                return False
            self._held += size
            return True

    def _held_more(self, size: int) -> None:
        with self._lock:
            self._held += size

    def _copy(self) -> None:
        """Copy each request as it comes, and pass it on with its answer."""
        _be_nice()
        while self._copy_next(self._inbox.get()):
            pass
        self._ready.put(None)

    def _copy_next(self, item: list[_Asked | None] | _Answered | _Held | None) -> bool:
        if item is None:
            return False
        if isinstance(item, _Held):
            self._ready.put(item)
        elif isinstance(item, _Answered):
            for asked, reply in zip(item.asked, item.replies, strict=True):
                if asked is not None and reply.error is None:
                    self._ready.put((asked, reply))
        else:
            for asked in filter(None, item):
                try:
                    asked.own()
                except Exception as error:  # noqa: BLE001 - of this request alone
                    logger.warning("recording: an act of session %s is left out: %s", asked.session, error)
                    self.dropped += 1
                    asked.obs, asked.options = None, ""
        return True

    def _write(self) -> None:
        _be_nice()
        while self._write_next():
            pass
        if self.ended is None:
            self._writer.close()

    def _write_next(self) -> bool:
        """Write the next act, and return whether others follow."""
        item: tuple[_Asked, Reply] | _Held | None = None
        try:
            item = self._ready.get(timeout=_LOOK_S)
            if item is None:
                return False
        except queue.Empty:
            pass
        if time.monotonic() - self._looked > _LOOK_S:
            self._looked = time.monotonic()
            self._inbox.put(_Held(frozenset(self._sessions())))
        if self.ended is not None or item is None:
            return True
        try:
            if isinstance(item, _Held):
                self._end_others(item.sessions)
            else:
                self._handle(*item)
        except (OSError, RecordingEnded) as error:
            self._end(error)
        return True

    def _handle(self, asked: _Asked, reply: Reply) -> None:
        session, op = asked.session, asked.op
        try:
            if op == "reset":
                self._first[session] = reply.step if random.random() < self._share else None
                if self._first[session] is None:
                    self._writer.end(session)
                else:
                    weights = to_text(reply.identity) if reply.identity else ""
                    self._writer.begin(session, asked.instruction, asked.options, weights)
            elif op == "close":
                self._first.pop(session, None)
                self._writer.end(session)
            elif asked.obs is not None and self._records(session):
                if session in self._writer:
                    self._writer.add(session, _frame(asked, reply, self._first[session] or 0))
                else:  # too many sessions at once
                    self.dropped += 1
        except (OSError, RecordingEnded):
            raise
        except UnknownSession:  # it has ended meanwhile, as has its episode
            self.dropped += 1
        except Exception as error:  # noqa: BLE001 - one session's episode
            logger.warning("recording: the episode of session %s is lost: %s", session, error)
            self._first[session] = None
            self._writer.drop(session)

    def _records(self, session: str) -> bool:
        """Return whether the session is recorded; one that came from another replica is drawn here."""
        if session not in self._first:
            self._first[session] = None
            if random.random() < self._share:
                instruction, first = self._find(session)
                self._first[session] = first
                self._writer.begin(session, instruction, "", "")
        return self._first[session] is not None

    def _end_others(self, held: Collection[str]) -> None:
        """End the episodes of sessions that are no longer here; new ones may be missing once."""
        missing = self._first.keys() - held
        for session in missing & self._missing:
            del self._first[session]
            self._writer.end(session)
        self._missing = missing

    def _end(self, error: Exception) -> None:
        """End the recording, but no session."""
        self.ended = str(error)
        logger.error("recording has ended, and the sessions go on: %s", error)
        self._writer.close()


def _frame(asked: _Asked, reply: Reply, first: int) -> RecordedAct:
    act, obs = reply.act, asked.obs
    if act is None or obs is None:
        raise PolicyFailed("the answer has no action")
    info = {key: value for key, value in act.info.items() if key != "timing"}
    version = info.get(POLICY) or {}
    columns: dict[str, Any] = {
        "received_at": asked.at,
        **{f"{name}_ms": float(reply.timing.get(f"{name}_ms", 0.0)) for name in (*STAGES, "total")},
        "batch_size": int(reply.timing.get("batch_size", 1)),
        "policy_version": int(version.get("version", NO_VERSION)),
        "policy_done": bool(act.done),
        "request": asked.info,
        "answer": to_text(info) if info else "",
    }
    return RecordedAct(obs, act.rows(), float(obs.info[CAPTURED]), (reply.step or 0) - first - 1, columns)


def _bytes_in(value: Any) -> int:
    """Return about how many bytes the texts and arrays in a value take."""
    if isinstance(value, dict):
        return sum(map(_bytes_in, value.values()))
    if isinstance(value, list):
        return sum(map(_bytes_in, value))
    return len(value) if isinstance(value, (str, bytes)) else int(getattr(value, "nbytes", 8))


def _be_nice() -> None:
    try:
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
    except OSError:
        return
