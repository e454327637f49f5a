"""An endpoint over an engine without Ray."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from shm_client import LIMITS, Keeper

from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints.shm import ShmServer
from vlagents_ray.serve.engine.engine import Engine


@pytest.fixture
def served() -> Iterator[tuple[Engine, ShmServer]]:
    engine = Engine(Keeper(), session_limit=50)
    endpoint = ShmServer(engine, LIMITS, NoKey.OPEN)
    endpoint.open()
    engine.start()
    yield engine, endpoint
    engine.close()
    endpoint.close()
