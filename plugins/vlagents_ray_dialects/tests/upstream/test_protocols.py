"""Tests that actions are bit-identical to the upstream's answers to its own client, for each
protocol.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import upstream_servers
from upstream_servers import BROKEN, answer, gr00t_actions, upstreams

from vlagents_ray.errors import PolicyFailed
from vlagents_ray.interface import Obs
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.serve.ports import free_port
from vlagents_ray.testing import check_agent
from vlagents_ray_dialects.upstream import Upstream

SCHEMES = {"gr00t": "tcp", "openvla": "http"}
MAPPINGS: dict[str, Any] = {
    "openpi": "openpi-libero",
    "openpi-batch": "openpi-libero",
    "gr00t": {
        "preset": "gr00t",
        "cameras": {"front": "video/ego", "wrist": "video/wrist"},
        "state": {"joints": "state/arm"},
        "action": {"arm": {"stop": 6}, "gripper": {"start": 6, "stop": 7}},
    },
    "vla_eval": {"preset": "vla-eval", "state": {"joints": "states"}},
}
MAPPINGS["gr00t packed"] = MAPPINGS["gr00t"]
MAPPINGS["gr00t sim"] = MAPPINGS["gr00t"] | {
    "preset": "gr00t-n1.5",
    "cameras": {"front": "video.ego", "wrist": "video.wrist"},
    "state": {"joints": "state.arm"},
}


def libero(obs: Obs, text: str) -> dict[str, Any]:
    """Return an observation as openpi's examples/libero/main.py builds it, from float32
    readings.
    """
    return {
        "observation/image": obs.cameras["front"],
        "observation/wrist_image": obs.cameras["wrist"],
        "observation/state": np.concatenate(
            [obs.state["xyz_axis_angle"], obs.state["gripper_qpos"]]
        ),
        "prompt": text,
    }


def droid(obs: Obs, text: str) -> dict[str, Any]:
    return {
        "observation/exterior_image_0_left": obs.cameras["front"],
        "observation/wrist_image_left": obs.cameras["wrist"],
        "observation/joint_position": obs.state["joints"],
        "observation/gripper_position": np.array([1 - obs.gripper], np.float32),
        "prompt": text,
    }


def so100(obs: Obs, text: str) -> np.ndarray:
    batch = {
        "video": {
            "ego": obs.cameras["front"][None, None],
            "wrist": obs.cameras["wrist"][None, None],
        },
        "state": {"arm": obs.state["joints"][None, None]},
        "language": {"annotation.human.task_description": [[text]]},
    }
    actions = gr00t_actions(batch)
    return np.concatenate([actions["arm"], actions["gripper"]], -1)[0]


DIRECT: dict[str, Callable[[Obs, str, int], np.ndarray]] = {
    "openpi": lambda obs, text, _step: answer(libero(obs, text)),
    "openpi-batch": lambda obs, text, _step: answer(libero(obs, text)),
    "roboarena": lambda obs, text, step: answer(droid(obs, text), step),
    "gr00t": lambda obs, text, _step: so100(obs, text),
    "gr00t packed": lambda obs, text, _step: so100(obs, text),
    "gr00t sim": lambda obs, text, _step: so100(obs, text),
    "openvla": lambda obs, text, _step: answer(
        {"image": obs.cameras["front"], "instruction": text}
    )[0],
    "vla_eval": lambda obs, text, step: answer(
        {
            "images": {"front": obs.cameras["front"], "wrist": obs.cameras["wrist"]},
            "states": obs.state["joints"],
            "task_description": text,
        },
        step,
    )[0],
}


def seen(number: int) -> Obs:
    rng = np.random.default_rng(number)
    pixels = rng.integers(0, 256, (2, 16, 16, 3), np.uint8)
    joints, pose, fingers = (rng.standard_normal(size).astype(np.float32) for size in (7, 6, 2))
    return Obs(
        {"front": pixels[0], "wrist": pixels[1]},
        0.25,
        {"joints": joints, "xyz_axis_angle": pose, "gripper_qpos": fingers},
    )


@pytest.fixture(scope="module")
def ports() -> Iterator[dict[int, str]]:
    """Yield the kind of each server by its port; there are two servers of each kind."""
    kinds = {free_port(): kind for kind in sorted(DIRECT) * 2}
    with upstreams(kinds):
        yield kinds


@pytest.fixture(scope="module", params=sorted(DIRECT))
def served(request: pytest.FixtureRequest, ports: dict[int, str]) -> tuple[str, dict[str, Any]]:
    """Return a kind of server, and settings with the addresses of its two servers."""
    kind = request.param
    protocol = kind.partition(" ")[0]
    urls = [
        f"{SCHEMES.get(protocol, 'ws')}://127.0.0.1:{port}"
        for port, one in ports.items()
        if one == kind
    ]
    settings = {"protocol": protocol, "urls": urls, "connect_timeout_s": 30}
    return kind, settings | ({"mapping": MAPPINGS[kind]} if kind in MAPPINGS else {})


@pytest.fixture
def agent(served: tuple[str, dict[str, Any]]) -> Iterator[Upstream]:
    with Upstream.from_config(served[1]) as found:
        found.initialize()
        yield found


def test_each_of_16_sessions_gets_what_the_upstream_answers_to_its_own_client(
    served: tuple[str, dict[str, Any]], agent: Upstream
) -> None:
    direct, copies = DIRECT[served[0]], AgentCopies(agent)
    sessions = [copies.make() for _ in range(16)]
    for i, session in enumerate(sessions):
        assert session.reset(seen(i), f"task {i}") == {}
    for step in range(3):
        views = [seen(100 * step + i) for i in range(16)]
        acts = agent.act_batch(views, sessions)
        for i, act in enumerate(acts):
            assert not isinstance(act, Exception), act
            assert act.action.dtype == np.float32
            np.testing.assert_array_equal(
                act.action, direct(views[i], f"task {i}", step).astype(np.float32)
            )


def test_an_error_of_the_upstream_is_that_of_its_session_and_says_none_of_its_details(
    agent: Upstream, caplog: pytest.LogCaptureFixture
) -> None:
    copies = AgentCopies(agent)
    broken, fine = copies.make(), copies.make()
    broken.reset(seen(0), BROKEN), fine.reset(seen(0), "task")
    act, other = agent.act_batch([seen(0), seen(1)], [broken, fine])
    assert not isinstance(other, Exception), other
    assert isinstance(act, PolicyFailed)
    assert "secret" not in str(act)
    assert "the server's log has" in str(act)
    assert "answered with an error" in caplog.text


def test_it_is_an_agent(served: tuple[str, dict[str, Any]]) -> None:
    check_agent(Upstream.from_config(served[1]), obs=[seen(0), seen(1)], instructions=["a", "b"])


def test_the_doubles_tell_every_bit_apart() -> None:
    view = libero(seen(0), "task")
    changed = view | {"observation/state": np.nextafter(view["observation/state"], np.float32(9))}
    assert not np.array_equal(upstream_servers.answer(view), upstream_servers.answer(changed))
