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
from dataclasses import dataclass, field
from functools import partial

from vlagents_ray.interface import POLICY, Act, Obs
from vlagents_ray.protocol.frames import encode_request
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.observer import Observer
from vlagents_ray.serve.observers.worker import Worker
from vlagents_ray.serve.requests import PendingRequest

logger = logging.getLogger(__name__)

PER_SESSION = 4  # most requests of a session that wait for the candidate
_CALL_BYTES = 16 * 2**20  # of the requests in one call, unless one alone has more
_FORGET_S = 5.0  # interval at which the sessions that have ended are forgotten


@dataclass(slots=True, eq=False)
class _Followed:
    """An episode that the candidate follows."""

    waiting: int = 0  # requests that wait for the candidate, or are with it
    dropped: int = 0  # observations
    lost: bool = False  # whether the candidate does not know the episode, so that the rest of it is dropped


@dataclass(slots=True, eq=False)
class Turn:
    """A request of an episode that is followed, and the reply of the live policy."""

    session: str  # as the engine names it
    episode: _Followed
    request: Request
    obs: Obs | None  # of the request, which loses it when the policy has acted
    dropped: int = 0  # observations of the episode before this one that the candidate has not got
    frame: bytes = b""  # of the request
    reply: Reply = field(default_factory=Reply)

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
        self.frame = encode_request(own)
        self.request, self.obs = Request(request.op), None  # the observation is not needed any more

    def shorten(self) -> None:
        """Drop the parts of the reply that only the client needs; its timing is complete by now."""
        reply, act = self.reply, self.reply.act
        if act is not None:
            act = Act(act.action, act.done, {name: act.info[name] for name in (POLICY,) if name in act.info})
        self.reply = Reply(act=act, info=None if act else reply.identity, step=reply.step, timing=dict(reply.timing))


Ask = Callable[[Sequence[Turn]], Collection[str]]
"""Sends turns of different sessions, and returns the sessions that the candidate does not know."""


class ShadowSender(Observer):
    """Sends what the live policy acts on in a share of its sessions, until `close`."""

    def __init__(
        self,
        ask: Ask,
        share: float,
        room: int,
        is_open: Callable[[str], bool],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Create a sender, and start its threads.

        `ask` is called on one of them, and may block and raise anything. `share` of the sessions, in (0, 1], are sent;
        at most `room` requests wait. `is_open` returns whether the live policy still has a session.
        """
        self._ask = ask
        self._share = share
        self._room = room
        self._is_open = is_open
        self._clock = clock
        self._episodes: dict[str, _Followed] = {}  # by session
        self._waiting: deque[Turn] = deque()
        self._asked: list[Turn] = []  # those with the candidate now
        self._held = 0  # requests that wait, or are with the candidate
        self._lock = threading.Lock()  # of the number of drops
        self.dropped = 0  # observations so far that the candidate was to get, and did not
        self._next_forget = clock()
        self._worker, self._caller = Worker("shadow"), Worker("shadow-call")

    def close(self) -> None:
        """End the threads; one that waits for the candidate ends when that answers, or with the process."""
        self._worker.close()
        self._caller.close(0)

    def on_request(self, pending: PendingRequest) -> None:
        """Keep a request of a chosen session for the candidate."""
        session, request = pending.session_id, pending.request
        if (episode := self._episode(session, request)) is not None:
            turn = pending.kept[self] = Turn(session, episode, request, request.obs, episode.dropped)
            if request.op == "act":
                self._work(turn.encode)

    def on_answer(self, pending: PendingRequest, reply: Reply) -> None:
        """See `Observer`."""
        turn: Turn | None = pending.kept.pop(self, None)
        if turn is None:
            return
        turn.reply = reply
        if turn.request.op == "reset" and reply.error is None:
            self._episodes[turn.session] = turn.episode
        self._work(partial(self._take, turn))

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
            self.dropped += 1

    def _work(self, step: Callable[[], None]) -> None:
        """Make a step on the thread that encodes, which then decides what is sent."""

        def work() -> None:
            step()
            self._forget_ended()
            self._send()

        self._worker.put(work)

    def _call(self, turns: Sequence[Turn]) -> None:
        """Wait for the candidate, on the thread for that."""
        try:
            result: Collection[str] | Exception = self._ask(turns)
        except Exception as error:  # noqa: BLE001 - whatever fails at the candidate is no failure here
            result = error
        self._work(partial(self._free, result))

    def _take(self, turn: Turn) -> None:
        """Keep a request for the candidate, unless the live policy has not acted on it."""
        episode, op = turn.episode, turn.request.op
        if turn.reply.error is not None:
            return
        if op == "close":
            self._episodes.pop(turn.session, None)
        elif op == "reset":
            episode.lost = self._held >= self._room
        if op == "act" and self._full(episode):
            self._drop(episode)
        elif not episode.lost:
            if op != "act":  # the engine has removed by now what only it needs
                turn.encode()
            self._keep(turn)

    def _keep(self, turn: Turn) -> None:
        turn.episode.waiting += 1
        self._held += 1
        self._waiting.append(turn)

    def _free(self, result: Collection[str] | Exception) -> None:
        """Free the room of the requests that the candidate had; with an error, it knows none of their episodes."""
        failed = isinstance(result, Exception)
        if failed:
            logger.warning("the candidate does not answer: %s", result)
        for turn in self._asked:
            self._held -= 1
            turn.episode.waiting -= 1
            turn.episode.lost |= failed or turn.session in result  # type: ignore[operator]
            if failed and turn.request.op == "act":
                self._drop(turn.episode)
        self._asked = []

    def _forget_ended(self) -> None:
        """Close the episodes of sessions that the live policy no longer has, as those of closed connections."""
        if self._clock() < self._next_forget:
            return
        self._next_forget = self._clock() + _FORGET_S
        for session in [session for session in list(self._episodes) if not self._is_open(session)]:
            turn = Turn(session, self._episodes.pop(session), Request("close"), None)
            turn.encode()
            self._keep(turn)

    def _send(self) -> None:
        """Send the next requests, one of each session, unless the candidate is busy."""
        if self._asked:
            return
        size, seen, left = 0, set(), deque[Turn]()
        for turn in self._waiting:
            if turn.episode.lost and turn.request.op == "act":
                self._held -= 1
                turn.episode.waiting -= 1
                self._drop(turn.episode)
                continue
            if turn.session in seen or (self._asked and size + len(turn.frame) > _CALL_BYTES):
                left.append(turn)
            else:
                size += len(turn.frame)
                self._asked.append(turn)
            seen.add(turn.session)
        self._waiting = left
        if self._asked:
            for turn in self._asked:
                turn.shorten()
            self._caller.put(partial(self._call, self._asked))


def chosen(session: str, share: float) -> bool:
    """Whether a session is among the share in [0, 1] that the candidate follows; the same on all replicas."""
    digest = hashlib.blake2b(session.encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big") < share * 2**64
