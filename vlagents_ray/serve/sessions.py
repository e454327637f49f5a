"""Sessions: one robot or one env each, with state of its own and shared weights.

A policy is initialized once a replica. Every `reset` begins with a pristine copy of that
initialized agent, so that neither another session nor the session's own past changes an episode.
A copy shares what is heavy or cannot be copied and has its own of everything else:

- shared: attributes named in `Agent.shared`, torch parameters, JAX arrays (immutable), functions,
  classes, modules, and objects that refuse to be copied (locks, sockets, native handles);
- shared and made read-only: numpy arrays over 64 MiB, so that writing into one raises instead of
  leaking into other sessions;
- copied: all other attributes, whatever their depth.
"""

from __future__ import annotations

import io
import logging
import pickle
import sys
import threading
import time
import types
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlagents_ray.errors import PolicyUnavailable, UnknownSession
from vlagents_ray.interface import Agent

logger = logging.getLogger(__name__)

SHARED_ARRAY_BYTES = 64 * 2**20
_BY_REFERENCE = (types.FunctionType, types.BuiltinFunctionType, types.ModuleType, type, logging.Logger)
_PLAIN = (
    *(type(None), bool, int, float, complex, str, bytes, bytearray, list, tuple, dict, set, frozenset),
    pickle.PickleBuffer,  # the inside of a numpy array
)


class _Snapshot(pickle.Pickler):
    """Pickles an agent in memory, leaving out by reference what its copies share."""

    def __init__(self, file: io.BytesIO, named: list[Any]) -> None:
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self.shared: dict[int, Any] = {id(item): item for item in named}
        self.refused: set[str] = set()
        torch = sys.modules.get("torch")
        self._parameter: type | None = torch.nn.Parameter if torch is not None else None

    def persistent_id(self, obj: Any) -> int | None:
        """A key into `shared`, or None for what is copied."""
        key = id(obj)
        if key in self.shared:
            return key
        if type(obj) in _PLAIN:
            return None
        if not self._is_shared(obj):
            return None
        self.shared[key] = obj
        return key

    def _is_shared(self, obj: Any) -> bool:
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


class _Restore(pickle.Unpickler):
    def __init__(self, data: bytes, shared: dict[int, Any]) -> None:
        super().__init__(io.BytesIO(data))
        self._shared = shared

    def persistent_load(self, pid: Any) -> Any:
        return self._shared[pid]


class AgentCopies:
    """Makes copies of an initialized agent, each independent of the others."""

    def __init__(self, agent: Agent) -> None:
        file = io.BytesIO()
        named = [getattr(agent, name) for name in agent.shared if hasattr(agent, name)]
        snapshot = _Snapshot(file, [item for item in named if type(item) not in _PLAIN or item])
        snapshot.dump(agent)
        self._data = file.getvalue()
        self._shared = snapshot.shared
        if snapshot.refused:
            logger.warning(
                "%s: sessions share objects of %s, which cannot be copied; if one of them holds an episode's "
                "state, create it in reset() instead of initialize()",
                type(agent).__name__,
                sorted(snapshot.refused),
            )

    def make(self) -> Agent:
        """A pristine copy: what the agent was when `initialize` returned."""
        agent: Agent = _Restore(self._data, self._shared).load()
        return agent


@dataclass(slots=True)
class Session:
    """One robot's or env's side of a policy."""

    id: str
    agent: Agent | None = None  # None until its first `reset` succeeded
    used: float = field(default_factory=time.monotonic)
    transport: str = ""  # the door that it came through


class SessionTable:
    """The sessions of a replica, by id. Thread-safe."""

    def __init__(self, limit: int, idle_s: float) -> None:
        self._sessions: dict[str, Session] = {}
        self._limit = limit
        self._idle_s = idle_s
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._sessions)

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

    def open(self, session_id: str, transport: str = "") -> Session:
        """The session, made if it is new; `PolicyUnavailable` when the replica is full."""
        with self._lock:
            session = self._sessions.get(session_id)
            if session is None:
                if len(self._sessions) >= self._limit:
                    self._drop_idle()
                if len(self._sessions) >= self._limit:
                    raise PolicyUnavailable(
                        f"this replica holds {self._limit} sessions, its limit; "
                        f"close one, or raise sessions.limit or the number of replicas"
                    )
                session = self._sessions[session_id] = Session(session_id, transport=transport)
        session.used = time.monotonic()
        return session

    def by_transport(self) -> dict[str, int]:
        """How many came through which door."""
        with self._lock:
            return Counter(session.transport for session in self._sessions.values())

    def close(self, session_id: str) -> None:
        """Forget the session; unknown ids are none."""
        with self._lock:
            self._sessions.pop(session_id, None)

    def drop_idle(self) -> None:
        """Forget sessions that sent nothing for longer than the idle time."""
        with self._lock:
            self._drop_idle()

    def _drop_idle(self) -> None:
        oldest = time.monotonic() - self._idle_s
        for session_id in [s.id for s in self._sessions.values() if s.used < oldest]:
            del self._sessions[session_id]
