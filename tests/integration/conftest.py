"""Real servers on real Ray."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from shared_ray import shared_server

from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import Server

SUPPORT = Path(__file__).parent.parent / "support"


def pytest_itemcollected(item: pytest.Item) -> None:
    """Each test of this folder has a real server."""
    item.add_marker("server")


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


@contextmanager
def serving(policy: str, **args: Any) -> Iterator[Server]:
    """A server of one policy on the Ray that test files share: for files that take the fixture `shared_ray`."""
    with shared_server(deployment(policy, **args)) as server:
        yield server
