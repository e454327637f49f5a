"""Fixtures that serve all dialects: those of the server's own port over one engine, and those with
a separate port over other engines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import pytest
from dialect_server import ALL, serving
from in_process_replicas import Replicas
from served_agents import Mirror, Witness
from starlette.testclient import TestClient

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.protocol.messages import MessageLimits, PriorityName
from vlagents_ray.registry import dialect_class
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.dialects.base import GatewayContext, PortDialect
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.ports import free_port, reserve

LIMITS = MessageLimits(body_bytes=2 * 2**20)
OpenPort = Callable[..., int]
NOTHING_STATED: Mapping[str, Any] = {"contract": None}


@pytest.fixture(scope="module", name="context")
def everything() -> Iterator[tuple[TestClient, Engine]]:
    with serving(Mirror(chunk=2), ALL) as context:
        yield context


@pytest.fixture(name="replicas")
def one_replica() -> Iterator[Replicas]:
    replicas = Replicas([Witness()])
    yield replicas
    replicas.close()


@pytest.fixture
def open_dialect(replicas: Replicas) -> Iterator[OpenPort]:
    """Return a function that serves a dialect with a separate port, by the dialect's name.
    The function returns the port.

    The argument `policy` is the policy's metadata, such as its contract.
    """
    dialects: list[PortDialect] = []

    def connect(_key: str | None, priority: PriorityName | None) -> RemoteAgent:
        return replicas.agent(priority=priority or "robot")

    def open_port(
        name: str,
        sessions: int = 8,
        idle_s: float = 30.0,
        check: Any = NoKey.OPEN,
        policy: Mapping[str, Any] = NOTHING_STATED,
        **settings: object,
    ) -> int:
        cls = dialect_class(name)
        config = cls.Config(port=free_port(), **settings)
        context = GatewayContext(
            "noop", connect, LIMITS, sessions, idle_s, check=check, **{**NOTHING_STATED, **policy}
        )
        dialect = cls(name, config, context)
        dialect.serve(reserve(name, "127.0.0.1", config.port))
        dialects.append(dialect)
        port: int = config.port
        return port

    yield open_port
    for dialect in dialects:
        assert dialect.alive()
        dialect.close()
        assert not dialect.alive()
