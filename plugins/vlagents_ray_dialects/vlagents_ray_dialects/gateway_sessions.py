"""The clients of a gateway and their sessions, whose episodes begin as in `ImplicitEpisode`.

The gateway enforces the permissions of the client's key, since not every transport to a replica
contains a key: each message is charged to the key (`vlagents_ray.serve.access.charges`), each
session counts towards its limit of sessions, and the key's priority applies to all its requests.
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
from vlagents_ray.serve.access.charges import Account, Charge
from vlagents_ray.serve.dialects.base import Connect, GatewayContext, ImplicitEpisode, raise_first

logger = logging.getLogger(__name__)

_QUIET_S = 30.0  # the time without a request after which a client without a session is removed


class GatewaySessions:
    """The sessions of one client, all over one connection; not thread-safe.

    `show` sets the client, and must be called before any other method.

    Args:
        connect: Opens a connection to the policy.
        contract: The contract of the policy.
    """

    def __init__(self, connect: Connect, contract: Contract | None) -> None:
        self._connect = connect
        self._contract = contract
        self.account = Account()  # has no caller until `show` is called
        self._key: str | None = None
        self._priority: PriorityName | None = None

        self._counted_sessions = 0  # the number of sessions that count towards the limit of the key
        self._agents: list[RemoteAgent] = []
        self._episodes: list[ImplicitEpisode] = []  # the episode of each of `_agents`

    @property
    def known(self) -> bool:
        """Whether the client has sent a valid key, or needs none."""
        return self.account.caller is not None

    @property
    def begun(self) -> bool:
        """Whether the client has a session."""
        return bool(self._agents)

    def reset(
        self, charge: Charge, obs: Obs, instruction: str | None, **kwargs: Any
    ) -> dict[str, Any]:
        """Begin the next episode of the client's only session.

        Args:
            charge: The charge of the client's message; `account` created it when the message
                arrived.
            obs: The observation.
            instruction: The task in words.
            kwargs: Further options of the reset.

        Returns:
            The info of the reply.
        """
        agent = self._sessions(1)[0]
        charge.cover(1)
        self.restart()
        info = agent.reset(obs, instruction, **kwargs)
        self._episodes[0].began(instruction)
        return info

    def act(self, charge: Charge, obs: Obs, instruction: str | None) -> Act:
        """Return the next action of the client's only session; a new instruction resets the
        session first.
        """
        return self.act_batch(charge, [obs], [instruction])[0]

    def act_on(self, charge: Charge, obs: Obs) -> Act:
        """Return the next action of the client's only session, without resetting it.

        Raises:
            NotReset: The session has not been reset.
        """
        agent = self._sessions(1)[0]
        charge.cover(1)
        return agent.act(obs)

    def act_batch(
        self, charge: Charge, obs: Sequence[Obs], instructions: Sequence[str | None]
    ) -> list[Act]:
        """Reset the sessions with a new instruction, and return the next action of each session, as
        `vlagents_ray.serve.dialects.base.act_together` does: of all, or of none.

        Args:
            charge: The charge of the client's message; `account` created it when the message
                arrived.
            obs: The observation of each session.
            instructions: The task of each session in words.

        Returns:
            The action of each session.

        Raises:
            TooManyRequests: The client's key is over its rate; nothing was acted on.
            VLAgentsError: The first error of a session.
        """
        held = len(self._agents)
        agents = self._sessions(len(obs))
        charge.cover(len(obs))

        texts = [episode.instruction for episode in self._episodes]
        beginning = []  # the indices of the sessions whose episode begins
        for i, instruction in enumerate(instructions):
            if self._episodes[i].begins(instruction):
                beginning.append(i)
                texts[i] = self._episodes[i].opening(instruction, self._contract)

        self.restart()  # The change is undone below when all sessions have replied.
        if beginning:
            caller = self.account.caller
            if isinstance(caller, Caller):
                caller.note("reset sessions by a gateway:", str(len(beginning)))
            infos = agents[0].reset_batch(
                [obs[i] for i in beginning],
                [texts[i] for i in beginning],
                [agents[i] for i in beginning],
            )
            self._require_all(infos, held)

        acts = agents[0].act_batch(obs, agents)
        failed = [act for act in acts if isinstance(act, Exception)]
        # If the policy has acted on some of the observations, all episodes begin again.
        if not failed or len(failed) == len(acts):
            for i, episode in enumerate(self._episodes):
                if not failed or i not in beginning:
                    episode.began(texts[i])
        self._require_all(acts, held)
        return [act for act in acts if isinstance(act, Act)]

    def _require_all(self, results: Sequence[object], held: int) -> None:
        """Raise the first error among the results of the client's sessions, after ending all but
        the first `held` sessions.
        """
        if any(isinstance(result, Exception) for result in results):
            self._end_after(held)
        raise_first(results)

    def show(self, caller: Identity, key: str | None) -> None:
        """Set the client; end the sessions of another client, or of another priority.

        Args:
            caller: The client.
            key: Its API key, or None.
        """
        priority = caller.priority if isinstance(caller, Caller) else None
        if caller != self.account.caller or priority != self._priority:
            self.close()
            self.account.identify(caller)
            self._key = key
            self._priority = priority
            if isinstance(caller, Caller):
                caller.note("let in by", "a gateway")

    def refusal(self) -> str | None:
        """Return the reason why the client's key is no longer valid; None if it is valid or not
        needed.
        """
        caller = self.account.caller
        return caller.refusal() if isinstance(caller, Caller) else None

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
        """Return this number of sessions; begin missing ones, and end surplus ones."""
        if not self.known:
            raise TypeError("a session without a client: call show() first")
        # Sessions are counted before they are created, and until they have ended.
        self._hold(max(number, self._counted_sessions))
        if not self._agents:
            self._agents = [self._connect(self._key, self._priority)]
        self._end_after(number)

        missing = number - len(self._agents)
        if missing:
            self._agents += self._agents[0].sessions(missing)
        while len(self._episodes) < number:
            self._episodes.append(ImplicitEpisode())
        return self._agents

    def _end_after(self, number: int) -> None:
        """End all but the first `number` sessions."""
        for agent in self._agents[number:]:
            agent.close()
        del self._agents[number:], self._episodes[number:]
        self._hold(min(number, self._counted_sessions))

    def _hold(self, number: int) -> None:
        """Set the number of sessions that count for the key; raise `TooManyRequests` beyond its
        limit.
        """
        caller = self.account.caller
        if isinstance(caller, Caller) and number != self._counted_sessions:
            caller.hold(number - self._counted_sessions)
        self._counted_sessions = number


def internal_error(dialect: str) -> str:
    """Log the current exception under a new id, and return the text for the client.

    Args:
        dialect: The name of the dialect.
    """
    error_id = uuid.uuid4().hex
    logger.exception("%s: request %s failed", dialect, error_id)
    return f"internal error; the server's log has the details under {error_id}"


# Clients of a dialect whose protocol has no message that ends a session.


class GatewayClient(abc.ABC):
    """One client, with its sessions.

    Args:
        context: The context of the gateway.
    """

    def __init__(self, context: GatewayContext) -> None:
        self.sessions = GatewaySessions(context.connect, context.contract)
        self._context = context
        self._unanswered = 0  # the number of requests without a reply
        self._used = time.monotonic()  # the time of the last reply, s

    def quiet_s(self, now: float) -> float:
        """Return the time since the client's last request, s; 0 while a request is unanswered."""
        return 0.0 if self._unanswered else now - self._used

    @abc.abstractmethod
    def end(self) -> None:
        """End the client's sessions after the current request."""


Key = TypeVar("Key", bound=Hashable)
Client = TypeVar("Client", bound=GatewayClient)


class GatewayClients(Generic[Key, Client]):
    """The clients by their identity in the protocol, at most as many as the context allows
    sessions. Thread-safe.

    Args:
        context: The context of the gateway.
    """

    def __init__(self, context: GatewayContext) -> None:
        self._context = context
        self._clients: dict[Key, Client] = {}
        self._lock = threading.Lock()

    def get(self, key: Key) -> Client | None:
        """Return a client; None if it is unknown or was removed."""
        return self._clients.get(key)

    def add(self, key: Key, make: Callable[[], Client]) -> Client:
        """Add a client, or replace the client with the same key.

        If there are too many clients, the client without a session that has been idle for the
        longest time is removed.

        Args:
            key: The identity of the client.
            make: Creates the client.

        Returns:
            The new client.

        Raises:
            PolicyUnavailable: There are too many clients, and each has a session or an unanswered
                request.
        """
        removed = []
        try:
            with self._lock:
                replaced = self._clients.pop(key, None)
                if replaced is not None:
                    removed.append(replaced)
                if len(self._clients) >= self._context.sessions:
                    removed.append(self._clients.pop(self._idlest()))
                client = make()
                self._clients[key] = client
                return client
        finally:
            _end(removed)

    def remove(self, key: Key) -> None:
        """Remove a client that has ended, unless it was removed already."""
        with self._lock:
            self._clients.pop(key, None)

    def end(self, key: Key) -> None:
        """End the sessions of a client that has disconnected, and remove it."""
        with self._lock:
            client = self._clients.pop(key, None)
        if client is not None:
            client.end()

    def forget_quiet(self) -> None:
        """End the sessions of idle clients and of clients whose key is no longer valid."""
        with self._lock:
            gone_keys = [key for key, client in self._clients.items() if self.is_gone(client)]
            gone = [self._clients.pop(key) for key in gone_keys]
        _end(gone)

    def end_all(self) -> list[Client]:
        """End the sessions of all clients, and return the clients."""
        with self._lock:
            clients = list(self._clients.values())
        return _end(clients)

    def is_gone(self, client: Client) -> bool:
        """Return whether a client is idle, or its key is no longer valid."""
        limit_s = self._context.idle_s
        if not client.sessions.begun:
            limit_s = min(_QUIET_S, limit_s)
        is_idle = client.quiet_s(time.monotonic()) > limit_s
        return is_idle or client.sessions.refusal() is not None

    def _idlest(self) -> Key:
        """Return the key of the client without a session that has been idle for the longest time;
        raise `PolicyUnavailable` if there is none.
        """
        now = time.monotonic()
        longest_s = 0.0
        idlest: Key | None = None
        for key, client in self._clients.items():
            quiet_s = client.quiet_s(now)
            if not client.sessions.begun and quiet_s > longest_s:
                longest_s, idlest = quiet_s, key

        if idlest is None:
            raise PolicyUnavailable(
                f"{len(self._clients)} clients are connected, the limit; try again later"
            )
        return idlest


def _end(clients: list[Client]) -> list[Client]:
    """End the sessions of clients, and return the clients."""
    for client in clients:
        client.end()
    return clients
