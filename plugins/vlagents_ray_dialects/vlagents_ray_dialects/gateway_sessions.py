"""The gateway's clients and their sessions, whose episodes begin as in `ImplicitEpisode`.

The gateway enforces the permissions of the client's key, since not every transport to a replica
contains a key: each observation (with the reset before it) counts towards the key's rate, each
session towards its limit of sessions, and the key's priority applies to all its requests.
"""

from __future__ import annotations

import abc
import logging
import threading
import time
import uuid
from collections.abc import Callable, Hashable, Sequence
from typing import Any, Generic, TypeVar

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.contract import Contract
from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.interface import Act, Obs
from vlagents_ray.protocol.messages import PriorityName
from vlagents_ray.serve.access.api_keys import Caller, Identity
from vlagents_ray.serve.dialects.base import Connect, GatewayContext, ImplicitEpisode, raise_first

logger = logging.getLogger(__name__)

_QUIET_S = 30.0  # time without a request after which a client without a session is removed


class GatewaySessions:
    """The sessions of one client, all over one connection; not thread-safe."""

    def __init__(self, connect: Connect, contract: Contract | None) -> None:
        """Prepare the sessions; `show` must be called first, with the client. `contract` is the
        policy's.
        """
        self._connect, self._contract = connect, contract
        self._caller: Identity | None = None
        self._key: str | None = None
        self._priority: PriorityName | None = None
        # Number of requests of the current message that were counted before it was read.
        self._counted = 0
        self._counted_sessions = 0  # number of sessions that are counted for the key
        self._agents: list[RemoteAgent] = []
        self._episodes: list[ImplicitEpisode] = []  # the episode of each of `_agents`

    @property
    def known(self) -> bool:
        """Whether the client has sent a valid key, or needs none."""
        return self._caller is not None

    @property
    def begun(self) -> bool:
        """Whether the client has a session."""
        return bool(self._agents)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin the next episode of the client's only session; return the reply's info."""
        agent = self._sessions(1)[0]
        self._admit(1)
        self.restart()
        info = agent.reset(obs, instruction, **kwargs)
        self._episodes[0].began(instruction)
        return info

    def act(self, obs: Obs, instruction: str | None) -> Act:
        """Return the next action of the client's only session; a new instruction resets the
        session first.
        """
        return self.act_batch([obs], [instruction])[0]

    def act_on(self, obs: Obs) -> Act:
        """Return the next action of the client's only session, without a reset; raise `NotReset`
        before the first.
        """
        agent = self._sessions(1)[0]
        self._admit(1)
        return agent.act(obs)

    def act_batch(self, obs: Sequence[Obs], instructions: Sequence[str | None]) -> list[Act]:
        """Return the next action of each session, one per observation; raise the first error
        among them.
        """
        agents = self._sessions(len(obs))
        self._admit(len(obs))

        texts = [episode.instruction for episode in self._episodes]
        fresh = [i for i, text in enumerate(instructions) if self._episodes[i].begins(text)]
        for i in fresh:
            texts[i] = self._episodes[i].opening(instructions[i], self._contract)

        self.restart()  # undone below, once all sessions have replied
        if fresh:
            if isinstance(self._caller, Caller):
                self._caller.note("reset sessions by a gateway:", str(len(fresh)))
            infos = agents[0].reset_batch(
                [obs[i] for i in fresh], [texts[i] for i in fresh], [agents[i] for i in fresh]
            )
            raise_first(infos)

        acts = agents[0].act_batch(obs, agents)
        for episode, text in zip(self._episodes, texts, strict=True):
            episode.began(text)
        raise_first(acts)
        return [act for act in acts if isinstance(act, Act)]

    def show(self, caller: Identity, key: str | None) -> None:
        """Set the client and its API key; end the sessions of another client or class."""
        priority = caller.priority if isinstance(caller, Caller) else None
        if caller != self._caller or priority != self._priority:
            self.close()
            self._caller, self._key, self._priority = caller, key, priority
            if isinstance(caller, Caller):
                caller.note("let in by", "a gateway")

    def refusal(self) -> str | None:
        """Return the reason why the client's key is no longer valid; None if it is valid or not
        needed.
        """
        return self._caller.refusal() if isinstance(self._caller, Caller) else None

    def begin(self) -> None:
        """Count a message for the key before it is read, which includes the first of its
        requests.
        """
        self._counted = 0
        self._admit(1)
        self._counted = 1

    def throttled_s(self) -> float:
        """Return the time for which not to read from the client, s; 0 unless its key is over its
        rate.
        """
        return self._caller.throttled_s() if isinstance(self._caller, Caller) else 0.0

    def restart(self) -> None:
        """Make each session reset before its next action."""
        for episode in self._episodes:
            episode.end()

    def close(self) -> None:
        """End the client's sessions; later requests begin new ones."""
        agents, self._agents, self._episodes = self._agents, [], []
        self._hold(0)
        for agent in agents:
            agent.close()

    def _sessions(self, number: int) -> list[RemoteAgent]:
        if self._caller is None:
            raise TypeError("a session without a client: call show() first")
        # Counts sessions before they exist, and until they have ended.
        self._hold(max(number, self._counted_sessions))
        if not self._agents:
            self._agents = [self._connect(self._key, self._priority)]
        for agent in self._agents[number:]:
            agent.close()
        del self._agents[number:]
        self._hold(number)

        missing = number - len(self._agents)
        if missing:
            self._agents += self._agents[0].sessions(missing)
        self._episodes = [
            *self._episodes[:number],
            *(ImplicitEpisode() for _ in range(number - len(self._episodes))),
        ]
        return self._agents

    def _hold(self, number: int) -> None:
        """Set the number of sessions that count for the key; raise `TooManyRequests` over its
        limit.
        """
        if isinstance(self._caller, Caller) and number != self._counted_sessions:
            self._caller.hold(number - self._counted_sessions)
        self._counted_sessions = number

    def _admit(self, number: int) -> None:
        """Count requests for the key; raise `TooManyRequests` over its rate, before any of them
        is sent.
        """
        counted, self._counted = self._counted, 0
        if isinstance(self._caller, Caller):
            for _ in range(number - counted):
                self._caller.admit()


def internal_error(dialect: str) -> str:
    """Log the current exception under a new id, and return the text about it for the client."""
    name = uuid.uuid4().hex
    logger.exception("%s: request %s failed", dialect, name)
    return f"internal error; the server's log has the details under {name}"


# Clients of a dialect whose protocol has no message for their end.


class GatewayClient(abc.ABC):
    """One client, with its sessions."""

    def __init__(self, context: GatewayContext) -> None:
        self.sessions = GatewaySessions(context.connect, context.contract)
        self._context = context
        self._unanswered = 0  # number of requests without a reply
        self._used = time.monotonic()  # time of the last reply, s

    def quiet_s(self, now: float) -> float:
        """Return the time since the client's last request, s; 0 while a request is unanswered."""
        return 0.0 if self._unanswered else now - self._used

    @abc.abstractmethod
    def end(self) -> None:
        """End the client's sessions after the current request."""


K = TypeVar("K", bound=Hashable)
C = TypeVar("C", bound=GatewayClient)


class GatewayClients(Generic[K, C]):
    """The clients by their identity in the protocol, at most `sessions` of the context.
    Thread-safe.
    """

    def __init__(self, context: GatewayContext) -> None:
        self._context = context
        self._clients: dict[K, C] = {}
        self._lock = threading.Lock()

    def get(self, key: K) -> C | None:
        """Return a client; None if it is unknown or was removed."""
        return self._clients.get(key)

    def add(self, key: K, make: Callable[[], C]) -> C:
        """Add a client, in place of one with the same key.

        If there are too many clients, the one without a session that has been idle for the longest
        is removed.

        Raises:
            PolicyUnavailable: There are too many clients, and each has a session or an unanswered
                request.
        """
        removed = []
        try:
            with self._lock:
                earlier = self._clients.pop(key, None)
                if earlier is not None:
                    removed.append(earlier)
                if len(self._clients) >= self._context.sessions:
                    removed.append(self._clients.pop(self._idlest()))
                client = self._clients[key] = make()
                return client
        finally:
            _end(removed)

    def remove(self, key: K) -> None:
        """Remove a client that has ended, if it is known."""
        with self._lock:
            self._clients.pop(key, None)

    def forget_quiet(self) -> None:
        """End the sessions of idle clients and of clients whose key is no longer valid."""
        with self._lock:
            removed = [key for key, client in self._clients.items() if self.is_gone(client)]
            ended = [self._clients.pop(key) for key in removed]
        _end(ended)

    def end_all(self) -> list[C]:
        """End the sessions of all clients, and return the clients."""
        with self._lock:
            clients = list(self._clients.values())
        return _end(clients)

    def is_gone(self, client: C) -> bool:
        """Return whether a client is idle, or its key is no longer valid."""
        now = time.monotonic()
        patience_s = (
            self._context.idle_s if client.sessions.begun else min(_QUIET_S, self._context.idle_s)
        )
        return client.quiet_s(now) > patience_s or client.sessions.refusal() is not None

    def _idlest(self) -> K:
        """Return the key of the client without a session that has been idle for the longest."""
        now = time.monotonic()
        longest_s = 0.0
        idlest: K | None = None
        for key, client in self._clients.items():
            quiet_s = client.quiet_s(now)
            if not client.sessions.begun and quiet_s > longest_s:
                longest_s, idlest = quiet_s, key

        if idlest is None:
            raise PolicyUnavailable(
                f"{len(self._clients)} clients are connected, the limit; try again later"
            )
        return idlest


def _end(clients: list[C]) -> list[C]:
    for client in clients:
        client.end()
    return clients
