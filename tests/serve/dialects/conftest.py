"""All dialects over one engine."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from dialect_server import ALL, serving
from served_agents import Mirror
from starlette.testclient import TestClient

from vlagents_ray.serve.engine.engine import Engine


@pytest.fixture(scope="module", name="context")
def everything() -> Iterator[tuple[TestClient, Engine]]:
    with serving(Mirror(chunk=2), ALL) as context:
        yield context
