"""LeRobot's own commands, as users type them, with the plug-in of plugins/ and a policy on a
server.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import make_policy
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot_env_mirror import INSTRUCTION, STEPS, MirrorEnvConfig
from mirror_policy import CONTRACT, ROWS, SIDE, MirrorPolicy, colour_of, mirrored

from lerobot_policy_vlagents import modeling_vlagents
from lerobot_policy_vlagents.configuration_vlagents import VlagentsConfig
from lerobot_policy_vlagents.modeling_vlagents import VlagentsPolicy
from lerobot_policy_vlagents.observations import ObservationMapping
from plugins.vlagents_ray_models.tests.families.lerobot import tiny
from plugins.vlagents_ray_models.tests.families.lerobot.commands import (
    Server,
    make_site,
    run,
    serving,
)
from vlagents_ray.contract import differences
from vlagents_ray.errors import ConfigError, ContractMismatch
from vlagents_ray.recorded_dataset import Names, RecordedDataset

TASK = "lift the cup"
BY_RECORD = pytest.mark.skipif(tiny.NEW, reason="lerobot-record of LeRobot 0.6 takes no policy")


@dataclass(frozen=True)
class Ended:
    """A command that ended."""

    status: int
    log: str
    folder: Path  # folder of all commands
    begun: list[tuple[str | None, object]]  # instructions and seeds of the episodes of all commands


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving(MirrorPolicy()) as found:
        yield found


@pytest.fixture(scope="module")
def ended(server: Server, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Ended]:
    """The commands of these tests, after they ended."""
    folder = tmp_path_factory.mktemp("commands")
    policy = server.options(folder)
    robot = ["lerobot-record", "--robot.type=mirror", *policy, "--dataset.repo_id=me/eval_mirror"]
    robot += [
        f"--dataset.single_task={TASK}",
        "--dataset.num_episodes=2",
        "--dataset.episode_time_s=0.5",
    ]
    robot += [
        "--dataset.reset_time_s=0",
        "--dataset.push_to_hub=false",
        "--dataset.vcodec=h264",
        "--play_sounds=false",
    ]
    env = [
        "lerobot-eval",
        "--env.discover_packages_path=lerobot_env_mirror",
        "--env.type=mirror",
        *policy,
    ]
    commands = {
        "record": [
            *robot,
            "--dataset.fps=20",
            f"--dataset.root={folder / 'recorded'}",
            "--policy.seed=7",
        ],
        "refused": [
            *robot,
            "--dataset.fps=30",
            f"--dataset.root={folder / 'refused'}",
            "--robot.camera=side",
        ],
        "eval": [
            *env,
            "--eval.batch_size=2",
            "--eval.n_episodes=4",
            f"--output_dir={folder / 'evaluated'}",
            f"--policy.instruction={INSTRUCTION}",
            "--policy.priority=simulation",
        ],
    }
    # Its lerobot-record takes no policy; a process for each environment would import LeRobot again.
    if tiny.NEW:
        commands = {"eval": [*commands["eval"], "--eval.use_async_envs=false"]}
    MirrorPolicy.begun.clear()
    site = make_site(tmp_path_factory.mktemp("site"), tmp_path_factory.mktemp("source"))
    found = run(list(commands.values()), site, folder)
    return {
        name: Ended(*each, folder, list(MirrorPolicy.begun))
        for name, each in zip(commands, found, strict=True)
    }


@BY_RECORD
@pytest.mark.program("LeRobot lerobot-record")
def test_lerobot_record_records_the_actions_of_the_servers_policy(ended: dict[str, Ended]) -> None:
    done = ended["record"]
    assert done.status == 0, done.log
    assert done.begun[:2] == [(TASK, 7), (TASK, 8)]
    dataset = RecordedDataset(done.folder / "recorded")
    sessions = dataset.sessions()
    assert len(sessions) == 2
    images = count(1)
    for session in sessions:
        chunk = np.zeros((0, 3), np.float32)
        for step in dataset.steps(
            session.episodes[0], Names(state=["joints", "gripper"]), CONTRACT
        ):
            # Of the robot's image, which the video has only nearly.
            colour = colour_of(next(images))
            if step.frame % ROWS == 0:
                state = np.array([*step.obs.state["joints"], step.obs.gripper], np.float32)
                chunk = mirrored(state, colour, step.frame // ROWS + 1, TASK)
            np.testing.assert_array_equal(step.expected[0], chunk[step.frame % ROWS])


@pytest.mark.program("LeRobot lerobot-eval")
def test_lerobot_eval_gives_each_environment_a_session_of_its_own(ended: dict[str, Ended]) -> None:
    done = ended["eval"]
    assert done.status == 0, done.log
    assert done.begun[-4:] == [(INSTRUCTION, None)] * 4
    [task] = json.loads((done.folder / "evaluated/eval_info.json").read_text())["per_task"]
    # The environment rewards the actions of its own session.
    assert task["metrics"]["sum_rewards"] == [STEPS] * 4


@BY_RECORD
def test_a_command_refuses_what_does_not_fit_before_it_moves(ended: dict[str, Ended]) -> None:
    done = ended["refused"]
    assert done.status == 1
    assert "camera 'top': the policy needs it, the env provides ['side']" in done.log
    assert "the policy was made for 20 Hz, the env runs at 30.0 Hz" in done.log
    assert "--policy.cameras" in done.log


def batch(*rows: int) -> dict[str, Any]:
    """Observations as LeRobot's commands hand them to a policy, each of another colour and
    state.
    """
    frames = [
        prepare_observation_for_inference(
            {
                "observation.images.top": np.full((SIDE, SIDE, 3), row, np.uint8),
                "observation.state": np.array([row, row / 2, 0.5], np.float32),
            },
            torch.device("cpu"),
        )
        for row in rows
    ]
    joined = {
        key: torch.cat([one[key] for one in frames])
        for key in frames[0]
        if key.startswith("observation")
    }
    return joined | {"task": [TASK] * len(rows)}


def expected(row: int, acts: int = 1) -> np.ndarray:
    """The chunk for a row of `batch`."""
    return mirrored(np.array([row, row / 2, 0.5]), row, acts, TASK)


@pytest.fixture
def policy(server: Server) -> Callable[..., VlagentsPolicy]:
    """Make a policy as LeRobot's evaluation does, with these options."""

    def make(**options: Any) -> VlagentsPolicy:
        usual = {"url": server.url, "state": ["joints", "gripper"], "connect_timeout_s": 20}
        made = make_policy(VlagentsConfig(**usual | options), env_cfg=MirrorEnvConfig())
        assert isinstance(made, VlagentsPolicy)
        return made

    return make


@pytest.fixture(autouse=True)
def key(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VLAGENTS_RAY_API_KEY", server.key)


def test_each_row_of_a_batch_is_a_session_until_there_is_another_number(
    policy: Callable[..., VlagentsPolicy],
) -> None:
    made = policy()
    first, second = made.select_action(batch(3, 200)), made.select_action(batch(9, 9))
    np.testing.assert_array_equal(torch.stack([first, second], dim=1), [expected(3), expected(200)])
    np.testing.assert_array_equal(made.select_action(batch(4, 5))[1], expected(5, acts=2)[0])
    np.testing.assert_array_equal(made.select_action(batch(6))[0], expected(6)[0])


def test_an_episode_begins_after_a_reset_and_every_action_wants_an_observation_if_told(
    server: Server, policy: Callable[..., VlagentsPolicy]
) -> None:
    made = policy(n_action_steps=1, seed=3)
    MirrorPolicy.begun.clear()
    for acts in (1, 2):
        np.testing.assert_array_equal(made.select_action(batch(8))[0], expected(8, acts)[0])
    made.reset()
    np.testing.assert_array_equal(
        made.predict_action_chunk(batch(8, 7)), [expected(8), expected(7)]
    )
    assert MirrorPolicy.begun == [(TASK, 3), (TASK, 4), (TASK, 5)]


def test_a_robots_loop_reports_the_ticks_that_it_missed_while_it_waited_for_a_chunk(
    server: Server, policy: Callable[..., VlagentsPolicy], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Policies of earlier tests hold their sessions until they are collected as garbage.
    earlier = {session.id for session in server.engine.sessions.all()}
    made = policy(n_action_steps=2, priority="robot")
    made._robot.hz = 20.0
    # Before and after each request. An episode begins with its first answer.
    moments = iter([0.0, 9.0, 20.0, 20.17, 30.0, 30.01])
    clock = SimpleNamespace(monotonic=lambda: next(moments))
    monkeypatch.setattr(modeling_vlagents, "time", clock)
    for _ in range(6):
        made.select_action(batch(1))
    [session] = [one for one in server.engine.sessions.all() if one.id not in earlier]
    assert session.times is not None
    assert session.times.lately(server.engine.clock())[:2] == (7, 3)


def test_threads_that_share_a_policy_have_sessions_of_their_own(
    policy: Callable[..., VlagentsPolicy],
) -> None:
    made = policy()
    made.select_action(batch(1))
    with ThreadPoolExecutor(1) as another:
        np.testing.assert_array_equal(
            another.submit(made.select_action, batch(2)).result()[0], expected(2)[0]
        )
    np.testing.assert_array_equal(made.select_action(batch(2))[0], expected(1)[1])


def test_images_are_sent_as_the_bytes_that_the_camera_gave_and_states_by_their_names() -> None:
    image = np.random.default_rng(1).integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)
    frame = {"observation.images.left": image, "observation.images.top": 255 - image}
    frame["observation.state"] = np.arange(3, dtype=np.float32) / 4
    images = dict.fromkeys(("observation.images.left", "observation.images.top"), (3, SIDE, SIDE))
    shapes = images | {"observation.state": (3,)}
    config, names = VlagentsConfig(cameras={"top": "left"}), ["gripper", "joints_0", "joints_1"]
    mapping = ObservationMapping(config, CONTRACT, shapes, names)
    obs = mapping.observation(prepare_observation_for_inference(frame, torch.device("cpu")), 0)
    # The robot's own camera of that name is not sent.
    assert (list(obs.cameras), mapping.unused) == (["top"], ["top"])
    np.testing.assert_array_equal(obs.cameras["top"], image)
    np.testing.assert_array_equal(obs.state["joints"], np.array([0.25, 0.5], np.float32))
    assert obs.gripper == 0.0
    assert differences(CONTRACT, mapping.contract(3, 20.0)) == []


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"url": ""}, "policy.url: expected the server's URL, got none"),
        ({"state": []}, "expected the parts ['joints', 'gripper'] of the policy"),
        ({"state": ["joints"]}, "expected ['joints'] of the policy"),
        ({"cameras": {"top": "tpo"}}, "did you mean 'top'"),
        ({"n_action_steps": 3}, "expected at most 2"),
        ({"n_action_steps": 0}, "expected 1 or more"),
        ({"n_obs_steps": 2}, "the server keeps the history"),
        ({"certificate": [Path("a.pem")]}, "expected two files"),
        (
            {"key_file": Path("nowhere")},
            "policy.key_file: expected a file with an API key, got 'nowhere'",
        ),
        ({"pretrained_path": Path("somewhere")}, "the server loads the checkpoint"),
    ],
)
def test_options_that_do_not_fit_are_refused_before_the_first_observation(
    policy: Callable[..., VlagentsPolicy], options: dict[str, Any], said: str
) -> None:
    with pytest.raises(ConfigError) as refused:
        policy(**options)
    assert said in str(refused.value)


def test_other_actions_a_missing_task_and_training_are_refused(
    server: Server, policy: Callable[..., VlagentsPolicy]
) -> None:
    env = MirrorEnvConfig()
    env.features["action"] = PolicyFeature(FeatureType.ACTION, (4,))
    with pytest.raises(
        ContractMismatch, match=r"action\.dim: the policy returns 3, the env accepts 4"
    ):
        make_policy(VlagentsConfig(url=server.url, state=["joints", "gripper"]), env_cfg=env)
    made = policy()
    with pytest.raises(ConfigError, match=r"--policy\.instruction"):
        made.select_action(batch(1) | {"task": [""]})
    for train in (made.get_optim_params, made.config.get_optimizer_preset):
        with pytest.raises(
            ConfigError, match="expected a policy whose weights are on this machine"
        ):
            train()


def test_a_policy_without_features_learns_them_from_the_first_observation(server: Server) -> None:
    config = VlagentsConfig(url=server.url, state=["joints", "gripper"])
    # As lerobot-rollout of LeRobot 0.6 does.
    made = VlagentsPolicy.from_pretrained(None, config=config, revision=None)
    np.testing.assert_array_equal(made.select_action(batch(5))[0], expected(5)[0])
    made.reset()
    with pytest.raises(ContractMismatch, match="camera 'top': the policy needs it"):
        made.select_action({key: value for key, value in batch(5).items() if "top" not in key})


class Trained(MirrorPolicy):
    """A policy that declares the ranges of its training."""

    def __init__(self, part: str, low: float, high: float) -> None:
        super().__init__()
        self.statistics = {
            "parts": ["joints", "gripper"],
            part: {"min": [low] * 3, "max": [high] * 3},
        }


@pytest.mark.parametrize(
    ("part", "low", "high", "said"),
    [
        ("observation.state", 0.0, 10.0, None),
        (
            "observation.state",
            0.0,
            1.0,
            r"state\[0\].*: expected 0 to 1, the range of the training, got 9",
        ),
        ("action", 1000.0, 1001.0, r"first chunk\[0\].*expected 1000 to 1001"),
    ],
)
def test_a_robot_outside_of_the_training_is_found_before_the_first_motion(
    monkeypatch: pytest.MonkeyPatch, part: str, low: float, high: float, said: str | None
) -> None:
    with serving(Trained(part, low, high)) as server:
        monkeypatch.setenv("VLAGENTS_RAY_API_KEY", server.key)

        def act(**options: Any) -> None:
            config = VlagentsConfig(
                url=server.url, state=["joints", "gripper"], connect_timeout_s=20, **options
            )
            make_policy(config, env_cfg=MirrorEnvConfig()).select_action(batch(9))

        if said is None:
            act()
            return
        with pytest.raises(ContractMismatch, match=said):
            act()
        act(ignore_mismatch=True)
        act(priority="simulation")


def test_joints_in_another_order_than_that_of_the_policy_are_found_by_name() -> None:
    shapes = {"observation.images.top": (3, SIDE, SIDE), "observation.state": (3,)}
    names = ["joints_0", "joints_1", "gripper"]
    here = ObservationMapping(VlagentsConfig(), CONTRACT, shapes, names).contract(
        3, 20.0, ["b.pos", "a.pos", "gripper.pos"]
    )
    trained = replace(CONTRACT, action=replace(CONTRACT.action, names=("a", "b", "gripper")))
    [first, _] = [line for line in differences(trained, here) if "action.names" in line]
    assert "number 0 is 'a' in the policy and 'b' in the env" in first
