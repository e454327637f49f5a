"""Many clients at the same time: batches are full, each client gets its own answers, and the number
of replicas follows the load.
"""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from eval_fakes import wait_for
from ray import serve

from tests.integration.conftest import serving
from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.client.transports.select import TransportName

CLIENTS, ACTS = 24, 8
FROM_NONE = {
    "min_replicas": 0,
    "max_replicas": 2,
    "look_back_s": 2,
    "upscale_delay_s": 0.5,
    "downscale_delay_s": 1,
}
TRANSPORTS: list[TransportName] = ["shm", "websocket"]


def play(url: str, transport: TransportName, client: int) -> list[int]:
    """Return the sizes of the batches that contained one client's observations."""
    with RemoteAgent(url, transport=transport, connect_timeout_s=120) as agent:
        agent.reset(Obs({"front": np.zeros((8, 8, 3), np.uint8)}), f"client {client}")
        return [int(agent.act(Obs()).info["timing"]["batch_size"]) for _ in range(ACTS)]


@pytest.mark.slow
def test_what_waits_while_a_batch_runs_is_the_next_batch(shared_ray: None) -> None:
    """A batch takes 100 ms plus 1 ms per observation, and there are 24 clients. Serve's default of
    5 requests at a time must not limit the batch.
    """
    with serving(
        "noop", config={"base_ms": 100, "per_item_ms": 1}, batch={"max_size": 16}
    ) as server:
        for transport in ("shm", "websocket", "http"):
            with ThreadPoolExecutor(CLIENTS) as pool:
                sizes = list(
                    pool.map(lambda i, t=transport: play(server.url, t, i), range(CLIENTS))
                )  # type: ignore[misc]
            flat = [size for one in sizes for size in one]
            assert len(flat) == CLIENTS * ACTS
            assert 5 < max(flat) <= 16, (transport, flat)


def act_until(url: str, transport: TransportName, stop: threading.Event) -> int:
    """Act until `stop` is set, and return the number of acts. An error fails the test."""
    acts = 0
    with RemoteAgent(url, transport=transport, connect_timeout_s=120) as agent:
        agent.reset(Obs(), "load")
        while not stop.is_set():
            agent.act(Obs())
            acts += 1
    return acts


def replicas() -> int:
    """Return the number of running replicas."""
    (app,) = serve.status().applications.values()
    return sum(d.replica_states.get("RUNNING", 0) for d in app.deployments.values())


def gone() -> bool:
    """Return whether all replicas have ended, including those that were stopping."""
    (app,) = serve.status().applications.values()
    return not any(
        number
        for deployment in app.deployments.values()
        for number in deployment.replica_states.values()
    )


@pytest.mark.slow
def test_replicas_come_from_none_and_go_to_none_and_no_step_fails(shared_ray: None) -> None:
    with serving(
        "noop", config={"base_ms": 40}, batch={"max_size": 1}, autoscaling=FROM_NONE
    ) as server:
        wait_for(gone)
        stop = threading.Event()
        with ThreadPoolExecutor(4) as pool:
            robots = [
                pool.submit(act_until, server.url, transport, stop) for transport in 2 * TRANSPORTS
            ]
            try:
                wait_for(lambda: replicas() == 2 or any(robot.done() for robot in robots))
            finally:
                stop.set()
            assert min(robot.result() for robot in robots) > 0
        wait_for(gone)
        for transport in TRANSPORTS:
            with RemoteAgent(server.url, transport=transport, connect_timeout_s=120) as late:
                late.reset(Obs(), "after the quiet")
                assert late.act(Obs()).action.shape == (7,)
