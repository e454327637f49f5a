"""LIBERO's expert solves tasks of the suites it is for, and says what it cannot do."""

from __future__ import annotations

import numpy as np
import pytest
from experts.osc_pose import LiberoExpert
from needs import assets

from vlagents_ray.envs.libero import Libero
from vlagents_ray.errors import ContractMismatch, InvalidObservation, NotReset
from vlagents_ray.interface import Obs


def observation(goal: list[list[str]]) -> Obs:
    positions = {name: np.array([0.0, 0.1, 0.9]) for name in ("milk_1", "basket_1_contain_region")}
    pose = np.array([0.0, 0.0, 1.1, np.pi, 0.0, 0.0], np.float32)
    return Obs(state={"xyz_axis_angle": pose}, info={"sim_state": {"goal": goal, "positions": positions}})


@pytest.mark.slow
@pytest.mark.assets("libero")
@pytest.mark.parametrize("task", ["libero_spatial/0", "libero_object/0"])
def test_the_expert_solves_the_task_within_its_steps(task: str) -> None:
    with Libero(task, width=16, height=16, assets=str(assets("libero"))) as env:
        obs, _ = env.reset(seed=0, options={"init_state": 0})
        expert = LiberoExpert(f"libero/{task}")
        expert.reset(obs, env.instruction)
        over = False
        while not over:
            act = expert.act(obs)
            assert np.abs(act.action).max() <= 1.0
            obs, reward, terminated, truncated, info = env.step(act)
            over = terminated or truncated
        assert (reward, terminated, info["success"]) == (1.0, True, True)


def test_it_opens_the_hand_over_the_thing_first() -> None:
    expert = LiberoExpert("libero/libero_object/7")
    obs = observation([["in", "milk_1", "basket_1_contain_region"]])
    expert.reset(obs, "")
    action = expert.act(obs).action
    assert action.shape == (7,)
    assert action.dtype == np.float32
    np.testing.assert_allclose(action, [0, 1, -0.8, 0, 0, 0, -1], atol=1e-6)


@pytest.mark.parametrize("goal", [[["open", "cabinet_1"]], [["on", "milk_1", "a"], ["on", "b", "a"]], []])
def test_another_kind_of_goal_is_refused(goal: list[list[str]]) -> None:
    with pytest.raises(ContractMismatch, match="one thing to one place"):
        LiberoExpert("libero/libero_object/0").reset(observation(goal), "")


def test_a_suite_without_expert_is_refused() -> None:
    with pytest.raises(ContractMismatch, match=r"libero_10/3.*libero_spatial"):
        LiberoExpert("libero/libero_10/3")


def test_without_the_simulators_state_it_says_what_it_wants() -> None:
    expert = LiberoExpert("libero/libero_spatial/0")
    with pytest.raises(InvalidObservation, match="sim_state"):
        expert.reset(Obs(), "")
    with pytest.raises(NotReset):
        expert.act(Obs())
