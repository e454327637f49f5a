"""The policy `upstream` in front of LeRobot's own policy server, which is asked by LeRobot's own stub beside it."""

from __future__ import annotations

import pickle
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from eval_fakes import Line, wait_for
from in_process_evaluation import play
from in_process_replicas import Replicas
from lerobot.async_inference.helpers import RemotePolicyConfig, TimedObservation
from lerobot.transport import services_pb2, services_pb2_grpc
from lerobot.transport.utils import send_bytes_in_chunks

from tests.families.lerobot import policy_server, tiny
from tests.families.lerobot.conftest import FILTERS, TASKS, Made, view
from vlagents_ray import Obs
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.policies.upstream import Upstream
from vlagents_ray.serve.models.agent_copies import AgentCopies
from vlagents_ray.serve.ports import free_port

pytestmark = FILTERS

NAMES = [f"joint_{number}.pos" for number in range(tiny.STATE)]
PATIENCE_S = 600.0  # for a server to start, which imports torch and LeRobot first
Start = Callable[[int], Any]


@pytest.fixture(scope="module")
def start() -> Iterator[Start]:
    started: list[Any] = []

    def run(port: int) -> Any:
        started.append(policy_server.start(port))
        return started[-1]

    yield run
    for process in started:
        process.kill()
        process.join()


@pytest.fixture(scope="module")
def server(start: Start) -> tuple[Any, int]:
    """A server and its port."""
    port = free_port()
    return start(port), port


def settings(folder: Path, port: int, **more: Any) -> dict[str, Any]:
    loaded = {"policy_type": "act", "pretrained_name_or_path": str(folder), "actions_per_chunk": tiny.CHUNK}
    return {
        "protocol": "lerobot",
        "urls": [f"grpc://127.0.0.1:{port}"],
        "lerobot": loaded | {"device": "cpu"},
        "mapping": {
            "preset": "lerobot",
            "cameras": {tiny.CAMERA: f"observation.images.{tiny.CAMERA}"},
            "state": {"joints": {"key": "observation.state", "stop": tiny.STATE}},
        },
        "retry_s": PATIENCE_S,
        "timeout_s": PATIENCE_S,
        **more,
    }


class Theirs:
    """What LeRobot's `RobotClient` does with its stub, without its threads and its robot."""

    def __init__(self, port: int, folder: Path) -> None:
        self._channel = grpc.insecure_channel(f"127.0.0.1:{port}")
        self._stub = services_pb2_grpc.AsyncInferenceStub(self._channel)
        self._stub.Ready(services_pb2.Empty(), timeout=PATIENCE_S, wait_for_ready=True)
        image = {"dtype": "image", "shape": (tiny.SIDE, tiny.SIDE, 3), "names": ["height", "width", "channels"]}
        features = {
            "observation.state": {"dtype": "float32", "shape": (tiny.STATE,), "names": NAMES},
            f"observation.images.{tiny.CAMERA}": image,
        }
        told = pickle.dumps(RemotePolicyConfig("act", str(folder), features, tiny.CHUNK, "cpu"))
        self._stub.SendPolicyInstructions(services_pb2.PolicySetup(data=told), timeout=PATIENCE_S)

    def act(self, obs: Obs, task: str) -> np.ndarray:
        values = dict(zip(NAMES, obs.state["joints"].tolist(), strict=True)) | obs.cameras | {"task": task}
        data = pickle.dumps(TimedObservation(timestamp=time.time(), timestep=0, observation=values, must_go=True))
        self._stub.SendObservations(send_bytes_in_chunks(data, services_pb2.Observation), timeout=PATIENCE_S)
        actions = pickle.loads(self._stub.GetActions(services_pb2.Empty(), timeout=PATIENCE_S).data)  # noqa: S301 - a test's own
        return np.stack([one.get_action().numpy() for one in actions])

    def close(self) -> None:
        self._channel.close()


def test_actions_are_those_that_lerobots_own_client_gets(made: Made, server: tuple[Any, int]) -> None:
    port, folder = server[1], made("act")
    theirs = Theirs(port, folder)
    views = [view(number) for number in range(4)]
    expected = [theirs.act(obs, task) for obs, task in zip(views, [*TASKS, ""], strict=True)]
    theirs.close()
    with Upstream.from_config(settings(folder, port)) as agent:
        agent.initialize()
        copies = AgentCopies(agent)
        for _ in range(2):  # the second time, the states are those of a moment ago
            sessions = [copies.make() for _ in views]
            for session, obs, task in zip(sessions, views, [*TASKS, ""], strict=True):
                session.reset(obs, task)
            for act, rows in zip(agent.act_batch(views, sessions), expected, strict=True):
                assert not isinstance(act, Exception), act
                assert act.action.shape == (tiny.CHUNK, tiny.ACTION)
                np.testing.assert_array_equal(act.action, rows)


class Reaching(Line):
    """For policies with as many numbers in an action as the tiny ones have; it takes the first."""

    @property
    def contract(self) -> Contract:
        return replace(super().contract, action=ActionSpec(dim=tiny.ACTION))


def test_it_is_killed_and_restarted_and_no_episode_fails(
    made: Made, server: tuple[Any, int], start: Start, tmp_path: Path
) -> None:
    (first, port), options = server, {"camera": [tiny.SIDE, tiny.SIDE], "state_dim": tiny.STATE}
    mapping = {
        "preset": "lerobot",
        "cameras": {"front": f"observation.images.{tiny.CAMERA}"},
        "state": {"position": {"key": "observation.state", "stop": tiny.STATE}},
    }
    servers = [first]
    replicas = Replicas([Upstream.from_config(settings(made("act"), port, mapping=mapping))])

    def kill() -> None:
        wait_for(lambda: len(replicas.frames) > 10, every_s=0.002)
        servers[0].kill()
        servers[0].join()
        servers.append(start(port))

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        config = EvalConfig.model_validate(
            {
                "policies": [{"name": "upstream", "source": "upstream"}],
                "suites": [{"envs": [f"{__name__}:{Reaching.__name__}"], "env_options": options, "episodes": 4}],
                "policy_timeout_s": PATIENCE_S,
                "out": tmp_path / "out",
            }
        )
        results = play(config, lambda: replicas.agent(timeout_s=PATIENCE_S))
    finally:
        killer.join()
        replicas.close()
    assert len(servers) == 2
    [cell] = results.cells
    assert [(one.result.status, one.attempts) for one in cell.episodes] == [("done", 1)] * 4
