"""An application without a replica: the first robot brings one, a burst brings more, and quiet takes them all."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from eval_fakes import wait_for
from ray import serve

from tests.integration.conftest import serving
from tests.integration.test_load import act_until, replicas
from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.client.transports.select import TransportName

FROM_NONE = {"min_replicas": 0, "max_replicas": 2, "look_back_s": 2, "upscale_delay_s": 0.5, "downscale_delay_s": 1}
WAYS: list[TransportName] = ["shm", "websocket"]


def gone() -> bool:
    """Are even those that stop no more?"""
    (app,) = serve.status().applications.values()
    return not any(number for deployment in app.deployments.values() for number in deployment.replica_states.values())


@pytest.mark.slow
def test_replicas_come_from_none_and_go_to_none_and_no_step_fails(shared_ray: None) -> None:
    with serving("noop", config={"base_ms": 40}, batch={"max_size": 1}, autoscaling=FROM_NONE) as server:
        wait_for(gone)
        stop = threading.Event()
        with ThreadPoolExecutor(4) as pool:
            robots = [pool.submit(act_until, server.url, way, stop) for way in 2 * WAYS]
            try:
                wait_for(lambda: replicas() == 2 or any(robot.done() for robot in robots))
            finally:
                stop.set()
            assert min(robot.result() for robot in robots) > 0
        wait_for(gone)
        for way in WAYS:
            with RemoteAgent(server.url, transport=way, connect_timeout_s=120) as late:
                late.reset(Obs(), "after the quiet")
                assert late.act(Obs()).action.shape == (7,)
