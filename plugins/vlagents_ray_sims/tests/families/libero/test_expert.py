"""Tests that LIBERO's expert meets each kind of goal that it supports, tries again, and rejects
other goals.
"""

from __future__ import annotations

import numpy as np
import pytest

from vlagents_ray.errors import ContractMismatch, InvalidObservation, NotReset
from vlagents_ray.interface import Obs
from vlagents_ray_sims.experts.libero import LiberoExpert
from vlagents_ray_sims.libero import Libero

_IN = ["in", "milk_1", "basket_1_contain_region"]


def observation(
    *goal: list[str], unmet: list[list[str]] | None = None, hand: tuple[float, ...] = (0, 0, 1.1)
) -> Obs:
    positions = {
        name: np.array([0.0, 0.1, 0.9]) for name in ("milk_1", "basket_1_contain_region", "stove_1")
    }
    pose = np.array([*hand, np.pi, 0.0, 0.0], np.float32)
    state = {
        "goal": list(goal),
        "unmet": list(goal) if unmet is None else unmet,
        "positions": positions,
    }
    return Obs(state={"xyz_axis_angle": pose}, info={"sim_state": state | {"quaternions": {}}})


@pytest.mark.slow
@pytest.mark.parametrize(
    "task",
    [
        "libero_spatial/0",  # a bowl, which is grasped at its rim
        "libero_object/0",
        "libero_90/0",  # a drawer to close
        "libero_90/20",  # a knob to turn
    ],
)
def test_the_expert_solves_the_task_within_its_steps(task: str) -> None:
    with Libero(task, width=16, height=16) as env:
        env.looked_at = False
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
        assert obs.info["sim_state"]["unmet"] == []


def test_it_opens_the_hand_over_the_thing_first() -> None:
    expert = LiberoExpert("libero/libero_object/7")
    obs = observation(_IN)
    expert.reset(obs, "")
    action = expert.act(obs).action
    assert action.shape == (7,)
    assert action.dtype == np.float32
    np.testing.assert_allclose(action, [0, 1, 0, 0, 0, 0, -1], atol=1e-6)


def test_what_is_met_is_left_alone_and_what_failed_is_tried_again() -> None:
    expert = LiberoExpert("libero/libero_10/2")
    obs = observation(_IN, ["turnon", "stove_1"], unmet=[_IN])
    expert.reset(obs, "")
    # The hand never arrives, so each phase lasts for all its steps.
    acts = [expert.act(obs).action for _ in range(400)]
    first, second = np.flatnonzero(np.diff([act[6] for act in acts]) > 0)
    assert acts[first][5] == 0  # the hand is turned for the second attempt
    assert abs(acts[second][5]) > 0.1


def test_it_stays_once_the_goal_is_met() -> None:
    expert = LiberoExpert("libero/libero_object/7")
    expert.reset(observation(_IN), "")
    for _ in range(170):  # until the second attempt has begun
        expert.act(observation(_IN))
    met = observation(_IN, unmet=[])
    # The expert finishes the second attempt.
    grippers = [expert.act(met).action[6] for _ in range(600)]
    assert set(grippers[-200:]) == {-1.0}


@pytest.mark.parametrize("goal", [["open", "cabinet_1"], ["turnoff", "stove_1"]])
def test_a_goal_that_it_cannot_meet_is_refused(goal: list[str]) -> None:
    with pytest.raises(ContractMismatch, match=rf"libero_90/6.*'turnon'.*got \['{goal[0]}'\]"):
        LiberoExpert("libero/libero_90/6").reset(observation(_IN, goal), "")


def test_without_the_simulators_state_it_says_what_it_wants() -> None:
    expert = LiberoExpert("libero/libero_spatial/0")
    with pytest.raises(InvalidObservation, match="sim_state"):
        expert.reset(Obs(), "")
    with pytest.raises(NotReset):
        expert.act(Obs())
