"""LeRobot's HIL-SERL: its learner trains a policy on a server, from episodes of our control loop
and our recordings.
"""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue
from typing import Any

import grpc
import numpy as np
import pytest
import torch
from eval_fakes import wait_for
from lerobot.rl.learner_service import LearnerService
from lerobot.transport import services_pb2_grpc
from lerobot.transport.utils import bytes_to_python_object, bytes_to_transitions, state_to_bytes
from scripted_leader import ScriptedLeader

from lerobot_policy_vlagents.hilserl import Actor, transitions, write_checkpoint
from plugins.vlagents_ray_models.tests.families.lerobot.commands import Server, serving
from vlagents_ray import ChunkPlayer, Obs, PlayerSettings, RemoteAgent
from vlagents_ray.errors import ConfigError, InvalidWeights, PolicyUnavailable
from vlagents_ray.robot import Guard, LoopOptions, run_loop
from vlagents_ray.robot.record import Recorder
from vlagents_ray.robot.simulated import SimulatedRobot
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.ports import free_port
from vlagents_ray_learn import Publisher
from vlagents_ray_models.lerobot import LeRobot

STATE = 4  # three joints and the gripper
ACTION = 2  # an action also has the gripper's choice: 0, 1 or 2
HZ = 50
FRAMES = 20
COMMAND = np.array([0.5, -0.5, 1], np.float32)
INPUTS = ["observation.state"]


def config(folder: Path, port: int, dataset: Path) -> Path:
    """The configuration of a learner, as its users write it."""
    features = {
        "action": {"type": "ACTION", "shape": [ACTION]},
        INPUTS[0]: {"type": "STATE", "shape": [STATE]},
    }
    statistics = {
        INPUTS[0]: {"min": [-1.0] * STATE, "max": [1.0] * STATE},
        "action": {"min": [-1.0] * ACTION, "max": [1.0] * ACTION},
    }
    policy = {
        "type": "sac",
        "device": "cpu",
        "storage_device": "cpu",
        "use_torch_compile": False,
        "push_to_hub": False,
        "num_discrete_actions": 3,
        "latent_dim": 8,
        "state_encoder_hidden_dim": 8,
        "online_buffer_capacity": 200,
        "offline_buffer_capacity": 200,
        "online_step_before_learning": 6,
        "input_features": {INPUTS[0]: features[INPUTS[0]]},
        "output_features": {"action": features["action"]},
        "dataset_stats": statistics,
        "actor_learner_config": {
            "learner_host": "127.0.0.1",
            "learner_port": port,
            "policy_parameters_push_frequency": 1,
            "queue_get_timeout": 0.1,
        },
    }
    env = {
        "type": "gym_manipulator",
        "fps": HZ,
        "features": features,
        "features_map": {key: key for key in features},
    }
    whole = {
        "policy": policy,
        "env": env,
        "dataset": {"repo_id": "me/corrections", "root": str(dataset)},
        "output_dir": str(folder / "learner"),
        "job_name": "learner",
        "batch_size": 8,
        "log_freq": 1,
        "save_checkpoint": False,
        "wandb": {"enable": False},
    }
    (folder / "train.json").write_text(json.dumps(whole))
    return folder / "train.json"


def record(root: Path) -> Path:
    """Corrections as our recorder writes them: 12 frames of a success, and as many of a failure."""
    with Recorder(root, HZ, interventions=True) as recorder:
        for label in ("success", "failure"):
            with recorder.episode("reach"):
                for i in range(12):
                    obs = Obs(gripper=1.0, state={"joints": np.full(STATE - 1, i / 12, np.float32)})
                    recorder.add(obs, COMMAND, tick=i, intervention=i > 6)
                recorder.label(label)  # type: ignore[arg-type]
    return root


@pytest.fixture
def policy(tmp_path: Path) -> LeRobot:
    """The policy that a configuration describes."""
    write_checkpoint(
        config(tmp_path, free_port(), tmp_path / "corrections"), tmp_path / "checkpoint"
    )
    return LeRobot.from_config(
        {"checkpoint": str(tmp_path / "checkpoint"), "state": ["joints", "gripper"]}
    )


@pytest.fixture
def server(policy: LeRobot) -> Iterator[Server]:
    with serving(policy) as found:
        yield found


def play(server: Server, actor: Any, wants: ScriptedLeader | None = None) -> None:
    """Run one episode of the control loop, with the newest weights."""
    agent = RemoteAgent(server.url, api_key=server.key)
    guard = Guard(agent.contract, low=-10.0, high=10.0)
    player = ChunkPlayer(
        agent, PlayerSettings(mode="open_loop", safe="hold"), check=guard, override=wants
    )
    with player:
        options, robot = {"weights": "follow"}, SimulatedRobot(agent.contract)
        run_loop(
            robot,
            player,
            hz=HZ,
            seconds=FRAMES / HZ,
            recorder=actor,
            options=LoopOptions(reset_options=options),
        )


class Pushes(Publisher):
    """A publisher that keeps what it pushed."""

    def __init__(self, engine: Engine) -> None:
        super().__init__(engine)
        self.pushed: list[dict[str, Any]] = []

    def push(self, named: Mapping[str, Any], **options: Any) -> int:
        self.pushed.append(dict(named))
        return super().push(named, **options)


class Learner:
    """LeRobot's own service of a learner, whose queues the test reads and fills."""

    def __init__(self, folder: Path) -> None:
        self.ended = threading.Event()
        self.parameters, self.transitions, self.reports = (
            Queue[bytes](),
            Queue[bytes](),
            Queue[bytes](),
        )
        service = LearnerService(
            self.ended, self.parameters, 0.0, self.transitions, self.reports, 0.01
        )
        self.server = grpc.server(ThreadPoolExecutor(3))
        services_pb2_grpc.add_LearnerServiceServicer_to_server(service, self.server)
        self.config = config(folder, self.server.add_insecure_port("127.0.0.1:0"), folder)
        self.server.start()

    def close(self) -> None:
        self.ended.set()
        self.server.stop(None).wait()


@pytest.fixture
def learner(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Learner]:
    found = Learner(tmp_path_factory.mktemp("learner"))
    yield found
    found.close()


def test_the_server_acts_with_the_learners_parameters_from_the_next_episode_on(
    policy: LeRobot, server: Server, learner: Learner
) -> None:
    own: dict[str, dict[str, Any]] = {"policy": {}, "discrete_critic": {}}
    for name, value in policy.parameters().items():
        module, _, rest = name.partition(".")
        if module in ("actor", "discrete_critic"):
            own["policy" if module == "actor" else module][rest] = value + 1
    assert all(own.values())
    weights = Publisher(server.engine)
    with Actor(learner.config, weights) as actor:
        for version in (1, 2):
            learner.parameters.put(state_to_bytes(own))
            wait_for(functools.partial(lambda wanted: actor.version == wanted, version))
        assert weights.acknowledged(2) == 1
        play(server, actor)
    sent = bytes_to_transitions(learner.transitions.get(timeout=10))
    assert 2 < len(sent) <= FRAMES, "but missed ticks"
    assert sent[0]["action"].shape == (1, ACTION + 1)
    assert set(sent[0]["state"]) == set(INPUTS), "not the cameras that the policy does not read"
    assert torch.equal(sent[1]["state"][INPUTS[0]], sent[0]["next_state"][INPUTS[0]])
    assert [one["done"] or one["truncated"] for one in sent] == [False] * (len(sent) - 1) + [True]
    report = bytes_to_python_object(learner.reports.get(timeout=10))
    assert (report["Interaction step"], report["Episode intervention"]) == (len(sent), 0)


def test_an_operators_actions_reach_the_learner_unless_discarded(
    policy: LeRobot, server: Server, learner: Learner
) -> None:
    # From the second tick on, so that a slow machine, which misses ticks, also has such frames.
    leader = ScriptedLeader(COMMAND, wants=lambda: leader.polls > 1)
    with Actor(learner.config, Publisher(server.engine)) as actor:
        with actor.episode("dropped"):
            actor.add(SimulatedRobot(policy.contract).observe(), COMMAND, tick=0)
            actor.label("discard")
        play(server, actor, leader)
    sent = bytes_to_transitions(learner.transitions.get(timeout=10))
    assert learner.transitions.empty()
    led = [bool(one["complementary_info"]["is_intervention"]) for one in sent]
    assert led == sorted(led)
    assert any(led)
    assert all(
        torch.equal(one["action"][0], torch.from_numpy(COMMAND)) for one in sent[led.index(True) :]
    )


def test_a_label_is_the_reward_and_ends_the_episode() -> None:
    frames = [
        (
            Obs(
                {"top": np.full((4, 6, 3), 51, np.uint8)},
                0.5,
                {"joints": np.full(2, i, np.float32)},
            ),
            np.ones(2, np.float32),
            i == 1,
        )
        for i in range(3)
    ]
    inputs = {"observation.state": (3,), "observation.images.top": (3, 4, 6)}
    for label, reward, done in (("success", 1.0, True), ("failure", 0.0, True), (None, 0.0, False)):
        *_, last = found = transitions(frames, label, inputs)  # type: ignore[arg-type]
        assert [one["reward"] for one in found] == [0.0, 0.0, reward]
        assert (last["done"], last["truncated"]) == (done, not done)
        assert [one["complementary_info"]["is_intervention"] for one in found] == [
            False,
            True,
            False,
        ]
    assert found[0]["next_state"]["observation.state"].tolist() == [[1, 1, 0.5]]
    assert found[0]["state"]["observation.images.top"].shape == (1, 3, 4, 6)
    assert float(found[0]["state"]["observation.images.top"].max()) == pytest.approx(0.2)
    with pytest.raises(
        ConfigError, match=r"expected .*wrist.*got \{.*state': \(3,\)\} from the robot"
    ):
        transitions(frames, None, inputs | {"observation.images.wrist": (3, 4, 6)})


def test_what_goes_wrong_is_raised_where_the_caller_sees_it(
    server: Server, learner: Learner, tmp_path: Path
) -> None:
    with pytest.raises(PolicyUnavailable, match=r"no learner at .*python -m lerobot\.rl\.learner"):
        Actor(
            config(tmp_path, free_port(), tmp_path), Publisher(server.engine), connect_timeout_s=0.3
        )
    actor = Actor(learner.config, Publisher(server.engine))
    learner.parameters.put(state_to_bytes({"policy": {"encoder.unknown": torch.zeros(1)}}))
    wait_for(lambda: actor._error is not None)
    with pytest.raises(InvalidWeights, match="unknown"), actor.episode("reach"):
        pass
    actor.close()


def test_lerobots_learner_trains_the_served_policy_on_recorded_and_new_corrections(
    server: Server, tmp_path: Path
) -> None:
    port = free_port()
    file = config(tmp_path, port, record(tmp_path / "corrections"))
    log = tmp_path / "log"
    with log.open("w") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "lerobot.rl.learner", f"--config_path={file}"],
            stdout=out,
            stderr=subprocess.STDOUT,
            cwd=tmp_path,
            env=os.environ | {"HF_HUB_OFFLINE": "1"},
        )
    weights = Pushes(server.engine)
    try:
        with Actor(file, weights, connect_timeout_s=240) as actor:
            wait_for(lambda: actor.version is not None, 60)
            begun = actor.version or 0
            for _ in range(3):
                play(server, actor, ScriptedLeader(COMMAND, wants=lambda: True))
            wait_for(lambda: (actor.version or 0) >= begun + 2, 120)
    finally:
        process.terminate()
        process.wait(60)
    said = log.read_text()
    assert "Convert to a offline replay buffer" in said
    assert "Number of optimization step: 2" in said
    first, *_, last = weights.pushed
    assert weights.acknowledged(len(weights.pushed)) == 1
    assert any(not torch.equal(first[name], value) for name, value in last.items()), "it learned"
