"""Replicas in this process, and a transport to them whose failures a test controls."""

from __future__ import annotations

import asyncio
import queue
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from in_flight import Calls, answered

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.client.connection import Connection
from vlagents_ray.client.transports.base import CodecChoice, ReplicaWatch
from vlagents_ray.errors import ConnectionLost, DeadlineExceeded, PolicyUnavailable, UnknownApp
from vlagents_ray.interface import Agent
from vlagents_ray.protocol.frames import (
    decode_replies,
    decode_requests,
    encode_replies,
    encode_requests,
)
from vlagents_ray.protocol.messages import (
    DEFAULT_LIMITS,
    PROTOCOL_VERSION,
    Budget,
    Reply,
    Request,
)
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.access.charges import free
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import Sender
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.models.loaded_model import PolicySource
from vlagents_ray.serve.scaling.session_migration import Peer, PeerEnded, SessionMigrator
from vlagents_ray.serve.sessions import SessionState


class Replicas:
    """Engines of one policy that know each other. Requests are sent to the first engine that is
    alive and not stopping.
    """

    def __init__(
        self,
        agents: Sequence[Agent | PolicySource],
        *,
        wall_clock: Callable[[], int] = time.time_ns,
        **options: Any,
    ) -> None:
        self.dead: set[int] = set()
        self.frozen: set[int] = set()
        # Number of the replica for new connections, if it is alive and not stopping.
        self.prefer = 0
        # Whether the reply to the next frame is lost after the policy has acted.
        self.lose_reply = False
        self.stopping = False  # whether the server has no application, as at its start and stop
        self.frames: list[int] = []  # number of requests in each sent frame
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)
        self._thread.start()
        self.migrators = [
            SessionMigrator(str(number), partial(self._others, number), self._loop)
            for number in range(len(agents))
        ]
        self.engines = [
            Engine(agent, EngineSettings(**options), finder=finder, wall_clock=wall_clock)
            for agent, finder in zip(agents, self.migrators, strict=True)
        ]
        for migrator, engine in zip(self.migrators, self.engines, strict=True):
            migrator.start(engine)
            engine.start()

    def agent(self, **options: Any) -> RemoteAgent:
        """Return a client of the replicas."""
        agent = RemoteAgent("http://127.0.0.1:9", **options)
        timeout_s, resume = options.get("timeout_s", 30.0), options.get("resume", True)
        new_transport = partial(InProcess, self)
        agent._connection = Connection(
            agent.url, new_transport, CodecChoice("raw"), timeout_s, 30.0, leaves_silent=resume
        )
        return agent

    def close(self) -> None:
        """Close all engines."""
        for migrator in self.migrators:
            asyncio.run_coroutine_threadsafe(migrator.close(), self._loop).result(30)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()
        for engine in self.engines:
            engine.close()

    def hand_over(self, number: int) -> int:
        """Hand over the sessions of a replica, as if it stopped; return how many sessions the other
        replicas adopted.
        """
        held = self.engines[number].sessions.ids()
        asyncio.run_coroutine_threadsafe(self.migrators[number].hand_over(), self._loop).result(30)
        others = [engine for engine in self.engines if engine is not self.engines[number]]
        return sum(session in engine.sessions for session in held for engine in others)

    async def _others(self, me: int) -> list[Peer]:
        return [_Peer(self, number) for number in range(len(self.engines)) if number != me]


class InProcess:
    """A transport that passes frames to an engine in this process."""

    name = "in process"
    holds_sessions = True

    def __init__(self, replicas: Replicas, watch: ReplicaWatch | None = None) -> None:
        """Create a transport to `replicas`, without pings."""
        self._replicas = replicas
        self._sender: Sender | None = None
        self._number = -1

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """Connect to the preferred replica, or to the first that is available."""
        if self._replicas.stopping:
            raise UnknownApp("no application at this path")
        numbered = sorted(
            enumerate(self._replicas.engines), key=lambda one: one[0] != self._replicas.prefer
        )
        for number, engine in numbered:
            if number not in self._replicas.dead | self._replicas.frozen and not engine.draining:
                self._number, self._sender = (
                    number,
                    Sender(engine, "in process", caller=NoKey.OPEN, has_left=None, can_move=True),
                )
                contract = engine.contract
                return {
                    "protocol": PROTOCOL_VERSION,
                    "contract": contract.to_json() if contract else None,
                }
        raise PolicyUnavailable("no replica is alive")

    def call(self, requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        """Send a frame and return its replies."""
        if self._sender is None:
            raise PolicyUnavailable("not connected")
        self._replicas.frames.append(len(requests))
        if self._number in self._replicas.dead:
            self.close()
            raise ConnectionLost("the replica is dead")
        if self._number in self._replicas.frozen:
            time.sleep(timeout_s)
            raise DeadlineExceeded("no answer")
        answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        frame = encode_requests(requests)
        decoded = decode_requests(frame, Budget(DEFAULT_LIMITS))
        self._sender.send(
            self._sender.message(free(NoKey.OPEN)),
            decoded,
            Calls(lambda replies: answers.put(encode_replies(replies))),
        )
        try:
            answer = answers.get(timeout=timeout_s)
        except queue.Empty:
            raise DeadlineExceeded("no answer") from None
        if self._replicas.lose_reply:
            self._replicas.lose_reply = False
            self.close()
            raise ConnectionLost("the reply was lost")
        return decode_replies(answer)

    def close(self) -> None:
        """End the connection."""
        if self._sender is not None:
            self._sender.release()
            self._sender = None


class _Peer(Peer):
    def __init__(self, replicas: Replicas, number: int) -> None:
        self.name = str(number)
        self._replicas = replicas
        self._number = number

    async def ask(self, method: Any, *args: Any, **kwargs: Any) -> Any:
        """Call a method of the other replica in this process."""
        if self._number in self._replicas.dead:
            raise PeerEnded(self.name)
        if self._number in self._replicas.frozen:
            await asyncio.sleep(60)
        sessions = self._replicas.migrators[self._number].sessions
        return await getattr(sessions, method.__name__)(*args)


def export(engine: Engine, session_id: str) -> SessionState | None:
    """Take a session out of a replica, as a replica does that adopts the session; return None if
    the session must stay.
    """
    copied = answered(engine, session_id, Request("export"))
    if copied.info is None:
        return None
    state = SessionState.from_info(copied.info)
    released = answered(engine, session_id, Request("release", kwargs={"version": state.version}))
    assert released.info == {"released": True}
    return state
