"""Fixtures and helpers for tests with real servers on a real Ray."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from ray_processes import processes, ray_folder
from shared_ray import shared_server

from vlagents_ray.client.transports.http import HttpTransport
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.client.transports.websocket import WebSocketTransport
from vlagents_ray.serve.launch.deployment_file import Deployment, deployment
from vlagents_ray.serve.launch.server import Server

SUPPORT = Path(__file__).parent.parent / "support"

# Routes to a replica: the name of the transport, and whether its connection ends at the proxy. A
# client behind a firewall or with TLS uses the proxy.
ROUTES: dict[str, tuple[TransportName, bool]] = {
    "shm": ("shm", False),
    "websocket": ("websocket", False),
    "http": ("http", False),
    "handle": ("handle", False),
    "websocket-proxied": ("websocket", True),
    "http-proxied": ("http", True),
}


def pytest_itemcollected(item: pytest.Item) -> None:
    """Mark each test of this folder as one with a real server."""
    item.add_marker("server")


@pytest.fixture(scope="module")
def ledger(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder in which the replicas of `served_agents:Ledger` record their acts."""
    return tmp_path_factory.mktemp("ledger")


@pytest.fixture(scope="session", autouse=True)
def importable_agents() -> Iterator[None]:
    """Make `served_agents` importable in this process and in the workers that it starts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(SUPPORT), prepend=os.pathsep)
        sys.path.append(str(SUPPORT))
        yield
        sys.path.remove(str(SUPPORT))


@pytest.fixture
def reach(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], TransportName]:
    """Return a function that returns the transport of a route. If the route goes through the proxy,
    the function disables the replicas' own ports in this process.
    """

    def transport_of(route: str) -> TransportName:
        transport, is_proxied = ROUTES[route]
        if is_proxied:
            monkeypatch.setattr(HttpTransport, "_set_direct", lambda *_: None)
            monkeypatch.setattr(WebSocketTransport, "_direct", lambda *_: None)
        return transport

    return transport_of


@pytest.fixture
def ray_home() -> Iterator[Path]:
    """Yield a folder for the Ray of a command; no process of this Ray may be left at the end."""
    with ray_folder() as folder:
        yield folder
        assert not processes(folder), "left running"


def deploy(config: Deployment) -> None:
    """Deploy the file with Serve, as `serve deploy` does with a changed file."""
    from ray.serve.context import _get_global_client

    client = _get_global_client()
    assert client is not None
    client.deploy_apps(config.for_serve())


def states(app: str) -> dict[str, int]:
    """Return the number of replicas of an application's policy by state."""
    from ray import serve

    return dict(serve.status().applications[app].deployments["Policy"].replica_states)


@contextmanager
def serving(policy: str, **args: Any) -> Iterator[Server]:
    """Run a server with one policy on the Ray that test files share. The test file must use the
    fixture `shared_ray`.
    """
    with shared_server(deployment(policy, **args)) as server:
        yield server
