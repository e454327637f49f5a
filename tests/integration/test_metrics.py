"""The metrics that Prometheus would read from a server."""

from __future__ import annotations

import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import suppress

import pytest
from eval_fakes import wait_for
from prometheus_series import scrape
from shared_ray import shared_server

from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import Server

ACTS = 30
APP = "measured"
STAGES = ("decode", "queue", "inference", "encode")


@pytest.fixture(scope="module")
def server(shared_ray: None) -> Iterator[Server]:
    config = deployment("noop", batch={"sizes": [2, 4]})
    config.applications[0].name = APP
    with shared_server(config) as server:
        yield server


def scraped() -> dict[str, float]:
    """Return the server's metrics: name and sorted tags to value."""
    found = {}
    for one in scrape():
        if one.tags["application"] != APP:  # metrics of earlier tests on this Ray
            continue
        assert one.tags["policy"] == "noop"
        assert one.tags["deployment"] == "Policy"
        assert one.tags["replica"]
        found[one.key("op", "transport", "priority", "code", "stage", "le")] = one.value
    return found


def test_prometheus_reads_requests_batches_and_load(server: Server) -> None:
    with (
        RemoteAgent(server.url, transport="shm") as near,
        RemoteAgent(f"serve://{APP}", transport="handle", priority="simulation") as inside,
    ):
        for agent in (near, inside):
            agent.reset(Obs())
            for _ in range(ACTS):
                agent.act(Obs())
        stranger = {"content-type": "application/json", "x-session-id": "nobody"}
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(
                urllib.request.Request(f"{server.url}/v1/act", b"{}", stranger), timeout=10
            )
        ok = "vlagents_requests_total code=ok op={1} priority={0} transport={2}"
        expected = {
            ok.format("robot", "reset", "shm"): 1,
            ok.format("robot", "act", "shm"): ACTS,
            ok.format("simulation", "act", "handle"): ACTS,
            "vlagents_requests_total code=unknown_session op=act priority=robot transport=http": 1,
            "vlagents_latency_ms_count op=act priority=robot transport=shm": ACTS,
            "vlagents_latency_ms_count op=act priority=simulation transport=handle": ACTS,
            "vlagents_batch_size_count": 2 * ACTS,
            "vlagents_batch_size_bucket le=1.0": 2 * ACTS,
            "vlagents_padding_rows_total": 2 * ACTS,
            "vlagents_sessions transport=shm": 1,
            "vlagents_sessions transport=handle": 1,
            "vlagents_queue_depth priority=robot": 0,
            "vlagents_queue_depth priority=simulation": 0,
            "vlagents_policy_version": 0,
        } | {f"vlagents_stage_ms_count stage={stage} transport=shm": ACTS for stage in STAGES}
        now: dict[str, float] = {}

        def complete() -> bool:
            """Return whether all metrics are present. Each is exported separately, and the load is
            that of the last second.
            """
            now.clear()
            now.update(scraped())
            return expected.items() <= now.items() and 0 <= now["vlagents_utilisation"] < 0.5

        with suppress(TimeoutError):
            wait_for(complete)
    assert {name: now.get(name) for name in expected} == expected
    assert 0 <= now["vlagents_utilisation"] < 0.5
