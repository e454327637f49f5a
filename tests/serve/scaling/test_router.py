"""What Serve's Python proxy does with a request when no replica runs."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest
from ray.serve._private.common import DeploymentHandleSource
from ray.serve._private.http_util import get_http_response_status
from ray.serve.experimental.consistent_hash_router import ConsistentHashRouter

from vlagents_ray.serve.scaling import router
from vlagents_ray.serve.scaling.router import SessionRouter, _NoReplica

PROXY, REPLICA = DeploymentHandleSource.PROXY, DeploymentHandleSource.REPLICA


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Serve's own choice, which takes 0.3 s; what became of it."""
    became: list[str] = []

    async def choose(self: Any, request: Any, *, is_retry: bool) -> str:
        try:
            await asyncio.sleep(0.3)
        except asyncio.CancelledError:
            became.append("cancelled")
            raise
        return "a replica"

    monkeypatch.setattr(ConsistentHashRouter, "_choose_replica_for_request", choose)
    return became


def choose(source: DeploymentHandleSource, replicas: list[str], wait_s: float, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(router, "_WAIT_S", wait_s)
    one = SessionRouter.__new__(SessionRouter)
    one._handle_source, one._replicas = source, replicas
    one._deployment_id = SimpleNamespace(app_name="app")

    async def chosen() -> Any:
        found = await one._choose_replica_for_request(SimpleNamespace())
        await asyncio.sleep(0)
        return found

    return asyncio.run(chosen())


def test_a_proxy_answers_503_and_forgets_the_request(waits: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(_NoReplica, match="no replica of application 'app' runs") as refused:
        choose(PROXY, [], 0.01, monkeypatch)
    assert waits == ["cancelled"]
    status = get_http_response_status(refused.value, None, "1")
    assert (status.code, status.headers) == (503, [(b"retry-after", b"1")])


@pytest.mark.parametrize(
    ("source", "replicas", "wait_s"), [(PROXY, ["one"], 0.01), (REPLICA, [], 0.01), (PROXY, [], 30)]
)
def test_others_wait_and_so_does_who_waits_for_a_replica_that_is_busy(
    source: DeploymentHandleSource,
    replicas: list[str],
    wait_s: float,
    waits: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert choose(source, replicas, wait_s, monkeypatch) == "a replica"
    assert waits == []
