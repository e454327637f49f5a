"""The handling of a request by Serve's Python proxy while no replica runs."""

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


def choose(
    source: DeploymentHandleSource,
    replicas: list[str],
    wait_s: float,
    monkeypatch: pytest.MonkeyPatch,
    *,
    choice_s: float,
) -> tuple[Any, list[str]]:
    """Return the result of the proxy's choice with a wait of `wait_s`, when Serve's own choice
    takes `choice_s`, and the fate of that choice.
    """
    became: list[str] = []

    async def serves_own(self: Any, request: Any, *, is_retry: bool) -> str:
        try:
            await asyncio.sleep(choice_s)
        except asyncio.CancelledError:
            became.append("cancelled")
            raise
        return "a replica"

    monkeypatch.setattr(router, "_WAIT_S", wait_s)
    monkeypatch.setattr(ConsistentHashRouter, "_choose_replica_for_request", serves_own)
    one = SessionRouter.__new__(SessionRouter)
    one._handle_source, one._replicas = source, replicas
    one._deployment_id = SimpleNamespace(app_name="app")

    async def chosen() -> Any:
        try:
            return await one._choose_replica_for_request(SimpleNamespace())
        except _NoReplica as refused:
            return refused
        finally:
            await asyncio.sleep(0)

    return asyncio.run(chosen()), became


def test_a_proxy_answers_503_and_forgets_the_request(monkeypatch: pytest.MonkeyPatch) -> None:
    refused, choice = choose(PROXY, [], 0.01, monkeypatch, choice_s=3600)
    assert "no replica of application 'app' runs" in str(refused)
    assert choice == ["cancelled"]
    status = get_http_response_status(refused, None, "1")
    assert (status.code, status.headers) == (503, [(b"retry-after", b"1")])


@pytest.mark.parametrize(
    ("source", "replicas", "wait_s"), [(PROXY, ["one"], 0.01), (REPLICA, [], 0.01), (PROXY, [], 30)]
)
def test_others_wait_and_so_does_who_waits_for_a_replica_that_is_busy(
    source: DeploymentHandleSource,
    replicas: list[str],
    wait_s: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert choose(source, replicas, wait_s, monkeypatch, choice_s=0.1) == ("a replica", [])
