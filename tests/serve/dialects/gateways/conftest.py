"""Dialects with a port of their own, over engines in this process: real sockets, no Ray."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from in_process_replicas import Replicas
from served_agents import Witness

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.protocol.messages import Limits, RankName
from vlagents_ray.registry import dialect_class
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.dialects.base import Connect, GatewayContext, PortDialect
from vlagents_ray.serve.ports import free_port, reserve

LIMITS = Limits(body_bytes=2 * 2**20)
OpenPort = Callable[..., int]


@pytest.fixture(name="replicas")
def one_replica() -> Iterator[Replicas]:
    replicas = Replicas([Witness()])
    yield replicas
    replicas.close()


@pytest.fixture
def open_vlagents(replicas: Replicas) -> Iterator[OpenPort]:
    """Serve vlagents' clients; returns the port."""
    yield from _opened(replicas, "vlagents")


@pytest.fixture
def open_gr00t(replicas: Replicas) -> Iterator[OpenPort]:
    """Serve GR00T's clients; returns the port."""
    yield from _opened(replicas, "gr00t")


@pytest.fixture
def open_lerobot(replicas: Replicas) -> Iterator[OpenPort]:
    """Serve LeRobot's asynchronous clients; returns the port."""
    yield from _opened(replicas, "lerobot")


def _connector(replicas: Replicas) -> Connect:
    def connect(_key: str | None, rank: RankName | None) -> RemoteAgent:
        return replicas.agent(rank=rank or "robot")

    return connect


def _opened(replicas: Replicas, name: str) -> Iterator[OpenPort]:
    dialects: list[PortDialect] = []

    def open_port(sessions: int = 8, idle_s: float = 30.0, check: Any = NoKey.OPEN, **settings: object) -> int:
        cls = dialect_class(name)
        config = cls.Config(port=free_port(), **settings)
        context = GatewayContext("noop", _connector(replicas), LIMITS, sessions, idle_s, None, check)
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
