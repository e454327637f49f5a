"""Tests of our own server as the upstream, through each of its dialects."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from asgi_server import served
from dialect_server import METADATA
from served_agents import Mirror

from vlagents_ray.interface import Obs
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.protocol.messages import DEFAULT_LIMITS
from vlagents_ray.serve.config.dialects import DialectArgs
from vlagents_ray.serve.dialects.base import ReplicaContext, dialect_routes
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray_dialects.upstream import Upstream

DIALECTS: dict[str, Any] = {
    "openpi": {"mapping": "openpi-libero"},
    "roboarena": {
        "mapping": "openpi-libero",
        "n_external_cameras": 0,
        "action_space": "joint_position",
    },
    "openvla": {"mapping": "openvla-oft", "chunk": True},
    "sglang": {},
    "vla_eval": {},
}
SGLANG = {
    "cameras": {"front": "images/front", "wrist": "images/wrist"},
    "state": {"state": "state"},
    "instruction": "prompt",
}
# The protocol, scheme, path and mapping of each dialect of our server.
UPSTREAMS: dict[str, tuple[str, str, str, str | dict[str, Any]]] = {
    "openpi": ("openpi", "ws", "/openpi", "openpi-libero"),
    "openpi-batch": ("openpi-batch", "ws", "/openpi", "openpi-libero"),
    "roboarena": ("roboarena", "ws", "/roboarena", "openpi-libero"),
    "openvla": ("openvla", "http", "/act", "openvla-oft"),
    "sglang": ("sglang", "http", "/v1/actions/generations", SGLANG),
    "vla_eval": ("vla_eval", "ws", "/vla-eval", "vla-eval"),
}


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    engine = Engine(Mirror(chunk=2))
    engine.start()
    routes = dialect_routes(
        DialectArgs(**DIALECTS), ReplicaContext(engine, lambda: METADATA, DEFAULT_LIMITS)
    )
    app = build_http_app(engine, lambda: METADATA, DEFAULT_LIMITS, more=routes)
    with served(AccessMiddleware(app, None, "app")) as found:
        yield found
    engine.close()


@pytest.mark.parametrize("upstream", sorted(UPSTREAMS))
def test_a_server_of_ours_answers_to_upstream_as_to_a_client(port: int, upstream: str) -> None:
    protocol, scheme, path, mapping = UPSTREAMS[upstream]
    config = {
        "protocol": protocol,
        "urls": [f"{scheme}://127.0.0.1:{port}{path}"],
        "mapping": mapping,
    }
    with Upstream.from_config(config) as agent:
        agent.initialize()
        copies = AgentCopies(agent)
        sessions = [copies.make() for _ in range(3)]
        seen = [
            Obs(
                {name: np.full((8, 8, 3), 10 * i + 10, np.uint8) for name in ("front", "wrist")},
                1.0,
                {
                    "xyz_axis_angle": np.zeros(6, np.float32),
                    "gripper_qpos": np.array([0.04, -0.04], np.float32),
                    "state": np.zeros(8, np.float32),
                },
            )
            for i in range(3)
        ]
        for session, obs in zip(sessions, seen, strict=True):
            session.reset(obs, "task 1")
        for act, obs in zip(agent.act_batch(seen, sessions), seen, strict=True):
            assert not isinstance(act, Exception), act
            assert act.rows()[0, 0] == obs.cameras["front"][0, 0, 0]
