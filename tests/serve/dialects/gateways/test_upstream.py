"""The policy `upstream` in front of our own gateways, of sessions that are those of its connections."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vlagents_ray.errors import PolicyFailed
from vlagents_ray.interface import Obs
from vlagents_ray.policies.upstream import Upstream
from vlagents_ray.serve.models.agent_copies import AgentCopies

VLAGENTS: dict[str, Any] = {
    "cameras": {"front": "arm/cameras/front"},
    "state": {"joints": "arm/joints"},
    "gripper": "arm/gripper",
    "instruction": "language_instruction",
}


def seen(pixel: int, gripper: float = 0.25) -> Obs:
    joints = np.full(7, 0.5, np.float32)
    return Obs({"front": np.full((16, 16, 3), pixel, np.uint8)}, gripper, {"joints": joints})


@pytest.mark.parametrize(
    ("protocol", "scheme", "mapping", "gripper"),
    [("vlagents", "rpyc", VLAGENTS, 0.25), ("gr00t", "tcp", "gr00t", -1.0)],
)
def test_each_session_is_one_of_the_upstreams(
    request: pytest.FixtureRequest, protocol: str, scheme: str, mapping: Any, gripper: float
) -> None:
    port = request.getfixturevalue(f"open_{protocol}")()
    url = f"{scheme}://127.0.0.1:{port}"
    config = {"protocol": protocol, "urls": [url], "mapping": mapping, "sessions": "connection"}
    with Upstream.from_config(config) as agent:
        agent.initialize()
        copies = AgentCopies(agent)
        red, blue = copies.make(), copies.make()
        red.reset(seen(10), "abc"), blue.reset(seen(20), "abcdef")
        for step in (1, 2):
            acts = agent.act_batch([seen(10 + step), seen(20 + step)], [red, blue])
            rows = [act.rows()[0].tolist() for act in acts]
            assert rows == [[10 + step, 0.5, gripper, 3, step], [20 + step, 0.5, gripper, 6, step]]


def test_an_error_of_vlagents_is_one_of_the_upstream(open_vlagents: Any) -> None:
    mapping = {"cameras": {"cam": "cameras/front"}}
    url = f"rpyc://127.0.0.1:{open_vlagents(mapping=mapping)}"
    config = {"protocol": "vlagents", "urls": [url], "mapping": {"state": {"joints": "arm/joints"}}}
    with Upstream.from_config(config) as agent:
        agent.initialize()
        session = AgentCopies(agent).make()
        session.reset(seen(1), "abc")
        [error] = agent.act_batch([seen(1)], [session])
        assert isinstance(error, PolicyFailed)
        assert "missing" not in str(error)
