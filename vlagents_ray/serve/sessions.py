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
from vlagents_ray.errors import PolicyUnavailable, TooManyRequests, UnknownSession
from vlagents_ray.interface import Agent, Obs
from vlagents_ray.serve.in_time import RobotTimes
from vlagents_ray.serve.queue.preparation import Preparation
from vlagents_ray.serve.queue.replica_pace import RobotPlan
from vlagents_ray.serve.requests import NOWHERE, Answer, Origin, PendingRequest
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
    """The state of a policy for one robot or env."""

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
    # Origin of the session's last request. Without an owner, the session ends when it is closed or
    # idle for too long.
    origin: Origin = NOWHERE
    # Step of the session's state. Each reset draws a new step above all earlier steps, and each act
    # adds 1.
    steps: int = 0
    first: int = 0  # step drawn at the last reset that was run
    expected: int = 0  # step drawn for the latest reset, which may still be queued
    # Arrival time of the last reset that was run, s, of the engine's clock.
    began: float = 0.0
    last_reset: float = 0.0  # arrival time of the latest reset, which may still be queued, s
    moves: int = 0  # number of moves between replicas since the last reset
    # Whether the session was announced to the other replicas, which then keep no older state.
    announced: bool = False
    used: float = field(default_factory=time.monotonic)  # time of the session's last request, s
    # Reports of the session's robot at this replica; None before the first report.
    times: RobotTimes | None = None
    plan: RobotPlan = field(default_factory=RobotPlan)  # plan of the robot in this episode

    @property
    def version(self) -> Version:
        """Version of the session's state; a reset in progress counts as completed."""
        return max((self.steps, self.moves), (self.expected, 0))

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


class SessionFinder(Protocol):
    """Fetches sessions from other replicas:
    `vlagents_ray.serve.scaling.session_migration.SessionMigrator`.
    """

    def fetch(
        self,
        session_id: str,
        then: Callable[[], None],
        caller: str = "",
        user: Callable[[SessionState, float], Origin | None] = ...,
    ) -> bool:
        """Fetch a session if a request can act on it (`user`), then call `then` whether the session
        was found or not; return False if `caller` has too many searches.
        """

    def announce(self, session_id: str, step: int, answer: Answer | None = None) -> None:
        """Announce to the other replicas that the session has begun an episode at this replica at
        `step`, so that they drop older states.

        The `answer` to the reset is delivered once these states are dropped, or after a short time.
        """


class SessionTable(Generic[M]):
    """The sessions of a replica, by id. Thread-safe.

    A session never returns to an older state: a replica keeps the newest state that it has had, and
    rejects older states. Steps are drawn from the wall clock, so that a step drawn at another
    replica exceeds all steps drawn before. A new step is always above all steps that the session's
    client and this replica know, even if the clocks are wrong.
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
        self._expected: list[Session[M]] = []  # sessions that are arriving from other replicas
        self.limit = limit
        self.opened = 0  # number of sessions opened so far
        self._idle_s, self._clock = idle_s, clock
        self._drawn = 0  # latest step drawn
        # Version up to which the states of a session that left are rejected, by session.
        self._left: OrderedDict[str, Version] = OrderedDict()
        self._lock = threading.RLock()

    def __len__(self) -> int:
        return len(self._sessions)

    def __contains__(self, session_id: object) -> bool:
        return session_id in self._sessions

    def get(self, session_id: str) -> Session[M]:
        """Return the session, and mark it as used.

        Raises:
            UnknownSession: The table does not have the session.
        """
        session = self._sessions.get(session_id)
        if session is None:
            raise UnknownSession(
                f"session {session_id!r}: unknown here; it was never reset, idled for "
                f"{self._idle_s:g} s, or its replica was replaced: send a reset first"
            )
        session.used = time.monotonic()
        return session

    def open(self, session_id: str, origin: Origin = NOWHERE) -> Session[M]:
        """Return the session, which is created if it is new, for a request from `origin`.

        Raises:
            PolicyUnavailable: The replica has reached its limit of sessions.
            TooManyRequests: The key of the origin's caller has reached its limit of sessions.
        """
        with self._lock:
            session = self._sessions.get(session_id)
            if session is None:
                self.require_room([session_id], origin)
                session = self._sessions[session_id] = Session(session_id)
                self.opened += 1
        session.used = time.monotonic()
        session.origin = origin
        return session

    def begin(
        self, session: Session[M], known: int | None, arrived: float, origin: Origin = NOWHERE
    ) -> tuple[int, int | None]:
        """Draw the step at which the session's next episode begins.

        Args:
            session: The session.
            known: The step that the client reports; the drawn step is above it.
            arrived: Time at which the reset arrived, s, of the engine's clock.
            origin: Origin of the reset, whose connection belongs to the new episode from now on.

        Returns:
            The step, and the step of the connection's previous episode, which is None if there is
            none.
        """
        with self._lock:
            before = max(session.version, self._left.get(session.id, (0, 0)))[0]
            if known is not None and known < _MOST_STEP:
                before = max(before, known)
            self._drawn = max(self._clock(), self._drawn + 1)
            session.expected = max(self._drawn, before + _UNSEEN)
            session.last_reset = arrived
            previous = origin.sessions.get(session.id)
            if origin.owner:
                origin.sessions[session.id] = session.expected
            return session.expected, previous

    def end_episode(self, session: Session[M], reset: PendingRequest, first: int) -> None:
        """End the session's episode, since the policy's thread runs a reset, whose episode begins
        at the step `first`.
        """
        with self._lock:
            session.set_agent(None)
            session.steps = session.first = first
            session.moves = 0
            session.plan = RobotPlan(began=reset.arrived, heard=reset.arrived)
            session.expected = max(session.expected, first)
            session.began = reset.arrived
            session.last_reset = max(session.last_reset, reset.arrived)

    def undo(
        self,
        session_id: str,
        first: int,
        origin: Origin = NOWHERE,
        previous: int | None = None,
    ) -> None:
        """Undo `begin` for a reset that was cancelled. The current episode continues, at this or
        another replica.
        """
        with self._lock:
            if origin.sessions.get(session_id) == first:
                origin.sessions[session_id] = previous
            session = self._sessions.get(session_id)
            if session is None or session.expected != first or session.steps == first:
                return
            session.expected, session.last_reset = session.first, session.began
            if session.steps == 0:  # the reset was the first reset of the session at this replica
                del self._sessions[session_id]
                self._end(session)

    def is_past(self, session_id: str, first: int) -> bool:
        """Return whether the session, at this or another replica, is past an episode that should
        begin at the given step.
        """
        with self._lock:
            session = self._sessions.get(session_id)
            return self._left.get(session_id, (0, 0))[0] >= first or (
                session is not None and session.steps > first
            )

    def require_room(self, session_ids: Sequence[str], origin: Origin = NOWHERE) -> None:
        """Raise an error unless there is room for all of these sessions, of which some may exist.

        Raises:
            PolicyUnavailable: The replica would exceed its limit of sessions.
            TooManyRequests: The key of the origin's caller would exceed its limit of sessions.
        """
        with self._lock:
            new = sum(session_id not in self._sessions for session_id in session_ids)
            if not new:
                return
            self.require_allowed(origin, new)
            if len(self._sessions) + new > self.limit:
                self.drop_idle()
            if len(self._sessions) + new > self.limit:
                raise self.full()

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
        present = self._sessions.get(arriving.id)
        newest = self._left.get(arriving.id, (0, 0))
        if present is not None:
            newest = max(newest, present.version)
        if arriving.version <= newest:
            raise Outdated(
                f"session {arriving.id!r}: this replica has, or had, a newer state of it; reset it"
            )

    def expect(self, arriving: Session[M]) -> None:
        """Count a session that is arriving from another replica for the key of its origin.

        Raises:
            Outdated: This replica has, or had, a state that is at least as new.
            TooManyRequests: The key has reached its limit of sessions.
        """
        with self._lock:
            self._require_newer(arriving)
            if arriving.id not in self._sessions:
                self.require_allowed(arriving.origin)
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
        """Return the versions of all sessions, including sessions whose first reset is
        in progress.
        """
        with self._lock:
            return {session.id: session.version for session in self._sessions.values()}

    def drop_older(self, steps: Mapping[str, int]) -> None:
        """Close the sessions whose states are older than `steps`, at which other replicas began
        episodes, and reject such states.
        """
        with self._lock:
            for session_id, step in steps.items():
                session = self._sessions.get(session_id)
                if session is not None and session.version < (step, 0):
                    self._forget(session_id)
                self._remember(session_id, (step - 1, _ANY))

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
        names = [*self._sessions, *(session.id for session in self._expected)]
        return sum(name.startswith(prefix) for name in names)

    def close(self, session_id: str, origin: Origin = NOWHERE) -> None:
        """Close the session. It no longer belongs to its connection, unless the connection has sent
        a reset meanwhile. Unknown ids are ignored.
        """
        with self._lock:
            session = self._sessions.get(session_id)
            first = origin.sessions.get(session_id)
            if session is None or first is None or first <= session.steps:
                origin.sessions.pop(session_id, None)
            self._forget(session_id)

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

    def close_owned(self, connection: str, session_ids: Iterable[str]) -> None:
        """Close the given sessions, except those that no longer end with the connection."""
        with self._lock:
            for session_id in session_ids:
                session = self._sessions.get(session_id)
                if session is not None and session.origin.owner == connection:
                    self._discard(session)

    def discard(self, session_ids: Iterable[str]) -> None:
        """Close sessions that a message has begun in vain."""
        with self._lock:
            for session_id in session_ids:
                session = self._sessions.get(session_id)
                if session is not None:
                    self._discard(session)

    def _discard(self, session: Session[M]) -> None:
        # This version makes a waiting reset void.
        self._forget(session.id, (max(session.steps, session.expected), _ANY))

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
            self._remember(session_id, left or (session.steps, _ANY))
            self._end(session)

    def _end(self, session: Session[M]) -> None:
        """Mark a removed session as ended; the caller holds the lock."""
        session.over = True
        session.stored.clear()
        session.model = None

    def _remember(self, session_id: str, version: Version) -> None:
        self._left[session_id] = max(version, self._left.pop(session_id, version))
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
