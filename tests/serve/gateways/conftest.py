"""Doors in this process, in front of engines in this process: real sockets, no Ray."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from in_process import Replicas
from served_agents import Witness

from vlagents_ray.serve.cluster import free_port
from vlagents_ray.serve.gateways.config import GR00TArgs, VlagentsArgs
from vlagents_ray.serve.gateways.door import House, reserve
from vlagents_ray.serve.gateways.gr00t import GR00TDoor
from vlagents_ray.serve.gateways.vlagents import VlagentsDoor
from vlagents_ray.wire.messages import Limits

LIMITS = Limits(body_bytes=2 * 2**20)
OpenDoor = Callable[..., int]


@pytest.fixture(name="replicas")
def one_replica() -> Iterator[Replicas]:
    replicas = Replicas([Witness()])
    yield replicas
    replicas.close()


@pytest.fixture(name="open_vlagents")
def vlagents_doors(replicas: Replicas) -> Iterator[OpenDoor]:
    """Open a door; returns its port."""

    def make(house: House, settings: VlagentsArgs) -> VlagentsDoor:
        with contextlib.ExitStack() as stack:
            listener = stack.enter_context(reserve("vlagents", "127.0.0.1", settings.port))
            door = VlagentsDoor(house, settings, listener, "0")
            stack.pop_all()
        return door

    yield from _opened(replicas, VlagentsArgs, make)


@pytest.fixture(name="open_gr00t")
def gr00t_doors(replicas: Replicas) -> Iterator[OpenDoor]:
    """Open a door; returns its port."""

    def make(house: House, settings: GR00TArgs) -> GR00TDoor:
        return GR00TDoor(house, settings, reserve("gr00t", "127.0.0.1", settings.port))

    yield from _opened(replicas, GR00TArgs, make)


def _opened(replicas: Replicas, args: type, make: Callable[[House, Any], Any]) -> Iterator[OpenDoor]:
    doors: list[Any] = []

    def open_door(sessions: int = 8, idle_s: float = 30.0, check: object = None, **settings: object) -> int:
        chosen = args(port=free_port(), **settings)
        house = House("noop", lambda _: replicas.agent(), LIMITS, sessions, idle_s, None, check)  # type: ignore[arg-type]
        doors.append(make(house, chosen))
        doors[-1].open()
        port: int = chosen.port
        return port

    yield open_door
    for door in doors:
        assert door.alive()
        door.close()
        assert not door.alive()
