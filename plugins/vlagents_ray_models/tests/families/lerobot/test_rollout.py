"""LeRobot 0.6's own `lerobot-rollout`, as users type it, with the plug-in of plugins/ and
policies on servers.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
import torch
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.rollout.inference.rtc import supports_rtc_inference
from lerobot_robot_mirror import MOVED, WATCHED, moved_to
from mirror_policy import COUNT, HZ, ROWS, CountingPolicy, MirrorPolicy, colour_of, mirrored

from lerobot_policy_vlagents.configuration_vlagents import VlagentsConfig
from lerobot_policy_vlagents.modeling_vlagents import VlagentsPolicy
from plugins.vlagents_ray_models.tests.families.lerobot.commands import (
    Server,
    make_site,
    run,
    serving,
)
from plugins.vlagents_ray_models.tests.families.lerobot.test_commands import TASK, batch
from vlagents_ray.errors import ConfigError
from vlagents_ray.recorded_dataset import Names, RecordedDataset

HORIZON, CORRECTIONS = 12, 2


@dataclass(frozen=True)
class Rollout:
    """A rollout that ended."""

    status: int
    log: str
    # What the robot was seen to be when it got an action, and the action.
    sent: list[dict[str, Any]]
    folder: Path  # folder of all rollouts


@pytest.fixture(scope="module")
def mirror() -> Iterator[Server]:
    with serving(MirrorPolicy()) as found:
        yield found


@pytest.fixture(scope="module")
def counting() -> Iterator[Server]:
    with serving(CountingPolicy()) as found:
        yield found


@pytest.fixture(scope="module")
def rollouts(
    mirror: Server, counting: Server, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Rollout]:
    """The commands of these tests, after they ended."""
    folder = tmp_path_factory.mktemp("rollouts")
    usual = [
        "lerobot-rollout",
        "--robot.type=mirror",
        f"--fps={HZ}",
        f"--task={TASK}",
        "--play_sounds=false",
    ]
    usual += ["--return_to_initial_position=false"]
    record = [
        "--dataset.repo_id=me/rollout_mirror",
        "--dataset.push_to_hub=false",
        f"--dataset.fps={HZ}",
    ]
    record += [f"--dataset.root={folder / 'recorded'}", "--dataset.rgb_encoder.vcodec=h264"]
    rtc = ["--inference.type=rtc", f"--inference.rtc.execution_horizon={HORIZON}"]
    commands = {
        "base": [
            *mirror.options(folder),
            "--strategy.type=base",
            "--policy.seed=3",
            "--robot.actions=9",
        ],
        "dagger": [
            *mirror.options(folder),
            *record,
            "--strategy.type=dagger",
            "--teleop.type=mirror",
            "--policy.seed=5",
            f"--strategy.num_episodes={CORRECTIONS}",
            "--strategy.smooth_handover=false",
        ],
        "rtc": [*counting.options(folder), *rtc, "--strategy.type=base", "--robot.actions=40"],
        "refused": [*mirror.options(folder), *rtc, "--strategy.type=base", "--robot.actions=1"],
    }
    MirrorPolicy.begun.clear()
    CountingPolicy.plans.clear()
    logs = {name: folder / f"{name}.jsonl" for name in commands}
    typed = [[*usual, *command, f"--robot.log={logs[name]}"] for name, command in commands.items()]
    ended = run(
        typed, make_site(tmp_path_factory.mktemp("site"), tmp_path_factory.mktemp("source")), folder
    )
    lines = {
        name: log.read_text().splitlines() if log.exists() else [] for name, log in logs.items()
    }
    return {
        name: Rollout(*each, [json.loads(line) for line in lines[name]], folder)
        for name, each in zip(commands, ended, strict=True)
    }


def policys(sent: list[dict[str, Any]]) -> int:
    """Check that each action is the policy's, the operator's, or the last one again; the number
    of the policy's.
    """
    row = acts = moves = found = 0
    last: list[float] = []
    for one in sent:
        if one["moves"] > moves:
            moves, row, acts = one["moves"], 0, 0
            assert one["action"] == moved_to(moves)
        elif one["action"] != last:
            if row == 0:
                acts += 1
                chunk = mirrored(
                    np.array(one["state"], np.float32), colour_of(one["image"]), acts, TASK
                )
            np.testing.assert_array_equal(np.array(one["action"], np.float32), chunk[row])
            row, found = (row + 1) % ROWS, found + 1
        last = one["action"]
    return found


@pytest.mark.program("LeRobot lerobot-rollout with RTC")
def test_a_rollout_executes_the_actions_of_the_servers_policy(rollouts: dict[str, Rollout]) -> None:
    done = rollouts["base"]
    assert done.status == 0, done.log
    assert policys(done.sent) == len(done.sent) >= 9
    assert MirrorPolicy.begun[0] == (TASK, 3)


def test_dagger_records_the_corrections_and_begins_an_episode_after_each(
    rollouts: dict[str, Rollout],
) -> None:
    done = rollouts["dagger"]
    assert done.status == 0, done.log
    assert policys(done.sent) >= CORRECTIONS * WATCHED
    assert MirrorPolicy.begun[1:] == [(TASK, 5), (TASK, 6)]
    recorded = done.folder / "recorded"
    episodes = [session.episodes[0] for session in RecordedDataset(recorded).sessions()]
    names = Names(state=["joints", "gripper"])
    actions = [
        [
            step.expected[0].tolist()
            for step in RecordedDataset(recorded).steps(part, names, MirrorPolicy.contract)
        ]
        for part in episodes
    ]
    assert [len(one) >= MOVED for one in actions] == [True] * CORRECTIONS
    whole = [action for one in actions for action in one]
    assert whole == [moved_to(move) for move in range(1, len(whole) + 1)]
    [file] = recorded.glob("data/*/*.parquet")
    assert pyarrow.parquet.read_table(file)["intervention"].to_pylist() == [True] * len(whole)


@pytest.mark.program("LeRobot lerobot-rollout with RTC")
def test_real_time_chunking_sends_the_plan_that_is_executed(rollouts: dict[str, Rollout]) -> None:
    done = rollouts["rtc"]
    assert done.status == 0, done.log
    first, *others = CountingPolicy.plans
    assert first[0][0, 0] >= 10 * COUNT  # LeRobot asks again when 30 of 40 rows are left
    for plan, delay in (first, *others):
        # No row of zeros.
        np.testing.assert_array_equal(plan, plan[0] + COUNT * np.arange(len(plan))[:, None])
        assert len(plan) <= HORIZON
        assert 1 <= delay <= len(plan)
    sent = np.array([one["action"] for one in done.sent]) / COUNT
    assert len(sent) >= 40
    assert (sent == np.round(sent[:, :1])).all()
    assert len(np.unique(sent)) > 30  # as each chunk goes on from the plan; alone, each begins at 1


def test_real_time_chunking_without_a_policy_that_has_it_is_refused_before_the_robot_moves(
    rollouts: dict[str, Rollout],
) -> None:
    done = rollouts["refused"]
    assert done.status == 1
    assert done.sent == []
    assert "--inference.type=sync" in done.log
    assert "ChunkPlayer" in done.log


@pytest.fixture
def policy(counting: Server, monkeypatch: pytest.MonkeyPatch) -> VlagentsPolicy:
    monkeypatch.setenv("VLAGENTS_RAY_API_KEY", counting.key)
    policy = VlagentsPolicy(VlagentsConfig(url=counting.url, state=["joints", "gripper"]))
    assert supports_rtc_inference(policy)
    return policy


@pytest.mark.parametrize(
    "setting", [{"max_guidance_weight": 5.0}, {"prefix_attention_schedule": "EXP"}]
)
def test_settings_of_the_guidance_are_the_servers(
    setting: dict[str, Any], policy: VlagentsPolicy
) -> None:
    policy.config.rtc_config = RTCConfig(**setting)
    with pytest.raises(
        ConfigError, match=rf"inference\.rtc\.{next(iter(setting))}.*its deployment file"
    ):
        policy.init_rtc_processor()


def test_a_reset_on_another_thread_begins_an_episode_without_its_plan(
    policy: VlagentsPolicy,
) -> None:
    """LeRobot computes chunks on a separate thread, and resets the policy on the main one."""
    policy.config.rtc_config = RTCConfig(execution_horizon=3)
    policy.init_rtc_processor()
    # The last row is LeRobot's filling.
    plan = torch.tensor([[7.0] * 3, [8.0] * 3, [0.0] * 3]) * COUNT

    def chunk() -> list[float]:
        rows = policy.predict_action_chunk(batch(1), inference_delay=1, prev_chunk_left_over=plan)[
            0, :3, 0
        ]
        return (rows / COUNT).tolist()

    CountingPolicy.plans.clear()
    assert chunk() == [1, 2, 3]  # an episode has begun, without a plan
    assert chunk() == [7, 8, 9]
    [(rows, delay)] = CountingPolicy.plans
    assert ((rows[:, 0] / COUNT).tolist(), delay) == ([7, 8], 1)
    policy.reset()
    assert chunk() == [1, 2, 3]
    policy.config.rtc_config = RTCConfig(enabled=False)
    assert chunk() == [1, 2, 3]
