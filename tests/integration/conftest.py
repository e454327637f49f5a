"""Real servers on real Ray."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from ray_processes import processes, ray_folder
from shared_ray import shared_server

from vlagents_ray.serve.launch.deployment_file import Deployment, deployment
from vlagents_ray.serve.launch.server import Server

SUPPORT = Path(__file__).parent.parent / "support"


def pytest_itemcollected(item: pytest.Item) -> None:
    """Each test of this folder has a real server."""
    item.add_marker("server")


@pytest.fixture(scope="module")
def ledger(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder where the replicas of `served_agents:Ledger` write down their acts."""
    return tmp_path_factory.mktemp("ledger")


@pytest.fixture(scope="session", autouse=True)
def importable_agents() -> Iterator[None]:
    """`served_agents` for this process and for the workers that it starts."""
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = f"{SUPPORT}:{before}" if before else str(SUPPORT)
    sys.path.append(str(SUPPORT))
    yield
    sys.path.remove(str(SUPPORT))
    os.environ.pop("PYTHONPATH")
    if before is not None:
        os.environ["PYTHONPATH"] = before


@pytest.fixture
def ray_home() -> Iterator[Path]:
    """A folder for the Ray of a command, of which nothing may run at the end."""
    with ray_folder() as folder:
        yield folder
        assert not processes(folder), "left running"


def deploy(config: Deployment) -> None:
    """Have Serve deploy the file, as `serve deploy` does with one that was changed."""
    from ray.serve.context import _get_global_client

    client = _get_global_client()
    assert client is not None
    client.deploy_apps(config.for_serve())


def states(app: str) -> dict[str, int]:
    """Replicas of an application's policy by what they do."""
    from ray import serve

    return dict(serve.status().applications[app].deployments["Policy"].replica_states)


@contextmanager
def serving(policy: str, **args: Any) -> Iterator[Server]:
    """A server of one policy on the Ray that test files share: for files that take the fixture
    `shared_ray`.
    """
    with shared_server(deployment(policy, **args)) as server:
        yield server
