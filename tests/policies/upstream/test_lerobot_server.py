"""LeRobot's server, which keeps one observation for all its clients: an act gets the answer to its own, or none."""

from __future__ import annotations

import importlib
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from eval_fakes import wait_for
from lerobot_messages import AsyncClient, TimedObservation
from lerobot_server import PolicyServer, serving
from upstream_servers import BROKEN, SLOW, answer

from vlagents_ray.errors import ConfigError, PolicyFailed, PolicyUnavailable
from vlagents_ray.interface import Act, Obs
from vlagents_ray.policies.upstream import Upstream, connections
from vlagents_ray.serve.models.agent_copies import AgentCopies
from vlagents_ray.serve.ports import free_port

MAPPING: dict[str, Any] = {
    "preset": "lerobot",
    "cameras": {"front": "observation.images.front"},
    "state": {"joints": {"key": "observation.state", "stop": 2}},
}
LOADED: dict[str, Any] = {"policy_type": "act", "pretrained_name_or_path": "me/act", "actions_per_chunk": 10}


def settings(port: int = 9, **changes: Any) -> dict[str, Any]:
    url = f"grpc://127.0.0.1:{port}"
    return {"protocol": "lerobot", "urls": [url], "mapping": MAPPING, "lerobot": LOADED, **changes}


@pytest.fixture
def server() -> Iterator[tuple[PolicyServer, int]]:
    port = free_port()
    with serving(port) as found:
        yield found, port


def opened(port: int, **changes: Any) -> Upstream:
    agent = Upstream.from_config(settings(port, **changes))
    agent.initialize()
    return agent


def seen(number: int) -> Obs:
    image = np.full((8, 8, 3), number, np.uint8)
    return Obs({"front": image}, state={"joints": np.array([number, 0.5], np.float32)})


def expected(obs: Obs, text: str = "task") -> np.ndarray:
    theirs = {"observation.state": obs.state["joints"], "observation.images.front": obs.cameras["front"], "task": text}
    return answer(theirs).astype(np.float32)


def act(agent: Upstream, obs: Obs, text: str = "task") -> Act | Exception:
    session = AgentCopies(agent).make()
    session.reset(obs, text)
    [found] = agent.act_batch([obs], [session])
    return found


def require_right(agent: Upstream, obs: Obs) -> None:
    found = act(agent, obs)
    assert not isinstance(found, Exception), found
    np.testing.assert_array_equal(found.action, expected(obs))


def test_it_loads_what_the_deployment_says(server: tuple[PolicyServer, int]) -> None:
    with opened(server[1]):
        told = server[0].instructions
    assert (told.policy_type, told.pretrained_name_or_path, told.actions_per_chunk, told.device, told.rename_map) == (
        "act", "me/act", 10, "cuda", {},
    )  # fmt: skip
    assert list(told.lerobot_features) == ["observation.state", "observation.images.front"]


def test_an_observation_like_the_last_one_is_answered_too(server: tuple[PolicyServer, int]) -> None:
    """LeRobot's server leaves one out whose state is as the last one's, unless it must go."""
    with opened(server[1]) as agent:
        for _ in range(3):
            require_right(agent, seen(1))


def test_a_failure_of_the_model_is_that_of_its_act(
    server: tuple[PolicyServer, int], caplog: pytest.LogCaptureFixture
) -> None:
    with opened(server[1]) as agent:
        found = act(agent, seen(1), BROKEN)
        assert isinstance(found, PolicyFailed)
        assert "its own log says why" in caplog.text
        require_right(agent, seen(2))


def test_a_late_answer_is_not_taken_for_that_of_the_next_observation(server: tuple[PolicyServer, int]) -> None:
    with opened(server[1], timeout_s=0.5, retry_s=30) as agent:
        assert isinstance(act(agent, seen(1), SLOW), PolicyUnavailable)
        require_right(agent, seen(2))


def test_another_clients_answer_is_not_taken_for_ours(
    server: tuple[PolicyServer, int], caplog: pytest.LogCaptureFixture
) -> None:
    """Another client sends its observation between ours and our question for actions."""
    served, port = server
    values = {"observation.state.0": 1.0, "observation.state.1": 0.5, "front": seen(1).cameras["front"], "task": "task"}
    with opened(port) as agent, AsyncClient(port) as other:
        take = served.act

        def act_late(request: bytes, context: Any) -> bytes:
            served.act_now = take
            other.send(TimedObservation(1.0, 1, values, must_go=True))
            return take(request, context)

        served.act_now = act_late
        assert isinstance(act(agent, seen(1)), PolicyFailed)
        assert "another client's observation" in caplog.text
        require_right(agent, seen(2))


def test_actions_that_another_client_took_are_missed_and_the_next_are_right(server: tuple[PolicyServer, int]) -> None:
    served, port = server
    served.wait_s = 0.1
    with opened(port) as agent, AsyncClient(port) as other:
        take = served.act

        def act_after_the_other(request: bytes, context: Any) -> bytes:
            served.act_now = take
            assert len(other.get(b"", timeout=20)) > 0
            return take(request, context)

        served.act_now = act_after_the_other
        assert isinstance(act(agent, seen(1)), PolicyFailed)
        require_right(agent, seen(2))


def test_a_checkpoint_that_the_server_cannot_load_does_not_start(
    server: tuple[PolicyServer, int], caplog: pytest.LogCaptureFixture
) -> None:
    with pytest.raises(PolicyFailed, match="the server's log has") as error:
        opened(server[1], lerobot=LOADED | {"pretrained_name_or_path": BROKEN})
    assert "secret" not in str(error.value)
    assert "a secret of the upstream" in caplog.text


def test_a_checkpoint_may_load_for_longer_than_connecting_takes(
    server: tuple[PolicyServer, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "_CONNECT_S", 0.3)
    server[0].load_s = 0.9
    with opened(server[1], connect_timeout_s=60) as agent:
        require_right(agent, seen(1))
    assert server[0].loads == 1  # it was not asked again meanwhile


def test_a_server_that_returns_gets_its_policy_before_a_row() -> None:
    port = free_port()
    with serving(port):
        agent = opened(port, retry_s=60)
        require_right(agent, seen(1))
    wait_for(lambda: not any(client.is_open for client in agent._lanes._clients))
    with serving(port) as again, agent:
        require_right(agent, seen(2))
        assert again.instructions.pretrained_name_or_path == "me/act"


def test_a_client_that_is_closed_at_once_leaves_no_thread_that_fails(
    server: tuple[PolicyServer, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    module = importlib.import_module("grpc._channel")
    poll, failed, ended = module._poll_connectivity, [], threading.Event()

    def late(*args: Any) -> None:
        time.sleep(0.1)
        try:
            poll(*args)
        except ValueError as error:
            failed.append(error)
        finally:
            ended.set()

    monkeypatch.setattr(module, "_poll_connectivity", late)
    with opened(server[1]):
        pass
    assert ended.wait(30)
    assert not failed


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"lerobot": None}, "lerobot: want what the server loads"),
        ({"lerobot": {"policy_type": "act"}}, "pretrained_name_or_path"),
        ({"lerobot": LOADED | {"policy_type": "vqbet"}}, "serve the checkpoint here, with `policy: lerobot`"),
        ({"urls": ["http://box:8080"]}, "want grpc://HOST:PORT for lerobot"),
        ({"urls": ["grpc://box:1", "grpc://box:1"]}, "one connection to each URL"),
        ({"connections": 2}, "one connection to each URL"),
        ({"sessions": "connection"}, "one connection to each URL"),
        ({"key_env": "KEY"}, "no place for a key"),
        ({"mapping": "lerobot"}, r"mapping.cameras: got \*: observation.images.\*, want each camera by its name"),
        ({"mapping": MAPPING | {"cameras": {"front": "front"}}}, "got front: front, want each camera by its name"),
        ({"mapping": MAPPING | {"state": {"joints": "observation.state"}}}, "`stop` in each part"),
        ({"mapping": MAPPING | {"state": {"joints": {"key": "state", "stop": 6}}}}, r"\['state'\], want observation"),
        ({"mapping": MAPPING | {"state": {}}}, r"got the keys \[\], want observation.state alone"),
        ({"mapping": MAPPING | {"instruction": "prompt"}}, "remove other keys"),
        ({"protocol": "openpi", "urls": ["ws://box:1"], "mapping": "openpi-libero"}, "want nothing for openpi"),
    ],
)
def test_a_wrong_setting_is_refused_with_what_is_right(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        Upstream.from_config(settings(**changes))


def test_the_gripper_may_be_a_number_of_the_state(server: tuple[PolicyServer, int]) -> None:
    mapping = MAPPING | {
        "state": {"joints": {"key": "observation.state", "stop": 1}},
        "gripper": {"key": "observation.state", "index": 1},
    }
    with opened(server[1], mapping=mapping) as agent:
        obs = Obs(seen(3).cameras, 0.5, {"joints": np.array([3], np.float32)})
        found = act(agent, obs)
        assert not isinstance(found, Exception), found
        np.testing.assert_array_equal(found.action, expected(seen(3)))
