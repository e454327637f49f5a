"""Sessions: one robot or one env each, with state of its own and shared weights.

A policy is initialized once a replica. Every `reset` begins with a pristine copy of that
initialized agent, so that neither another session nor the session's own past changes an episode.
A copy shares what is heavy or cannot be copied and has its own of everything else:

- shared: attributes named in `Agent.shared`, torch parameters, JAX arrays (immutable), functions,
  classes, modules, and objects that refuse to be copied (locks, sockets, native handles);
- shared and made read-only: numpy arrays over 64 MiB, so that writing into one raises instead of
  leaking into other sessions;
- copied: all other attributes, whatever their depth.

A session can move to another replica of the same policy: what it has of its own travels, what it
shares is found there again, by its place among the shared objects.
"""

from __future__ import annotations

import hashlib
import io
import logging
import pickle
import sys
import threading
import time
import types
from collections import Counter
from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from vlagents_ray.errors import PolicyUnavailable, TooManyRequests, UnknownSession
from vlagents_ray.interface import Agent

if TYPE_CHECKING:
    from vlagents_ray.serve.model import Model
    from vlagents_ray.serve.waiting import Ticket

logger = logging.getLogger(__name__)

SHARED_ARRAY_BYTES = 64 * 2**20
_BY_REFERENCE = (types.FunctionType, types.BuiltinFunctionType, types.ModuleType, type, logging.Logger)
_PLAIN = (
    *(type(None), bool, int, float, complex, str, bytes, bytearray, list, tuple, dict, set, frozenset),
    pickle.PickleBuffer,  # the inside of a numpy array
)


class _Shared:
    """The objects that the sessions of a replica share, in the order in which pickling met them."""

    def __init__(self) -> None:
        self.objects: list[Any] = []
        self.refused: set[str] = set()
        self._numbers: dict[int, int] = {}
        torch = sys.modules.get("torch")
        self._parameter: type | None = torch.nn.Parameter if torch is not None else None

    def number(self, obj: Any) -> int | None:
        """The place of an object, if it is shared."""
        return self._numbers.get(id(obj))

    def add(self, obj: Any) -> int:
        """Share an object from now on."""
        number = self._numbers.get(id(obj))
        if number is None:
            number = self._numbers[id(obj)] = len(self.objects)
            self.objects.append(obj)
        return number

    def must_have(self, obj: Any) -> bool:
        """Is this one that copies share whether named or not? A large array becomes read-only."""
        if isinstance(obj, _BY_REFERENCE) or (self._parameter is not None and isinstance(obj, self._parameter)):
            return True
        if isinstance(obj, np.ndarray):
            if obj.nbytes < SHARED_ARRAY_BYTES:
                return False
            obj.flags.writeable = False
            return True
        if type(obj).__module__.partition(".")[0] in ("jax", "jaxlib"):
            return True
        try:
            obj.__reduce_ex__(pickle.HIGHEST_PROTOCOL)
        except Exception:  # noqa: BLE001 - whatever an object raises when asked, it cannot be copied
            self.refused.add(f"{type(obj).__module__}.{type(obj).__qualname__}")
            return True
        return False

    def fingerprint(self) -> str:
        """Equal in replicas whose shared objects correspond, place by place, as far as their kinds tell."""
        kinds = [
            (type(obj).__module__, type(obj).__qualname__, getattr(obj, "__qualname__", ""), str(_shape(obj)))
            for obj in self.objects
        ]
        return hashlib.sha256(repr(kinds).encode()).hexdigest()


class _Pickler(pickle.Pickler):
    """Pickles an agent in memory, leaving out what is shared; with `found`, also what should be."""

    def __init__(self, file: io.BytesIO, shared: _Shared, *, find: bool) -> None:
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self._shared = shared
        self._find = find

    def persistent_id(self, obj: Any) -> int | None:
        """The place of a shared object, or None for what is copied."""
        number = self._shared.number(obj)
        if number is None and self._find and type(obj) not in _PLAIN and self._shared.must_have(obj):
            number = self._shared.add(obj)
        return number


class _Unpickler(pickle.Unpickler):
    def __init__(self, data: bytes, shared: _Shared) -> None:
        super().__init__(io.BytesIO(data))
        self._objects = shared.objects

    def persistent_load(self, pid: Any) -> Any:
        return self._objects[pid]


class AgentCopies:
    """Makes copies of an initialized agent, each independent of the others."""

    def __init__(self, agent: Agent) -> None:
        self._shared = _Shared()
        for item in agent.shared_objects():
            if type(item) not in _PLAIN or item:
                self._shared.add(item)
        self._pristine = self._dump(agent, find=True)
        self.fingerprint = self._shared.fingerprint()
        if self._shared.refused:
            logger.warning(
                "%s: sessions share objects of %s, which cannot be copied; if one of them holds an episode's "
                "state, create it in reset() instead of initialize()",
                type(agent).__name__,
                sorted(self._shared.refused),
            )

    def make(self) -> Agent:
        """A pristine copy: what the agent was when `initialize` returned."""
        return self.load(self._pristine)

    def dump(self, agent: Agent) -> bytes:
        """What a copy has of its own, for `load` in another replica; raises whatever pickling it raises."""
        return self._dump(agent, find=False)

    def load(self, data: bytes) -> Agent:
        """The copy that `dump` wrote here, or in a replica with the same fingerprint."""
        agent: Agent = _Unpickler(data, self._shared).load()
        return agent

    def _dump(self, agent: Agent, *, find: bool) -> bytes:
        file = io.BytesIO()
        _Pickler(file, self._shared, find=find).dump(agent)
        return file.getvalue()


def _shape(obj: Any) -> tuple[int, ...] | None:
    shape = getattr(obj, "shape", None)
    return tuple(shape) if isinstance(shape, tuple) else None


@dataclass(slots=True)
class Session:
    """One robot's or env's side of a policy."""

    id: str
    agent: Agent | None = None  # None until its first `reset` succeeded
    model: Model | None = None  # what `agent` is a copy of; `vlagents_ray.serve.models` and its room alone set it
    over: bool = False  # in no table any more
    resetting: Ticket | None = None  # its reset under way, as long as that waits for its checkpoint
    owner: str = ""  # the connection that it ends with; empty: it ends when closed, or idle for long
    steps: int = 0  # acts since its last reset
    transport: str = ""  # the door that it came through
    connection: str = ""  # that its last request came by, if one carries several sessions; else its own
    used: float = field(default_factory=time.monotonic)


class SessionTable:
    """The sessions of a replica, by id. Thread-safe."""

    def __init__(self, limit: int, idle_s: float) -> None:
        self.ended: Callable[[Session], None] = lambda _: None  # called with each that is forgotten, under the lock
        self._sessions: dict[str, Session] = {}
        self.limit = limit
        self.opened = 0  # so far
        self._idle_s = idle_s
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._sessions)

    def __contains__(self, session_id: str) -> bool:
        return session_id in self._sessions

    def get(self, session_id: str) -> Session:
        """The session, or `UnknownSession`."""
        session = self._sessions.get(session_id)
        if session is None:
            raise UnknownSession(
                f"session {session_id!r}: unknown here; it was never reset, idled for {self._idle_s:g} s, "
                f"or its replica was replaced: send a reset first"
            )
        session.used = time.monotonic()
        return session

    def open(
        self,
        session_id: str,
        owner: str = "",
        transport: str = "",
        connection: str = "",
        quota: tuple[str, int | None] | None = None,
    ) -> Session:
        """The session, made if it is new, now `owner`'s; `PolicyUnavailable` when the replica is full.

        `quota` says how many there may be whose names begin so; `TooManyRequests` for one more.
        """
        with self._lock:
            session = self._sessions.get(session_id)
            if session is None:
                if quota is not None and quota[1] is not None:
                    self._require_below(quota[0], quota[1])
                if len(self._sessions) >= self.limit:
                    self._drop_idle()
                if len(self._sessions) >= self.limit:
                    raise PolicyUnavailable(
                        f"this replica holds {self.limit} sessions, its limit; "
                        f"close one, or raise sessions.limit or the number of replicas"
                    )
                session = self._sessions[session_id] = Session(session_id)
                self.opened += 1
        session.used = time.monotonic()
        session.owner, session.transport, session.connection = owner, transport, connection
        return session

    def _require_below(self, prefix: str, limit: int) -> None:
        if sum(name.startswith(prefix) for name in self._sessions) >= limit:
            self._drop_idle()
        if sum(name.startswith(prefix) for name in self._sessions) >= limit:
            raise TooManyRequests(
                f"key {prefix.rstrip('/')!r} holds {limit} sessions here, as many as it allows; close one"
            )

    def close(self, session_id: str) -> None:
        """Forget the session; unknown ids are none."""
        with self._lock:
            self._forget(session_id)

    def close_owned(self, owner: str, session_ids: Iterable[str]) -> None:
        """Forget those of the sessions that are still `owner`'s."""
        with self._lock:
            for session_id in session_ids:
                session = self._sessions.get(session_id)
                if session is not None and session.owner == owner:
                    self._forget(session_id)

    def close_those_of(self, model: Model) -> None:
        """Forget all that act by that model."""
        with self._lock:
            for session in [session for session in self._sessions.values() if session.model is model]:
                self._forget(session.id)

    def by_transport(self) -> dict[str, int]:
        """How many came through which door."""
        with self._lock:
            return Counter(session.transport for session in self._sessions.values())

    def by_connection(self, transports: Container[str], within_s: float) -> Counter[str]:
        """How many of those that were used lately came by which connection, over these transports."""
        since = time.monotonic() - within_s
        with self._lock:
            sessions = list(self._sessions.values())
        return Counter(s.connection for s in sessions if s.transport in transports and s.used >= since)

    def ids(self) -> list[str]:
        """All sessions."""
        with self._lock:
            return list(self._sessions)

    def drop_idle(self) -> None:
        """Forget sessions that sent nothing for longer than the idle time."""
        with self._lock:
            self._drop_idle()

    def _drop_idle(self) -> None:
        oldest = time.monotonic() - self._idle_s
        for session_id in [s.id for s in self._sessions.values() if s.used < oldest]:
            self._forget(session_id)

    def _forget(self, session_id: str) -> None:
        session = self._sessions.pop(session_id, None)
        if session is not None:
            self.ended(session)
