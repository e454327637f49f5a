"""`pip install -e .`, then `pytest` or `python test_homing.py`."""

import json
import time
import urllib.request

import numpy as np
from homing.policy import Homing

from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.registry import policy_class
from vlagents_ray.serve.launch.deployment_file import read_deployment
from vlagents_ray.serve.launch.server import running_server
from vlagents_ray.testing import check_agent

OBS = Obs(state={"joints": np.ones(3, np.float32)})
ACTION = -0.1 * np.ones(3)  # the policy's actions for this observation


def test_the_policy_is_registered_and_keeps_its_contract():
    assert policy_class("homing") is Homing
    check_agent(Homing())


def test_the_policy_moves_each_joint_towards_zero():
    np.testing.assert_allclose(Homing().act(OBS).action, ACTION, rtol=1e-6)


def counted_calls(url):
    with urllib.request.urlopen(f"{url}/homing/latency", timeout=10) as answer:
        return json.load(answer)["calls"]


def test_its_calls_are_counted_where_it_is_served():
    with running_server(read_deployment("homing.yaml")) as server, RemoteAgent(server.url) as agent:
        agent.reset(OBS, "go home")
        np.testing.assert_allclose(agent.act(OBS).action, ACTION, rtol=1e-6)
        # The part counts an answer just after the server has sent it.
        deadline = time.monotonic() + 10
        while counted_calls(server.url) == 0 and time.monotonic() < deadline:
            time.sleep(0.05)
        assert counted_calls(server.url) == 1


if __name__ == "__main__":
    test_the_policy_is_registered_and_keeps_its_contract()
    test_the_policy_moves_each_joint_towards_zero()
    test_its_calls_are_counted_where_it_is_served()
