"""Moves sessions when a replica stops, or when the load balancer sends a session's request to
another replica.

A replica that gets a request for an unknown session searches the other replicas for it, and
continues the session in exactly the same state, including instruction, history and random
generator. A replica that stops offers its remaining sessions to the other replicas.

A move never duplicates or loses a session. It has three steps. Only the second step changes a
session:

1. The new replica creates a copy that cannot act yet.
2. The old replica releases the session if its state still equals the copy.
3. The copy becomes the session.

A late or repeated message finds the session in another state (`Version`), and has no effect. The
copy waits without a time limit until the old replica has answered the second step or has ended; all
other calls may time out. If a fault leaves several copies, the newest copy is the session.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import threading
import uuid
from abc import ABC, abstractmethod
from collections import Counter, OrderedDict
from collections.abc import Awaitable, Callable, Collection, Coroutine, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, Concatenate, ParamSpec, TypeVar

from vlagents_ray.errors import UnknownSession, VLAgentsError
from vlagents_ray.protocol.messages import Op, Reply, Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import WaitingTask
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.requests import Answer, IncomingMessage, Origin, PendingRequest, deliver
from vlagents_ray.serve.sessions import (
    Outdated,
    Past,
    Session,
    SessionState,
    SessionUse,
    Version,
)
from vlagents_ray.serve.weights import VersionNotHeld

logger = logging.getLogger(__name__)

EXPORT_S = 10.0  # time limit for the export of a session, which waits for the session's queued acts
ARRIVAL_S = 3.0  # time limit for a released session to arrive at its new replica
# Interval between queries to the other replicas, since a session may be moving between two of them.
ON_ITS_WAY_S = 0.1
_REMEMBERED = 1000  # number of remembered releases, for replicas that repeat a request

P = ParamSpec("P")
T = TypeVar("T")
InThread = Callable[..., Awaitable[Any]]
Spawn = Callable[[Coroutine[Any, Any, Any]], "asyncio.Task[Any]"]
# Fetches a session from the replica with the given name.
FetchFrom = Callable[[str, str], Awaitable[bool]]
UserOf = Callable[[SessionState, float], SessionUse | None]
# The function to call when a search is over, and the argument `user` of `fetch`.
_Callback = tuple[Callable[[], None], UserOf]
# Largest number of concurrent searches of a caller. Further requests get `UnknownSession`.
_PENDING = 4096
# Time limit for another replica's answer, which a frozen replica does not send. The clients of a
# frozen replica do not wait for it, since they begin their sessions again.
_ANSWER_S = 3.0
# Time limit for the remaining answers, once a replica has answered that it holds the session.
_OTHERS_S = 0.3
_SILENT_S = 3.0  # time for which a silent replica gets no further requests, s
_ATTEMPTS = 5  # number of attempts after which a search is given up, if `ARRIVAL_S` has also passed
_WEIGHTS_S = 60.0  # time limit for the weights of a fetched session
_BATCH_S = 0.002  # time for which searches are collected into one query
_GATHER_S = 0.02  # time for which new episodes are collected into one announcement
_AT_ONCE = 16  # largest number of sessions that are handed over, or unpickled, at a time


class PeerEnded(Exception):
    """Raised if the other replica has ended, and therefore also its sessions."""


class PeerUnreachable(Exception):
    """Raised if the other replica cannot be reached, so that it may or may not have executed the
    request.
    """


class HeldSessions:
    """Exports, releases and adopts the sessions of one engine, on the replica's event loop."""

    def __init__(
        self,
        engine: Engine,
        loop: asyncio.AbstractEventLoop,
        name: str,
        fetch_from: FetchFrom,
        spawn: Spawn,
    ) -> None:
        """Manage the sessions of `engine`.

        Args:
            engine: The engine of the replica.
            loop: The event loop of the replica.
            name: The name of the replica.
            fetch_from: Fetches a session from another replica.
            spawn: Starts a task on the event loop.
        """
        self._engine, self._loop, self._name = engine, loop, name
        self._fetch_from, self._spawn = fetch_from, spawn
        # Releases that other replicas have requested.
        self._claims: OrderedDict[str, asyncio.Task[bool]] = OrderedDict()
        self._released: OrderedDict[str, float] = OrderedDict()  # time of release by session, s
        # Sessions that are being transferred to another replica.
        self._leaving: dict[str, asyncio.Future[None]] = {}

    # Operations that other replicas call.

    async def versions_of(self, session_ids: Collection[str]) -> dict[str, Version]:
        """Return the versions of the given sessions that this replica has or is transferring to
        another replica. The method never waits. The version of a session that is being transferred
        is (0, 0).
        """
        leaving = dict.fromkeys(filter(self.is_leaving, session_ids), (0, 0))
        return leaving | self._engine.sessions.versions_of(session_ids)

    async def copy(self, session_id: str, is_leaving: bool = False) -> SessionState | None:
        """Return the session's state after its queued acts; None if this replica does not have the
        session, or if the session cannot be pickled.

        Args:
            session_id: The session.
            is_leaving: Whether `send_to_peer` has offered the session to the caller. There is then
                no time limit, since the session would end with this replica.
        """
        asked = self._engine.clock()
        if session_id in self._leaving and not is_leaving:
            await asyncio.wait([self._leaving[session_id]], timeout=EXPORT_S)
            return None
        if self.is_leaving(session_id) and not is_leaving:
            await asyncio.sleep(ON_ITS_WAY_S)
        limit_s = None if is_leaving else EXPORT_S
        info = await self._ask(session_id, "export", limit_s, asked=asked)
        return None if info is None else SessionState.from_info(info)

    async def weights(self, session_id: str) -> dict[str, Any] | None:
        """Return the values of the weights with which the session acts; None if this replica does
        not have the session.
        """
        sessions = self._engine.sessions.all()
        session = next((session for session in sessions if session.id == session_id), None)
        if session is None or session.model is None or session.weights is None:
            return None
        return await asyncio.to_thread(session.model.parameters.portable_values, session.weights)

    async def release(self, session_id: str, version: Version, claim: str) -> bool:
        """Release the session if it still has the given version; return whether it was released.

        A repeated call with the same `claim` returns the same answer, and has no further effect.
        """
        if claim not in self._claims:
            timeout_s = None if session_id in self._leaving else EXPORT_S
            self._claims[claim] = self._spawn(self._release(session_id, version, timeout_s))
            if len(self._claims) > _REMEMBERED:
                self._claims.popitem(last=False)
        return await asyncio.shield(self._claims[claim])

    async def _release(self, session_id: str, version: Version, timeout_s: float | None) -> bool:
        answer = await self._ask(session_id, "release", timeout_s, version=tuple(version))
        if answer is None or not answer["released"]:
            return False
        self._released[session_id] = self._loop.time()
        self._released.move_to_end(session_id)
        if len(self._released) > _REMEMBERED:
            self._released.popitem(last=False)
        return True

    def is_leaving(self, session_id: str) -> bool:
        """Return whether this replica has just released the session, so that possibly no replica
        has it at the moment.
        """
        left = self._loop.time() - self._released.get(session_id, float("-inf"))
        return session_id in self._leaving or (
            left < ARRIVAL_S and session_id not in self._engine.sessions
        )

    async def take_over(self, session_id: str, holder: str) -> bool:
        """Fetch a session from the replica called `holder`, which stops.

        Returns:
            Whether this replica has the session, or a newer state of it.
        """
        if self._engine.draining:
            return False
        try:
            return await self._fetch_from(session_id, holder)
        except Outdated:  # the call is a repetition, or a newer state has arrived before
            return True
        except VLAgentsError as error:
            logger.info("session %s: not taken over: %s", session_id, error)
            return False

    async def drop_older(self, episodes: dict[str, Episode]) -> dict[str, Episode]:
        """Close the sessions that have begun the given episodes at another replica.

        Returns:
            The episodes that contradict the order of steps, see `SessionTable.drop_older`.
        """
        now = self._engine.clock()
        begun = {
            session_id: Past((step, 0), now - age_s)
            for session_id, (step, age_s) in episodes.items()
        }
        contradicting = self._engine.sessions.drop_older(begun)
        return {
            session_id: (past.version[0], now - past.began)
            for session_id, past in contradicting.items()
        }

    # Operations that this replica calls.

    async def send_to_peer(self, session_id: str, peers: Sequence[Peer]) -> None:
        """Offer the session to `peers` in turn, until one has fetched it. The session stays at this
        replica until the other replica has a copy.
        """
        self._leaving[session_id] = self._loop.create_future()
        try:
            for peer in peers:
                if session_id not in self._engine.sessions:
                    return
                try:
                    if await peer.ask(HeldSessions.take_over, session_id, self._name):
                        return
                except PeerEnded:
                    continue
                except PeerUnreachable as error:
                    logger.warning(
                        "session %s: offered to a replica that does not answer: %s",
                        session_id,
                        error,
                    )
        finally:
            self._leaving.pop(session_id).set_result(None)

    async def raise_step(self, session_id: str, first: int, above: int) -> int | None:
        """Raise the first step of an episode that this replica has begun, see
        `SessionTable.raise_step`.
        """
        info = await self._ask(session_id, "raise_step", EXPORT_S, first=first, above=above)
        return None if info is None else info["step"]

    async def wait_until_left(self, session_id: str) -> None:
        """Wait until another replica has the session, if this replica is transferring it."""
        if session_id in self._leaving:
            await asyncio.wait([self._leaving[session_id]])

    async def _ask(
        self, session_id: str, op: Op, timeout_s: float | None, **kwargs: Any
    ) -> dict[str, Any] | None:
        """Return the engine's answer to a request, or None for an error.

        If the request has not begun after `timeout_s`, it is cancelled, and has no effect.
        """
        message, waiting = IncomingMessage("migration"), WaitingTask()
        message.expect(1, waiting)
        pending = PendingRequest(session_id, Request(op, kwargs=kwargs), message)
        self._engine.intake.submit([pending])
        await asyncio.wait([waiting.replies], timeout=timeout_s)
        if not waiting.replies.done():
            if self._engine.queue.cancel(pending):
                return None
            await waiting.replies
        [reply] = waiting.replies.result()
        if reply.error is not None:
            logger.info("session %s: %s: %s", session_id, op, reply.error)
            return None
        return reply.info


class Peer(ABC):
    """A remote proxy for the `HeldSessions` of another replica of the application.

    Each method waits for the other replica without a time limit, and raises `PeerEnded` or
    `PeerUnreachable`.
    """

    name: str  # unique name of the replica

    @abstractmethod
    async def ask(
        self,
        method: Callable[Concatenate[HeldSessions, P], Awaitable[T]],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> T:
        """Call `method`, at the other replica, and return its result."""


Peers = Callable[[], Awaitable[Sequence[Peer]]]
# Step of an episode, and time since its reset arrived, s. The clocks of replicas differ.
Episode = tuple[int, float]


@dataclass(slots=True)
class _Announcement:
    """An episode that this replica has begun, and announces to the other replicas."""

    session: Session[Any]
    step: int  # step at which the episode begins
    began: float  # time at which its reset arrived, s, of the engine's clock
    answer: Answer  # the answer to the reset, which is delivered after the announcement

    def finish(self) -> None:
        """Deliver the answer, after the announcement."""
        if self.session.first == self.step:  # it has begun no other episode meanwhile
            self.session.announced = True
        deliver([self.answer])

    def fail(self) -> None:
        """Replace the answer by an error, since another replica has begun an episode later."""
        pending, _ = self.answer
        error = UnknownSession(
            f"session {pending.session_id!r}: reset elsewhere while this reset was executed"
        )
        self.answer = (pending, Reply(pending.request.request_id, error=error))


# Each replica's answer with the sessions it holds.
_Answers = dict[Peer, "asyncio.Task[dict[str, Version] | None]"]


class SessionMigrator:
    """Finds sessions at other replicas and takes them over, and hands over the sessions of this
    replica.

    `sessions` answers the calls of the other replicas. All work runs on the replica's event loop;
    `fetch` and `announce` may be called on any thread.
    """

    def __init__(
        self,
        name: str,
        peers: Peers,
        loop: asyncio.AbstractEventLoop,
        in_thread: InThread | None = None,
    ) -> None:
        """Create the migrator of a replica.

        Args:
            name: The name of the replica for the other replicas.
            peers: Returns the other replicas.
            loop: The event loop of the replica.
            in_thread: Runs a slow call (unpickling, loading a checkpoint) on another thread; by
                default on a dedicated one.
        """
        self._name, self._peers = name, peers
        self._threads = ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="session-migration")
        self._in_thread = in_thread or partial(loop.run_in_executor, self._threads)
        self._loop = loop
        self._closed = False
        self._lock = threading.Lock()
        # Callbacks by session, until the session's search is over.
        self._callbacks: dict[str, list[_Callback]] = {}
        self._next_query: dict[str, asyncio.Future[_Answers]] = {}  # sessions of the next query
        self._callers: Counter[str] = Counter()  # number of running searches by caller
        # Episodes that are not announced yet.
        self._unannounced: list[tuple[str, _Announcement]] = []
        # Number of sessions that are being fetched because other replicas offered them.
        self._offered = 0
        # Time until which a silent replica gets no request, s, by the replica's name.
        self._silent: dict[str, float] = {}
        self._tasks: set[asyncio.Task[Any]] = set()
        # Held while a version of the weights, which may be large, is fetched.
        self._fetching_weights = asyncio.Lock()

    def start(self, engine: Engine) -> None:
        """Set the engine whose sessions move; this migrator is its `finder`."""
        self._engine = engine
        self.sessions = HeldSessions(engine, self._loop, self._name, self._fetch_from, self._spawn)

    def fetch(
        self,
        session_id: str,
        then: Callable[[], None],
        caller: str = "",
        user: UserOf = lambda *_: SessionUse(),
    ) -> bool:
        """Fetch a session from another replica, or close it there.

        Args:
            session_id: The session.
            then: Called once this replica has the session, or the session was not found or closed.
            caller: The owner of the search. The number of concurrent searches per caller is
                limited.
            user: Returns the use that a request makes of a session with the given exported state,
                whose episode began at the given time; None if the request cannot use it. A session
                is not moved if all waiting requests return None, and is closed at its replica if
                they only close it.

        Returns:
            False if `then` will not be called, since `caller` has too many searches or the migrator
            is closed.
        """
        with self._lock:
            if self._closed or self._callers[caller] >= _PENDING:
                return False
            self._callers[caller] += 1

            def finished() -> None:
                """End the search for its caller."""
                with self._lock:
                    self._callers[caller] -= 1
                    if not self._callers[caller]:
                        del self._callers[caller]
                then()

            if session_id in self._callbacks:
                self._callbacks[session_id].append((finished, user))
                return True
            self._callbacks[session_id] = [(finished, user)]
        self._loop.call_soon_threadsafe(lambda: self._spawn(self._search(session_id)))
        return True

    def announce(self, session: Session[Any], answer: Answer) -> None:
        """Announce to the other replicas that the session has begun an episode at this replica, so
        that they drop older states.

        Args:
            session: The session; called on the policy's thread.
            answer: The answer to the reset. It is delivered once the other replicas have dropped
                those states, or after `_OTHERS_S`.
        """
        announcement = _Announcement(session, session.first, session.began, answer)
        with self._lock:
            is_first = not self._unannounced
            self._unannounced.append((session.id, announcement))
        if not is_first:
            return
        self._loop.call_soon_threadsafe(lambda: self._spawn(self._announce_all()))

    async def hand_over(self) -> None:
        """Give all sessions to other replicas, since this replica stops, and close the queue."""
        slots = asyncio.Semaphore(_AT_ONCE)

        async def transfer(session_id: str, peers: Sequence[Peer]) -> None:
            async with slots:
                await self.sessions.send_to_peer(session_id, peers)

        tried = set[tuple[str, Version]]()
        while True:
            remaining = sorted(self._engine.sessions.versions().items() - tried)
            if not (remaining or self._callbacks or self._offered):
                break
            tried.update(remaining)

            peers = await self._responsive_first() if remaining else []
            # The sessions are spread over the replicas by round-robin.
            orders = [peers[i:] + peers[:i] for i in range(max(1, len(peers)))]
            transfers = [
                transfer(session_id, orders[i % len(orders)])
                for i, (session_id, _) in enumerate(remaining)
            ]
            await asyncio.gather(*transfers)
            if not remaining:
                # Sessions are still being fetched, for earlier requests or because they were
                # offered.
                await asyncio.sleep(ON_ITS_WAY_S)

        self._closed = True
        # Later requests are rejected, so that clients send them to the new replica.
        self._engine.stop(0.0)

    async def _responsive_first(self) -> list[Peer]:
        """Return the other replicas. Replicas that do not answer quickly are last."""
        answers = {peer: self._spawn(self._query_peer(peer, [])) for peer in await self._peers()}
        if answers:
            await asyncio.wait(answers.values(), timeout=_OTHERS_S)
        return sorted(
            answers, key=lambda peer: not answers[peer].done() or answers[peer].result() is None
        )

    async def close(self) -> None:
        """Cancel all running tasks, and accept no further searches."""
        self._closed = True
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._threads.shutdown(wait=False, cancel_futures=True)

    async def _search(self, session_id: str) -> None:
        """Search for the session. If it is not found, search once more for the requests that joined
        the search late.
        """
        searching = True
        while searching:
            with self._lock:
                waiting = tuple(self._callbacks.get(session_id, ()))
            try:
                await self._find(session_id)
            except VLAgentsError as error:
                logger.warning("session %s: %s", session_id, error)
            except Exception:
                logger.exception("session %s: could not be fetched", session_id)
            finally:
                searching = self._finish(session_id, waiting)

    async def _find(self, session_id: str) -> None:
        """Take the session over from the replica that has it, unless there is no such replica, or
        no waiting request can act on the session.
        """
        # Number of consecutive attempts without a holder. After two attempts, the session cannot be
        # moving between replicas either.
        misses = 0
        begun = self._loop.time()
        for attempt in itertools.count():
            if attempt:
                await asyncio.sleep(ON_ITS_WAY_S)
                # Another replica has handed the session over to this replica.
                if self._engine.sessions.versions_of([session_id]):
                    return

            await self.sessions.wait_until_left(session_id)
            holders = await self._holders(session_id, await self._answers(session_id))
            for version, peer in holders[1:]:
                newest = holders[0][0]
                if version < newest:
                    # The age of the newest episode is unknown here. With age 0, no later episode is
                    # raised above it.
                    dropping = peer.ask(HeldSessions.drop_older, {session_id: (newest[0], 0.0)})
                    self._spawn(self._answer(dropping))

            if holders and await self._move(session_id, holders[0][1]):
                return
            misses = 0 if holders or self.sessions.is_leaving(session_id) else misses + 1
            if misses == 2 or (attempt >= _ATTEMPTS and self._loop.time() > begun + ARRIVAL_S):
                return

    async def _fetch_from(self, session_id: str, holder: str) -> bool:
        """Fetch a session from the replica called `holder`, which has offered it; return whether
        that succeeded.
        """
        self._offered += 1
        try:
            for peer in await self._peers():
                if peer.name == holder:
                    return await self._move(session_id, peer, is_leaving=True)
            return False
        finally:
            self._offered -= 1

    async def _move(self, session_id: str, peer: Peer, *, is_leaving: bool = False) -> bool:
        """Move the session from the replica `peer` to this replica; return False if its state there
        has changed. The session is moved only if a waiting request can act on it, or if
        `is_leaving` is true because `peer` stops.
        """
        asked = self._engine.clock()
        copying = peer.ask(HeldSessions.copy, session_id, is_leaving)
        state = await self._answer(copying, None if is_leaving else EXPORT_S)
        if state is None:
            return False
        # The other replica received the call after `asked`, so `began` is not later than the true
        # beginning of the episode. An act that arrived after the reset is therefore never mistaken
        # for an act of an older episode.
        began = asked - state.age_s
        use = SessionUse() if is_leaving else self._use_of(session_id, state, began)
        if use is None:
            return True

        arriving = None
        if not use.ends:
            arriving = await self._prepare(peer, session_id, state, began, use.origin)
        claim = uuid.uuid4().hex
        release = self._spawn(
            self._answer(peer.ask(HeldSessions.release, session_id, state.version, claim))
        )
        while not (await asyncio.wait([release], timeout=_ANSWER_S))[0]:
            # The replica hangs. Only the copy of the session waits for it.
            if await self._query_peer(peer, []) is None:
                self._finish(session_id)
        if not release.result():
            if arriving is not None:
                self._engine.moves.abandon(arriving)
            return False
        if arriving is None:
            self._engine.sessions.end_elsewhere(session_id, state.version, began)
            return True

        self._engine.moves.enter(arriving)
        logger.info(
            "session %s: fetched from another replica, after %d acts",
            session_id,
            state.steps - state.first,
        )
        return True

    async def _prepare(
        self, peer: Peer, session_id: str, state: SessionState, began: float, origin: Origin
    ) -> Session[LoadedModel]:
        """Create the copy of a session. If this replica does not have the session's version of the
        weights, fetch the version from `peer`.
        """

        async def prepare(weights: dict[str, Any] | None = None) -> Session[LoadedModel]:
            """Create the copy on another thread, with the values of its weights if they were
            fetched.
            """
            create = self._engine.moves.prepare
            arriving: Session[LoadedModel] = await self._in_thread(
                create, session_id, state, began, origin, weights
            )
            return arriving

        with contextlib.suppress(VersionNotHeld):
            return await prepare()
        async with self._fetching_weights:
            try:
                return await prepare()  # another session may have fetched the weights meanwhile
            except VersionNotHeld:
                weights = await self._answer(peer.ask(HeldSessions.weights, session_id), _WEIGHTS_S)
                if weights is None:
                    raise
            return await prepare(weights)

    def _use_of(self, session_id: str, state: SessionState, began: float) -> SessionUse | None:
        """Return the use of the session by a waiting request, by an act rather than a close; None
        if no request can use it.
        """
        with self._lock:
            callbacks = list(self._callbacks.get(session_id, ()))
        uses = [use for _, user in callbacks if (use := user(state, began)) is not None]
        return min(uses, key=lambda use: use.ends, default=None)

    def _answers(self, session_id: str) -> asyncio.Future[_Answers]:
        """Return a future for the other replicas' answers to the next query, which is about all
        sessions that are being searched.
        """
        answers: asyncio.Future[_Answers] = self._loop.create_future()
        if not self._next_query:
            self._loop.call_later(_BATCH_S, lambda: self._spawn(self._ask_all()))
        self._next_query[session_id] = answers
        return answers

    async def _ask_all(self) -> None:
        query, self._next_query = self._next_query, {}
        now = self._loop.time()
        self._silent = {name: until for name, until in self._silent.items() if until > now}
        answers: _Answers = {}
        try:
            asked = [peer for peer in await self._peers() if peer.name not in self._silent]
            answers = {peer: self._spawn(self._query_peer(peer, list(query))) for peer in asked}
        finally:
            for future in query.values():
                future.set_result(answers)

    async def _query_peer(
        self, peer: Peer, session_ids: Sequence[str]
    ) -> dict[str, Version] | None:
        """Return a replica's answer; None if it does not answer in time."""
        try:
            return await asyncio.wait_for(
                peer.ask(HeldSessions.versions_of, session_ids), _ANSWER_S
            )
        except Exception as error:  # noqa: BLE001 - an error of one replica must not stop the search at the others
            logger.info("another replica does not answer: %r", error)
            self._silent[peer.name] = self._loop.time() + _SILENT_S
            return None

    async def _holders(self, session_id: str, answers: _Answers) -> list[tuple[Version, Peer]]:
        """Return the replicas that have the session, each with its version of the session, the
        newest version first.
        """
        peer_of = {task: peer for peer, task in answers.items()}
        holders: list[tuple[Version, Peer]] = []
        waiting = set(peer_of)
        until = self._loop.time() + _ANSWER_S
        while waiting:
            left_s = max(0.0, until - self._loop.time())
            completed, waiting = await asyncio.wait(
                waiting, timeout=left_s, return_when=asyncio.FIRST_COMPLETED
            )
            if not completed:
                break
            for task in completed:
                versions = task.result() or {}
                if session_id in versions:
                    step, moves = versions[session_id]
                    holders.append(((step, moves), peer_of[task]))
                    until = min(until, self._loop.time() + _OTHERS_S)
        return sorted(holders, key=lambda holder: holder[0], reverse=True)

    @staticmethod
    async def _answer(asked: Coroutine[Any, Any, T], timeout_s: float | None = None) -> T | None:
        """Return another replica's answer; None if there is no answer."""
        try:
            return await asyncio.wait_for(asked, timeout_s)
        except (PeerEnded, PeerUnreachable, asyncio.TimeoutError) as error:
            logger.info("another replica does not answer: %r", error)
            return None

    async def _announce_all(self) -> None:
        announced: list[tuple[str, _Announcement]] | None = None
        try:
            peers = [] if self._closed else await self._peers()
            if peers:
                await asyncio.sleep(_GATHER_S)
            announced = self._take_unannounced()
            if peers:
                raised = await self._announce_to(peers, dict(announced))
                if raised:
                    await self._announce_to(peers, raised)
        finally:  # also if the task is cancelled because the replica stops
            announced = self._take_unannounced() if announced is None else announced
            for _, announcement in announced:
                announcement.finish()

    async def _announce_to(
        self, peers: Sequence[Peer], episodes: dict[str, _Announcement]
    ) -> dict[str, _Announcement]:
        """Announce episodes to the other replicas, and wait for their answers for `_OTHERS_S`.

        A replica whose clock is ahead may have an earlier episode at a greater step, above which
        the step of the announced episode is then raised. If the other replica has a later episode,
        the announced one is void.

        Returns:
            The episodes whose steps were raised, so that they must be announced again.
        """
        asked = self._engine.clock()
        begun = {
            session_id: (episode.step, asked - episode.began)
            for session_id, episode in episodes.items()
        }
        calls = [self._answer(peer.ask(HeldSessions.drop_older, begun)) for peer in peers]
        tasks = [self._spawn(call) for call in calls]
        answered, _ = await asyncio.wait(tasks, timeout=_OTHERS_S)

        now = self._engine.clock()
        greater: dict[str, int] = {}
        for task in answered:
            for session_id, (step, age_s) in (task.result() or {}).items():
                episode = episodes[session_id]
                # The answer was sent between `asked` and `now`.
                if now - age_s < episode.began:
                    greater[session_id] = max(step, greater.get(session_id, 0))
                elif asked - age_s > episode.began:
                    self._engine.sessions.void(session_id, episode.step, (step, 0))
                    episode.fail()

        raised: dict[str, _Announcement] = {}
        for session_id, above in greater.items():
            episode = episodes[session_id]
            step = await self.sessions.raise_step(session_id, episode.step, above)
            if step is not None:
                episode.step = episode.answer[1].step = step
                raised[session_id] = episode
        return raised

    def _take_unannounced(self) -> list[tuple[str, _Announcement]]:
        """Return the episodes that are not announced yet, by session."""
        with self._lock:
            announced, self._unannounced = self._unannounced, []
        return announced

    def _finish(self, session_id: str, waiting: Collection[_Callback] | None = None) -> bool:
        """Call the callbacks of a session whose search is over; if the session was not found, call
        only the callbacks in `waiting`.

        Returns:
            Whether requests have joined the search after the requests in `waiting`. The other
            replicas' answers may be older than these requests.
        """
        later: list[_Callback] = []
        is_here = bool(self._engine.sessions.versions_of([session_id]))
        with self._lock:
            callbacks = self._callbacks.pop(session_id, [])
            if waiting is not None and not (is_here or self._closed):
                later = [callback for callback in callbacks if callback not in waiting]
                callbacks = [callback for callback in callbacks if callback in waiting]
            if later:
                self._callbacks[session_id] = later
        for then, _ in callbacks:
            try:
                then()
            except Exception:
                logger.exception("session %s: its request could not continue", session_id)
        # If no callback of `waiting` is left, the later requests already have another search.
        return bool(callbacks and later)

    def _spawn(self, work: Coroutine[Any, Any, Any]) -> asyncio.Task[Any]:
        task = self._loop.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task
