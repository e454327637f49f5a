"""The gateway itself, as Ray Serve uses it; its dialects have tests of their own."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gr00t_client import PolicyClient
from in_process_replicas import Replicas
from rpyc_client import Client, document

from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.dialects import gateway as module
from vlagents_ray.serve.dialects.gateway import Gateway
from vlagents_ray.serve.ports import free_port


class Port:
    """A dialect that was served."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.open = True

    def alive(self) -> bool:
        return self.open

    def close(self) -> None:
        self.open = False


def gateway(*ports: Port) -> Any:
    made = SimpleNamespace(_dialects=[])
    made._dialects += ports
    return made


def test_a_gateway_that_ends_closes_its_dialects() -> None:
    ports = Port("gr00t"), Port("vlagents")
    asyncio.run(Gateway.__del__(gateway(*ports)))
    assert not any(port.open for port in ports)


def test_a_gateway_of_which_a_dialect_has_failed_is_not_healthy() -> None:
    ports = Port("gr00t"), Port("vlagents")
    Gateway.check_health(gateway(*ports))
    ports[1].close()
    with pytest.raises(PolicyUnavailable, match="vlagents"):
        Gateway.check_health(gateway(*ports))


def test_a_gateway_serves_each_dialect_of_the_deployment_on_its_port(
    replicas: Replicas, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module.serve, "get_replica_context", lambda: SimpleNamespace(app_name="noop"))
    monkeypatch.setattr(module, "wait_for_policy", lambda _app: None)
    monkeypatch.setattr(module, "_connector", lambda *_, **_options: lambda *_: replicas.agent())
    ports = {"vlagents": free_port(), "gr00t": free_port()}
    stated = {name: {"port": port} for name, port in ports.items()} | {"openvla": {}}
    args = ServerArgs(policy="noop", dialects=stated)
    made = gateway()
    Gateway._open(made, args)
    try:
        Gateway.check_health(made)
        with Client(ports["vlagents"]) as client:
            assert client.act(document(7))[0] == 7
        video, state = np.full((1, 1, 8, 8, 3), 9, np.uint8), np.full((1, 1, 2), 0.5, np.float32)
        with PolicyClient(ports["gr00t"]) as robot:
            actions, _ = robot.get_action({"video": {"front": video}, "state": {"arm": state}, "language": {}})
        assert actions["action"][0, 0, :2].tolist() == [9, 0.5]
    finally:
        asyncio.run(Gateway.__del__(made))
    assert not any(dialect.alive() for dialect in made._dialects)
