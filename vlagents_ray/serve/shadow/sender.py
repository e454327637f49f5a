"""The side of the live policy: what the candidate is to act on, sent by threads that no request waits for.

The thread that handles a message of a chosen session puts references into a queue, and does nothing else. A thread of
the sender encodes the observation at once, as it may lie in memory that its client wants back. When the live policy has
answered, another thread sends both to the candidate, one call at a time. While the candidate is behind, observations
are dropped and counted: at most `PER_SESSION` of a session wait, and `room` in all.
"""

from __future__ import annotations

import hashlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial
from queue import SimpleQueue
from typing import NamedTuple

from vlagents_ray.images.codecs import DecodedFiles
from vlagents_ray.interface import POLICY, Act, Obs
from vlagents_ray.protocol.frames import encode_request
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.responses import Done

logger = logging.getLogger(__name__)

PER_SESSION = 4  # most requests of a session that wait for the candidate
_CALL_BYTES = 16 * 2**20  # of the requests in one call, unless one alone has more
_FORGET_S = 5.0  # interval at which the sessions that have ended are forgotten


class Turn(NamedTuple):
    """A request on which the live policy has acted, and its reply."""

    session: str  # as the engine names it
    frame: bytes  # of the request
    reply: Reply  # without the parts of the info that only the client needs
    dropped: int  # observations of the episode before this one that the candidate has not got


class _Followed:
    """An episode that the candidate follows."""

    __slots__ = ("dropped", "lost", "waiting")

    def __init__(self) -> None:
        self.waiting = 0  # requests that wait for the candidate, or are with it
        self.dropped = 0  # observations
        self.lost = False  # whether the candidate does not know the episode, so that the rest of it is dropped


@dataclass(slots=True)
class _Entry:
    """A request of an episode that is followed."""

    session: str
    episode: _Followed
    request: Request
    obs: Obs | None  # of the request, which loses it when the policy has acted
    dropped: int = 0  # observations of the episode before this one
    frame: bytes = b""
    reply: Reply | None = None

    def encode(self) -> None:
        """Make the frame for the candidate, without what only the server of the live policy needs."""
        request = self.request
        own = Request(
            request.op,
            self.obs,
            request.instruction,
            request.kwargs if request.op == "reset" else {},
            history=request.history,
            session=self.session,
            rank=request.rank,
        )
        self.frame, self.obs = encode_request(own), None

    def turn(self) -> Turn:
        """Return what the candidate gets."""
        reply = self.reply or Reply()
        act = reply.act
        if act is not None:
            act = Act(act.action, act.done, {name: act.info[name] for name in (POLICY,) if name in act.info})
        about = Reply(act=act, info=None if act else reply.identity, step=reply.step, timing=dict(reply.timing))
        return Turn(self.session, self.frame, about, self.dropped)


Ask = Callable[[Sequence[Turn]], Collection[str]]
"""Sends turns of different sessions, and returns the sessions that the candidate does not know."""


class ShadowSender:
    """Sends what the live policy acts on in a share of its sessions. A `Watcher` of the engine's messages."""

    def __init__(
        self,
        ask: Ask,
        share: float,
        room: int,
        is_open: Callable[[str], bool],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Create a sender; `start` begins.

        Args:
            ask: Asks the candidate, on a thread of the sender; it may block, and may raise anything.
            share: Share of the sessions, in (0, 1].
            room: Most requests that wait for the candidate.
            is_open: Whether the live policy still has a session.
            clock: The time, s.
        """
        self._ask = ask
        self._share = share
        self._room = room
        self._is_open = is_open
        self._clock = clock
        self._episodes: dict[str, _Followed] = {}  # by session
        self._waiting: deque[_Entry] = deque()
        self._asked: list[_Entry] = []  # those with the candidate now
        self._held = 0  # requests that wait, or are with the candidate
        self._lock = threading.Lock()  # of the number of drops
        self._dropped = 0
        self._next_forget = clock()
        self._inbox: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._outbox: SimpleQueue[Sequence[Turn] | None] = SimpleQueue()
        self._threads = [
            threading.Thread(target=self._work, name="shadow", daemon=True),
            threading.Thread(target=self._call, name="shadow-call", daemon=True),
        ]

    def start(self) -> None:
        """Start the threads."""
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End the threads; one that waits for the candidate ends when that answers, or with the process."""
        self._inbox.put(None)
        self._outbox.put(None)
        self._threads[0].join()

    @property
    def dropped(self) -> int:
        """Number of observations so far that the candidate was to get, and did not."""
        return self._dropped

    def note(self, sessions: Sequence[str], items: Sequence[Request | Reply], files: DecodedFiles, done: Done) -> Done:
        """Keep the requests of chosen sessions for the candidate; see `Watcher`."""
        noted: list[tuple[int, _Entry]] = []
        for place, (session, item) in enumerate(zip(sessions, items, strict=True)):
            if isinstance(item, Request) and (episode := self._episode(session, item)) is not None:
                noted.append((place, _Entry(session, episode, item, item.obs, episode.dropped)))
                if item.op == "act":
                    self._inbox.put(noted[-1][1].encode)
        if not noted:
            return done

        def answer(replies: list[Reply]) -> None:
            done(replies)
            for place, entry in noted:
                entry.reply = replies[place]
                if entry.request.op == "reset" and entry.reply.error is None:
                    self._episodes[entry.session] = entry.episode
                self._inbox.put(partial(self._take, entry))

        return answer

    def _episode(self, session: str, request: Request) -> _Followed | None:
        """Return the episode to which a request belongs; None if the candidate does not get the request."""
        if request.op == "reset":
            return _Followed() if chosen(session, self._share) else None
        episode = self._episodes.get(session)
        if episode is None or request.op == "close":
            return episode
        if request.op != "act":
            return None
        if self._full(episode):
            self._drop(episode)
            return None
        return episode

    def _full(self, episode: _Followed) -> bool:
        """Whether an observation of an episode has to be dropped."""
        return episode.lost or episode.waiting >= PER_SESSION or self._held >= self._room

    def _drop(self, episode: _Followed) -> None:
        with self._lock:
            episode.dropped += 1
            self._dropped += 1

    def _work(self) -> None:
        """Run the thread that encodes, and decides what is sent."""
        while (step := self._inbox.get()) is not None:
            try:
                step()
                self._forget_ended()
                self._send()
            except Exception:
                logger.exception("the shadow misses a request")

    def _call(self) -> None:
        """Run the thread that waits for the candidate."""
        while (turns := self._outbox.get()) is not None:
            try:
                result: Collection[str] | Exception = self._ask(turns)
            except Exception as error:  # noqa: BLE001 - whatever fails at the candidate is no failure here
                result = error
            self._inbox.put(partial(self._free, result))

    def _take(self, entry: _Entry) -> None:
        """Keep a request for the candidate, unless the live policy has not acted on it."""
        episode, op = entry.episode, entry.request.op
        if entry.reply is None or entry.reply.error is not None:
            return
        if op == "close":
            self._episodes.pop(entry.session, None)
        elif op == "reset":
            episode.lost = self._held >= self._room
        if op == "act" and self._full(episode):
            self._drop(episode)
        elif not episode.lost:
            if op != "act":  # the engine has removed by now what only it needs
                entry.encode()
            self._keep(entry)

    def _keep(self, entry: _Entry) -> None:
        entry.episode.waiting += 1
        self._held += 1
        self._waiting.append(entry)

    def _free(self, result: Collection[str] | Exception) -> None:
        """Free the room of the requests that the candidate had; with an error, it knows none of their episodes."""
        failed = isinstance(result, Exception)
        if failed:
            logger.warning("the candidate does not answer: %s", result)
        for entry in self._asked:
            self._held -= 1
            entry.episode.waiting -= 1
            entry.episode.lost |= failed or entry.session in result  # type: ignore[operator]
            if failed and entry.request.op == "act":
                self._drop(entry.episode)
        self._asked = []

    def _forget_ended(self) -> None:
        """Close the episodes of sessions that the live policy no longer has, as those of closed connections."""
        if self._clock() < self._next_forget:
            return
        self._next_forget = self._clock() + _FORGET_S
        for session in [session for session in list(self._episodes) if not self._is_open(session)]:
            entry = _Entry(session, self._episodes.pop(session), Request("close"), None, reply=Reply())
            entry.encode()
            self._keep(entry)

    def _send(self) -> None:
        """Send the next requests, one of each session, unless the candidate is busy."""
        if self._asked:
            return
        size, seen, left = 0, set(), deque[_Entry]()
        for entry in self._waiting:
            if entry.episode.lost and entry.request.op == "act":
                self._held -= 1
                entry.episode.waiting -= 1
                self._drop(entry.episode)
                continue
            if entry.session in seen or (self._asked and size + len(entry.frame) > _CALL_BYTES):
                left.append(entry)
            else:
                size += len(entry.frame)
                self._asked.append(entry)
            seen.add(entry.session)
        self._waiting = left
        if self._asked:
            self._outbox.put([entry.turn() for entry in self._asked])


def chosen(session: str, share: float) -> bool:
    """Whether a session is among the share that the candidate follows; the same on all replicas.

    Args:
        session: The session, as the engine names it.
        share: Share of the sessions, in [0, 1].
    """
    digest = hashlib.blake2b(session.encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big") < share * 2**64
