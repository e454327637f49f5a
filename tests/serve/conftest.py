"""Engines in the test's process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from vlagents_ray.interface import Agent
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings


@pytest.fixture
def serving() -> Iterator[Callable[..., Engine]]:
    """Return a function that starts engines, which are closed after the test."""
    engines: list[Engine] = []

    def serve(agent: Agent, **options: Any) -> Engine:
        engines.append(Engine(agent, EngineSettings(**options)))
        engines[-1].start()
        return engines[-1]

    yield serve
    for engine in engines:
        engine.close()
