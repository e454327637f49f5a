"""Replicas in this process, and a transport to them that breaks when told to."""

from __future__ import annotations

import queue
from collections.abc import Sequence
from typing import Any

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.client.connection import Connection
from vlagents_ray.client.link import CodecChoice
from vlagents_ray.errors import ConnectionLost, DeadlineExceeded, PolicyUnavailable, UnknownApp
from vlagents_ray.interface import Agent
from vlagents_ray.serve.calls import Sender
from vlagents_ray.serve.checkpoints import Checkpoints
from vlagents_ray.serve.engine import Engine
from vlagents_ray.serve.moving import Strays, export
from vlagents_ray.wire.frames import decode_replies, decode_requests, encode_replies, encode_requests
from vlagents_ray.wire.messages import PROTOCOL_VERSION, Reply, Request


class Replicas:
    """Engines of one policy that know each other; requests go to the first that lives and does not stop."""

    def __init__(self, agents: Sequence[Agent | Checkpoints]) -> None:
        self.engines = [Engine(agent) for agent in agents]
        self.dead: set[int] = set()
        self.prefer = 0  # where new connections go, if that one lives and does not stop
        self.lose_reply = False  # of the next frame, after it was acted on
        self.stopping = False  # the server has no application any more, or none yet
        self.frames: list[int] = []  # requests in each frame that was sent
        for engine in self.engines:
            engine.strays = Strays(engine, _Others(self, engine))
            engine.start()

    def agent(self, **options: Any) -> RemoteAgent:
        """A client of them."""
        agent = RemoteAgent("http://127.0.0.1:9", **options)
        agent._connection = Connection(agent.url, InProcess(self), CodecChoice("raw"), 5.0, 5.0)
        return agent

    def close(self) -> None:
        """End all engines."""
        for engine in self.engines:
            engine.strays.close()  # type: ignore[union-attr]
            engine.close()


class InProcess:
    """Frames to an engine and back."""

    name = "in process"
    holds_sessions = True

    def __init__(self, replicas: Replicas) -> None:
        self._replicas = replicas
        self._sender: Sender | None = None
        self._number = -1

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """To the preferred replica, or the first that is there."""
        if self._replicas.stopping:
            raise UnknownApp("no application at this path")
        numbered = sorted(enumerate(self._replicas.engines), key=lambda one: one[0] != self._replicas.prefer)
        for number, engine in numbered:
            if number not in self._replicas.dead and not engine.draining:
                self._number, self._sender = number, Sender(engine, "in process")
                contract = engine.contract
                return {"protocol": PROTOCOL_VERSION, "contract": contract.to_json() if contract else None}
        raise PolicyUnavailable("no replica lives")

    def call(self, requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        """As a transport does."""
        if self._sender is None:
            raise PolicyUnavailable("not connected")
        self._replicas.frames.append(len(requests))
        if self._number in self._replicas.dead:
            self.close()
            raise ConnectionLost("the replica is dead")
        answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        frame = encode_requests(requests)
        self._sender.send(decode_requests(frame), lambda replies: answers.put(encode_replies(replies)))
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
        """As when a connection ends."""
        if self._sender is not None:
            self._sender.release()
            self._sender = None


class _Others:
    def __init__(self, replicas: Replicas, me: Engine) -> None:
        self._replicas = replicas
        self._me = me

    def take(self, session_id: str) -> dict[str, Any] | None:
        return next((state for engine in self._engines() if (state := export(engine, session_id))), None)

    def give(self, session_id: str, state: dict[str, Any]) -> bool:
        for engine in self._engines():
            engine.adopt(session_id, state)
            return True
        return False

    def _engines(self) -> list[Engine]:
        engines = self._replicas.engines
        return [e for number, e in enumerate(engines) if e is not self._me and number not in self._replicas.dead]
