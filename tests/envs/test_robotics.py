"""Gymnasium-Robotics' Fetch tasks: goals in the observation, success at the last step."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from experts.robotics import FetchReach
from in_process_episode import Always, play

from vlagents_ray.envs import EvalEnv, make_env
from vlagents_ray.errors import MissingState
from vlagents_ray.interface import Obs
from vlagents_ray.testing import check_env

pytestmark = [pytest.mark.sim, pytest.mark.integration]

NAME = "gymnasium/FetchReach-v4"


@pytest.fixture(scope="module")
def reach() -> Iterator[EvalEnv]:
    with make_env(NAME, width=32, height=32) as env:
        yield env


def test_it_keeps_the_promises_of_an_env() -> None:
    check_env(make_env("gymnasium/FetchPickAndPlaceDense-v4", width=32, height=32))


def test_the_parts_of_the_goal_observation_are_parts_of_the_state(reach: EvalEnv) -> None:
    obs, _ = reach.reset(seed=0)
    assert {name: part.shape for name, part in obs.state.items()} == {
        "observation": (10,),
        "achieved_goal": (3,),
        "desired_goal": (3,),
    }
    assert obs.cameras["front"].shape == (32, 32, 3)


def test_moving_to_the_target_is_a_success(reach: EvalEnv) -> None:
    for seed in range(3):
        result = play(reach, NAME, "experts.robotics:FetchReach", seed=seed)
        assert (result.success_at_end, result.ending, result.steps) == (True, "truncated", 50)
        assert result.episode_return > -10.0  # sparse reward: -1 in each step away from the target


def test_staying_where_it_is_is_none(reach: EvalEnv) -> None:
    result = play(reach, NAME, Always(0.0, 0.0, 0.0, 0.0), seed=0)
    assert (result.success_once, result.success_at_end, result.episode_return) == (
        False,
        False,
        -50.0,
    )


@pytest.mark.parametrize("task", ["Reach", "Push", "Slide", "PickAndPlace"])
def test_each_task_has_its_instruction_and_the_protocol(task: str) -> None:
    with make_env(f"gymnasium/Fetch{task}-v4", width=16, height=16) as env:
        protocol = env.describe()["protocol"]
        assert "target" in env.instruction
        assert (protocol["name"], env.max_steps, protocol["deviations"]) == ("Fetch", 50, [])
        simulator = env._env.unwrapped  # type: ignore[attr-defined]
        assert simulator.distance_threshold == 0.05
        assert simulator.dt == pytest.approx(1 / protocol["control_hz"])


def test_the_expert_says_that_it_wants_goals() -> None:
    expert = FetchReach(NAME)
    with pytest.raises(MissingState, match="desired_goal"):
        expert.reset(Obs(state={"joints": np.zeros(7, np.float32)}), "reach")
