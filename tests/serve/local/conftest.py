"""A door over an engine without Ray."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from local_door import LIMITS, Keeper

from vlagents_ray.serve.engine import Engine
from vlagents_ray.serve.local import LocalDoor


@pytest.fixture
def served() -> Iterator[tuple[Engine, LocalDoor]]:
    engine = Engine(Keeper(), session_limit=50)
    door = LocalDoor(engine, LIMITS)
    door.open()
    engine.start()
    yield engine, door
    engine.close()
    door.close()
