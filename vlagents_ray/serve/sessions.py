"""Sessions: each serves one robot or one env, with private state and shared weights.

The private state of a session is a copy of the loaded agent
(`vlagents_ray.policies.agent_copies`). A session can move to another replica of the same
policy, together with that copy.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

from vlagents_ray.abilities import Prepares, ability
from vlagents_ray.errors import (
    ConnectionLost,
    NotReset,
    PolicyUnavailable,
    TooManyRequests,
    UnknownSession,
)
from vlagents_ray.interface import Agent, Obs
from vlagents_ray.serve.in_time import RobotReport, RobotTimes
from vlagents_ray.serve.queue.preparation import Preparation
from vlagents_ray.serve.queue.replica_pace import RobotPlan
from vlagents_ray.serve.requests import NOWHERE, Answer, Opening, Origin, PendingRequest
from vlagents_ray.serve.weights import WeightsVersion

M = TypeVar("M")  # type of a loaded model


# Number of remembered sessions that have left (about 500 bytes each). Older states of these
# sessions are rejected.
_REMEMBERED = 4096
_ANY = 2**63  # number of moves that makes a version newer than any other state of its step
# Maximum number of acts at other replicas that neither the client nor this replica knows.
_UNSEEN = 2**20
_MOST_STEP = 2**62  # larger steps that clients report are ignored


class Outdated(UnknownSession):
    """Raised if the replica has, or had, a state of the session that is at least as new as the
    arriving state.
    """


Version = tuple[int, int]
"""Version of a session's state: its step, and its number of moves. Newer versions are greater."""


@dataclass(frozen=True, slots=True)
class SessionState:
    """The data that a replica transfers with a session, from which another replica continues it
    exactly.

    It is the answer to `export`, and the argument of `adopt`. A client, which only knows
    observations and actions, begins the session again with less data: see
    `vlagents_ray.client.recovery.ResumePoint`.
    """

    agent: bytes  # the policy's private state, from `AgentCopies.dump`
    steps: int  # see `Session`, also for `first`, `moves`, `follows` and `instruction`
    first: int
    moves: int
    # Time from the reset of the session's episode to the request for this state, s. It is a
    # duration, since the clocks of replicas differ.
    age_s: float
    policy: Sequence[str]  # version of the policy and of its shared objects
    weights: Sequence[Any]  # number and fingerprint of the session's version of the weights
    follows: bool
    instruction: str
    robot: Sequence[Any] = ()  # see `RobotPlan.to_list`

    @property
    def version(self) -> Version:
        """Version of the state."""
        return self.steps, self.moves

    @classmethod
    def from_info(cls, info: Mapping[str, Any]) -> SessionState:
        """Return the state in an answer to `export`, or in a request to `adopt`."""
        return cls(**info)

    def info(self) -> dict[str, Any]:
        """Return the state as the info of an answer, which can be sent to another process."""
        return {name: getattr(self, name) for name in self.__slots__}


@dataclass(slots=True)
class Session(Generic[M]):
    """The state of a policy for one robot or env.

    Only a request that is executed changes the state. A request that arrives late, is rejected, or
    is dropped while it waits leaves all fields as they were.
    """

    id: str
    # The session's agent; None until the first `reset` has succeeded, see `set_agent`.
    agent: Agent | None = None
    # Ability of the session's agent, which is looked up once in an episode.
    prepares: Prepares | None = None
    # Observations that wait for the acts that refer to them, and their preparations, by number.
    stored: dict[int, tuple[Obs, Preparation | None]] = field(default_factory=dict)
    # Model of which `agent` is a copy; None before the first reset, and after the session's end.
    model: M | None = None
    weights: WeightsVersion | None = None  # version of the weights with which the session acts
    instruction: str = ""  # instruction of the session's last reset
    # Whether the session uses the newest version of the weights; otherwise it uses the pinned
    # version.
    follows: bool = True
    over: bool = False  # whether the session has ended, so that no table contains it
    # Origin of the last executed request. Without an owner, the session ends when it is closed or
    # idle for too long.
    origin: Origin = NOWHERE
    # Step of the session's state. Each reset draws a new step above all earlier steps, and each act
    # adds 1.
    steps: int = 0
    first: int = 0  # step drawn for the last executed reset
    # Arrival time of the last executed reset, s, of the engine's clock.
    began: float = 0.0
    moves: int = 0  # number of moves between replicas since the last reset
    # Whether the session was announced to the other replicas, which then keep no older state.
    announced: bool = False
    # Time at which a request was last executed, s, of `time.monotonic`.
    used: float = field(default_factory=time.monotonic)
    # Reports of the session's robot at this replica; None before the first report.
    times: RobotTimes | None = None
    plan: RobotPlan = field(default_factory=RobotPlan)  # plan of the robot in this episode

    @property
    def version(self) -> Version:
        """Version of the session's state; a reset that the policy executes counts as completed."""
        return self.steps, self.moves

    def begin(self, opening: Opening) -> None:
        """End the current episode, and begin the episode of a reset, which has no agent yet."""
        self.set_agent(None)
        self.steps = self.first = opening.first
        self.moves = 0
        self.began = opening.arrived
        self.plan = RobotPlan(began=opening.arrived, heard=opening.arrived)

    def advance(self) -> int:
        """Record that the policy has executed an act, and return the new step."""
        self.steps += 1
        return self.steps

    def has_episode_of(self, pending: PendingRequest) -> bool:
        """Return whether an act or a close belongs to the session's current episode."""
        return pending.belongs_to(self.first, self.steps, self.began)

    def add_report(self, report: RobotReport, now: float) -> None:
        """Add the report of the session's robot that arrived at `now`, s."""
        if self.times is None:
            self.times = RobotTimes()
        self.times.add(report, now)

    def set_agent(self, agent: Agent | None) -> None:
        """Set the agent with which the session acts from now on; None without an episode.
        Observations that were stored for the previous agent are dropped.
        """
        self.stored.clear()
        self.prepares = None if agent is None else ability(agent, Prepares)
        self.agent = agent

    def wrong_step(self, step: int) -> UnknownSession:
        """Return the error for an act at a wrong step, which would repeat or skip an act."""
        return UnknownSession(
            f"session {self.id!r}: expected step {self.steps}, got {step} from its client; an "
            "answer was lost, or this is another episode: reset it"
        )

    def wrong_episode(self) -> UnknownSession:
        """Return the error for an act that was sent in another episode."""
        return UnknownSession(
            f"session {self.id!r}: another episode has begun since the act was sent, or the reset "
            "before the act was not executed: reset it, or send the episode's step"
        )


@dataclass(frozen=True, slots=True)
class SessionUse:
    """The use that a waiting request makes of a session at another replica."""

    origin: Origin = NOWHERE  # origin of the request, for whose key the session counts
    # Whether the request closes the session, which then ends where it is.
    ends: bool = False


class SessionFinder(Protocol):
    """Fetches sessions from other replicas:
    `vlagents_ray.serve.scaling.session_migration.SessionMigrator`.
    """

    def fetch(
        self,
        session_id: str,
        then: Callable[[], None],
        caller: str = "",
        user: Callable[[SessionState, float], SessionUse | None] = ...,
    ) -> bool:
        """Fetch or close a session if a request can use it (`user`), then call `then` whether the
        session was found or not; return False if `caller` has too many searches.
        """

    def announce(self, session: Session[Any], answer: Answer) -> None:
        """Announce to the other replicas that the session has begun an episode at this replica, so
        that they drop older states.

        The `answer` to the reset is delivered once these states are dropped, or after a short time.
        """


@dataclass(frozen=True, slots=True)
class Past:
    """The newest state that a replica had of a session that is no longer there."""

    version: Version
    began: float  # time at which its episode began, s, of the engine's clock


_NO_PAST = Past((0, 0), 0.0)


class SessionTable(Generic[M]):
    """The sessions of a replica, by id. Thread-safe.

    A waiting reset reserves an `Opening`: a step and, for a new session, room. Everything else
    changes when the policy's thread executes a request.

    A session never returns to an older state: a replica keeps the newest state that it has had, and
    rejects older states. Steps are drawn from the wall clock, so that a step drawn at another
    replica exceeds all steps drawn before. A new step is always above all steps that the session's
    client and this replica know, even if the clocks are wrong. If another replica knows a greater
    step of an older episode, since its clock is ahead, `raise_step` raises the new step above it.
    """

    def __init__(
        self,
        limit: int,
        idle_s: float,
        clock: Callable[[], int] = time.time_ns,
    ) -> None:
        """Create an empty table.

        Args:
            limit: Largest number of sessions.
            idle_s: Time without a request after which a session may be dropped, s.
            clock: Wall clock, ns.
        """
        self._sessions: dict[str, Session[M]] = {}
        # Episodes of waiting resets by session, in the order of their arrival.
        self._openings: dict[str, tuple[Opening, ...]] = {}
        self._expected: list[Session[M]] = []  # sessions that are arriving from other replicas
        self.limit = limit
        self.opened = 0  # number of sessions opened so far
        self._idle_s, self._clock = idle_s, clock
        self._drawn = 0  # latest step drawn
        # State up to which the states of a session that left are rejected, by session.
        self._left: OrderedDict[str, Past] = OrderedDict()
        self._lock = threading.RLock()

    def __len__(self) -> int:
        return len(self._sessions)

    def __contains__(self, session_id: object) -> bool:
        """Return whether the session is here, or a waiting reset will open it here."""
        return session_id in self._sessions or session_id in self._openings

    def get(self, session_id: str) -> Session[M]:
        """Return the session.

        Raises:
            NotReset: The first reset of the session waits.
            UnknownSession: The table does not have the session.
        """
        session = self._sessions.get(session_id)
        if session is not None:
            return session
        if session_id in self._openings:
            raise NotReset(f"session {session_id!r}: act before a successful reset; reset first")
        raise self.unknown(session_id)

    def unknown(self, session_id: str) -> UnknownSession:
        """Return the error for a request of a session that the table does not have."""
        return UnknownSession(
            f"session {session_id!r}: unknown here; it was never reset, idled for "
            f"{self._idle_s:g} s, or its replica was replaced: send a reset first"
        )

    def episode_of(self, session_id: str, origin: Origin) -> int | None:
        """Return the first step of the episode in which the connection of `origin` uses a session:
        that of its waiting reset, or of its last executed request; None if there is none.
        """
        for opening in reversed(self._openings.get(session_id, ())):
            if opening.origin is origin:
                return opening.first
        return origin.sessions.get(session_id)

    def reserve(self, pending: PendingRequest, kwargs: dict[str, Any], follows: bool) -> Opening:
        """Reserve an episode for a reset that will wait, and room for its session if it is new.

        Args:
            pending: The reset. The drawn step is above the step that its client reports.
            kwargs: Its options for the policy.
            follows: Whether its episode uses the newest version of the weights.

        Raises:
            PolicyUnavailable: The replica has reached its limit of sessions.
            TooManyRequests: The key of the caller has reached its limit of sessions.
        """
        session_id, known = pending.session_id, pending.request.step
        with self._lock:
            self.require_room([session_id], pending.origin)

            waiting = self._openings.get(session_id, ())
            before = max(self._newest(session_id).version[0], *(one.first for one in waiting), 0)
            if known is not None and known < _MOST_STEP:
                before = max(before, known)
            self._drawn = max(self._clock(), self._drawn + 1)
            first = max(self._drawn, before + _UNSEEN)
            opening = Opening(kwargs, follows, first, pending.arrived, pending.origin)
            self._openings[session_id] = (*waiting, opening)
            return opening

    def undo(self, session_id: str, opening: Opening) -> None:
        """Drop the reservation of a reset that will not be executed."""
        with self._lock:
            waiting = tuple(one for one in self._openings.get(session_id, ()) if one is not opening)
            if waiting:
                self._openings[session_id] = waiting
            else:
                self._openings.pop(session_id, None)

    def begin(self, session_id: str, opening: Opening) -> Session[M]:
        """Begin the episode of a reset that the policy's thread executes, and return its session.

        Raises:
            UnknownSession: The session is past the episode, at this or another replica.
            ConnectionLost: The connection of the reset has ended.
        """
        with self._lock:
            try:
                is_void = opening not in self._openings.get(session_id, ())
                if is_void or self._newest(session_id).version[0] >= opening.first:
                    raise UnknownSession(
                        f"session {session_id!r}: reset elsewhere, or ended, while this reset "
                        "waited"
                    )
                session = self._sessions.get(session_id) or Session(session_id)
                self._own(session, opening.origin, opening.first)
            finally:
                self.undo(session_id, opening)
            if session_id not in self._sessions:
                self._sessions[session_id] = session
                self.opened += 1
            session.begin(opening)
            return session

    def use(self, session: Session[M], pending: PendingRequest) -> None:
        """Record that the policy's thread executes an act in the session's current episode.

        Raises:
            UnknownSession: The act belongs to another episode, or to another step.
            ConnectionLost: The connection of the act has ended.
        """
        origin, step = pending.origin, pending.request.step
        # Most acts follow an act, or the reset, of the same connection and episode.
        follows = session.origin is origin and pending.episode == session.first
        if not follows or step not in (None, session.steps):
            if not session.has_episode_of(pending):
                raise session.wrong_episode() if step is None else session.wrong_step(step)
            with self._lock:
                self._own(session, origin, session.first)
        session.used = time.monotonic()

    def _own(self, session: Session[M], origin: Origin, first: int) -> None:
        """Let the session belong to the connection of `origin`, in the episode that begins at the
        step `first`; the caller holds the lock.
        """
        if origin.ended:
            raise ConnectionLost(
                "the request's connection has ended: not acted on, and never will be"
            )
        session.used = time.monotonic()
        session.origin = origin
        if origin.owner:
            origin.sessions[session.id] = first

    def raise_step(self, session_id: str, first: int, above: int) -> int | None:
        """Raise the first step of an episode above a step that another replica knows, since the
        clock of that replica is ahead. The policy's thread calls this method.

        Returns:
            The new first step; None if the session is no longer in the episode that begins at the
            step `first`.
        """
        with self._lock:
            session = self._sessions.get(session_id)
            if session is None or session.first != first:
                return None
            raised = above + _UNSEEN
            session.steps += raised - first
            session.first = raised
            if session.origin.owner:
                session.origin.sessions[session_id] = raised
            return raised

    def _newest(self, session_id: str) -> Past:
        """Return the newest state of the session that this table has or had."""
        newest = self._left.get(session_id, _NO_PAST)
        session = self._sessions.get(session_id)
        if session is not None and session.version > newest.version:
            return Past(session.version, session.began)
        return newest

    def require_room(self, session_ids: Sequence[str], origin: Origin = NOWHERE) -> None:
        """Raise an error unless there is room for all of these sessions, of which some may exist.

        Raises:
            PolicyUnavailable: The replica would exceed its limit of sessions.
            TooManyRequests: The key of the origin's caller would exceed its limit of sessions.
        """
        with self._lock:
            new = sum(session_id not in self for session_id in session_ids)
            if not new:
                return
            self.require_allowed(origin, new)
            if self._held() + new > self.limit:
                self.drop_idle()
            if self._held() + new > self.limit:
                raise self.full()

    def _held(self) -> int:
        """Return the number of sessions, and of sessions that waiting resets will open."""
        return len(self._sessions.keys() | self._openings.keys())

    def full(self) -> PolicyUnavailable:
        """Return the error for a client whose session exceeds the replica's limit."""
        cure = "close one, or raise sessions.limit or the number of replicas"
        return PolicyUnavailable(f"this replica holds {self.limit} sessions, its limit; {cure}")

    def enter(self, arriving: Session[M]) -> None:
        """Add a session from another replica, which replaces an older state of the session.

        The old replica has already released the session, so it is added even if the table has
        become full.

        Raises:
            Outdated: This replica has, or had, a state that is at least as new.
        """
        with self._lock:
            self.forget_expected(arriving)
            self._require_newer(arriving)
            replaced = self._sessions.get(arriving.id)
            if replaced is None:
                self.opened += 1
            else:
                self._end(replaced)
            self._sessions[arriving.id] = arriving

    def _require_newer(self, arriving: Session[M]) -> None:
        if arriving.version <= self._newest(arriving.id).version:
            raise Outdated(
                f"session {arriving.id!r}: this replica has, or had, a newer state of it; reset it"
            )

    def expect(self, arriving: Session[M], origin: Origin) -> None:
        """Count a session that is arriving from another replica for the key of a request's origin.

        Raises:
            Outdated: This replica has, or had, a state that is at least as new.
            TooManyRequests: The key has reached its limit of sessions.
        """
        with self._lock:
            self._require_newer(arriving)
            if arriving.id not in self:
                self.require_allowed(origin)
            self._expected.append(arriving)

    def abandon(self, arriving: Session[M]) -> None:
        """End a session that was expected from another replica, but will not arrive."""
        with self._lock:
            self.forget_expected(arriving)
            self._end(arriving)

    def forget_expected(self, arriving: Session[M]) -> None:
        """Stop counting a session that has arrived, or will not arrive."""
        with self._lock:
            self._expected = [session for session in self._expected if session is not arriving]

    def free(self, session_id: str) -> None:
        """Forget the states of the session, so that another session may have its id."""
        with self._lock:
            self._left.pop(session_id, None)

    def versions_of(self, session_ids: Iterable[str]) -> dict[str, Version]:
        """Return the versions of the given sessions that this table contains, and that have an
        episode.
        """
        with self._lock:
            sessions = [self._sessions.get(session_id) for session_id in session_ids]
            return {
                session.id: session.version
                for session in sessions
                if session is not None and session.agent is not None
            }

    def versions(self) -> dict[str, Version]:
        """Return the versions of all sessions, including sessions whose first reset waits."""
        with self._lock:
            waiting = {name: (one[0].first, 0) for name, one in self._openings.items()}
            return waiting | {session.id: session.version for session in self._sessions.values()}

    def drop_older(self, episodes: Mapping[str, Past]) -> dict[str, Past]:
        """Close the sessions whose states are older than `episodes`, which other replicas have
        begun, and reject such states.

        The clocks of replicas differ, so that the order of steps may differ from the order in which
        the resets arrived.

        Args:
            episodes: The steps at which the episodes begin, and estimates of the times at which
                their resets arrived, which are not earlier than the true times.

        Returns:
            The states that contradict this order, by session: an episode of this table that has
            certainly begun later, and is kept; or otherwise the greatest step, not below the step
            of the announced episode, that this table has, had, or has reserved for a waiting reset,
            although its reset arrived earlier.
        """
        contradicting: dict[str, Past] = {}
        with self._lock:
            for session_id, episode in episodes.items():
                session = self._sessions.get(session_id)
                if session is not None and session.began > episode.began:
                    contradicting[session_id] = Past(session.version, session.began)
                    continue

                waiting = self._openings.get(session_id, ())
                known = [Past((opening.first, 0), opening.arrived) for opening in waiting]
                known.append(self._newest(session_id))
                greater = [
                    past
                    for past in known
                    if past.version >= episode.version and past.began < episode.began
                ]
                if greater:
                    contradicting[session_id] = max(greater, key=lambda past: past.version)
                if session is not None and session.version < episode.version:
                    self._forget(session_id)
                self._remember(session_id, Past((episode.version[0] - 1, _ANY), episode.began))
        return contradicting

    def void(self, session_id: str, first: int, later: Version) -> None:
        """Remove the session if its episode began at the step `first`, since another replica has
        begun an episode later, whose version `later` may be smaller.
        """
        with self._lock:
            session = self._sessions.get(session_id)
            if session is not None and session.first == first:
                del self._sessions[session_id]
                self._end(session)
                self._remember(session_id, Past((later[0] - 1, _ANY), session.began))

    def require_allowed(self, origin: Origin, new: int = 1) -> None:
        """Raise `TooManyRequests` if the key of the origin's caller may not have this number of new
        sessions.
        """
        if origin.caller is None or origin.caller.sessions is None:
            return
        limit = origin.caller.sessions
        with self._lock:
            if self._number_of(origin.prefix) + new > limit:
                self.drop_idle()
            if self._number_of(origin.prefix) + new <= limit:
                return
        raise TooManyRequests(
            f"key {origin.prefix.rstrip('/')!r} holds {limit} sessions here, as many as it allows; "
            "close one"
        )

    def _number_of(self, prefix: str) -> int:
        names = self._sessions.keys() | self._openings.keys()
        return sum(name.startswith(prefix) for name in names) + sum(
            arriving.id.startswith(prefix) for arriving in self._expected
        )

    def close(self, session_id: str) -> None:
        """Close the session. Unknown ids are ignored."""
        with self._lock:
            self._forget(session_id)

    def close_for(self, pending: PendingRequest) -> None:
        """Execute a close, which has no effect on a later episode of its session, or of another
        connection.

        Raises:
            UnknownSession: The table does not have the session.
        """
        session_id = pending.session_id
        with self._lock:
            pending.origin.sessions.pop(session_id, None)
            if self.get(session_id).has_episode_of(pending):
                self._forget(session_id)

    def end_elsewhere(self, session_id: str, version: Version, began: float) -> None:
        """Reject the states of a session that a request of this replica has closed at another
        replica.
        """
        with self._lock:
            self._remember(session_id, Past((version[0], _ANY), began))

    def release(self, session_id: str, version: Version) -> bool:
        """Release the session to another replica, which has a copy of the given version; return
        False if the session's version differs.
        """
        with self._lock:
            session = self._sessions.get(session_id)
            if session is None or session.version != version:
                return False
            self._forget(session_id, version)
            return True

    def close_owned(self, origin: Origin) -> None:
        """Close the sessions of a connection that has ended, except those that belong to another
        connection now. Its waiting resets are void.
        """
        with self._lock:
            self.discard([*origin.sessions, *self._openings], origin)

    def discard(self, session_ids: Iterable[str], origin: Origin) -> None:
        """Close the sessions among the given ones that belong to `origin`, and make its waiting
        resets of them void.
        """
        with self._lock:
            for session_id in set(session_ids):
                for opening in self._openings.get(session_id, ()):
                    if opening.origin is origin:
                        self.undo(session_id, opening)
                session = self._sessions.get(session_id)
                if session is not None and session.origin is origin:
                    self._forget(session_id)

    def close_all(self) -> None:
        """Close all sessions, and drop their agents, since the model of these agents is closed.
        Only the policy's thread calls this method.
        """
        with self._lock:
            for session in list(self._sessions.values()):
                self._forget(session.id)
                session.set_agent(None)
                session.weights = None

    def all(self) -> list[Session[M]]:
        """Return all sessions. The method takes no lock, so callers may hold locks."""
        return list(self._sessions.values())

    def by_transport(self) -> dict[str, int]:
        """Return the number of sessions by transport."""
        with self._lock:
            return Counter(session.origin.transport for session in self._sessions.values())

    def movable_by_connection(self, within_s: float) -> Counter[str]:
        """Return the number of sessions by connection whose clients can be requested to reconnect,
        and that were used within the last `within_s`.
        """
        since = time.monotonic() - within_s
        with self._lock:
            sessions = list(self._sessions.values())
        active = [
            session for session in sessions if session.origin.can_move and session.used >= since
        ]
        return Counter(session.origin.connection for session in active)

    def ids(self) -> list[str]:
        """Return the ids of all sessions."""
        with self._lock:
            return list(self._sessions)

    def drop_idle(self) -> None:
        """Close sessions without a request for longer than the idle time."""
        oldest = time.monotonic() - self._idle_s
        with self._lock:
            idle = [session.id for session in self._sessions.values() if session.used < oldest]
            for session_id in idle:
                self._forget(session_id)

    def _forget(self, session_id: str, left: Version | None = None) -> None:
        session = self._sessions.pop(session_id, None)
        if session is not None:
            self._remember(session_id, Past(left or (session.steps, _ANY), session.began))
            self._end(session)

    def _end(self, session: Session[M]) -> None:
        """Mark a removed session as ended; the caller holds the lock."""
        session.over = True
        session.stored.clear()
        session.model = None

    def _remember(self, session_id: str, past: Past) -> None:
        before = self._left.pop(session_id, past)
        self._left[session_id] = past if past.version > before.version else before
        if len(self._left) > _REMEMBERED:
            self._left.popitem(last=False)


class DrainList:
    """The connections that should move to another replica. If this replica drains, these are all
    connections. Otherwise `vlagents_ray.serve.scaling.rebalancer` marks connections for which other
    replicas have room; the next reply over each marked connection requests the client to reconnect,
    once. Thread-safe.
    """

    def __init__(self) -> None:
        # Whether the replica will stop. Only `drain` sets this field, and it is never reset.
        self.draining = False
        self._lock = threading.Lock()  # held while one of the following fields is read or changed
        self._marked: set[str] = set()
        self._asked: dict[str, float] = {}  # time of the request to reconnect, s

    def drain(self) -> None:
        """Request all clients, in their next replies, to reconnect to other replicas."""
        self.draining = True

    def mark(self, connections: set[str]) -> None:
        """Replace the set of connections whose clients are requested to reconnect."""
        with self._lock:
            self._marked = connections

    def ask(self, connection: str) -> bool:
        """Return whether the current reply must request the reconnection of a marked connection; if
        so, record the request.
        """
        if not self._marked:  # this is nearly always the case, and avoids taking the lock
            return False
        with self._lock:
            if connection not in self._marked:
                return False
            self._marked.discard(connection)
            self._asked[connection] = time.monotonic()
            return True

    def asked_within(self, seconds: float) -> set[str]:
        """Return the connections whose clients were requested to reconnect in the last
        `seconds`.
        """
        since = time.monotonic() - seconds
        with self._lock:
            return {connection for connection, when in self._asked.items() if when >= since}

    def forget_older(self, seconds: float) -> None:
        """Forget the connections whose clients were requested to reconnect more than
        `seconds` ago.
        """
        since = time.monotonic() - seconds
        with self._lock:
            self._asked = {
                connection: when for connection, when in self._asked.items() if when >= since
            }
