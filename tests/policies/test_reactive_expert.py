"""The expert for corrections under delay, whose action depends only on the current observation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from reactive import expert_action

from vlagents_ray import Act, Obs
from vlagents_ray.envs import EvalEnv, make_env

GRIPPER = 3  # the column of the gripper
NEAR = 2e-4  # m, distance of two neighbouring states
# Largest change of a motion between these states, in units of an action of 3 cm. Positions alone
# change a motion by 0.007; the heights above a puck change eight times as fast as the position.
LARGEST_CHANGE = 0.1


@pytest.fixture(scope="module")
def env() -> Iterator[EvalEnv]:
    with make_env("tabletop", width=32, height=32, object_state=True) as made:
        yield made


def moved(obs: Obs, rng: np.random.Generator) -> Obs:
    tip = obs.state["xyzrpy"].copy()
    tip[:3] += rng.uniform(-NEAR, NEAR, 3).astype(np.float32)
    return replace(obs, state={**obs.state, "xyzrpy": tip})


@pytest.mark.parametrize("seed", range(40))
def test_it_solves_every_task_also_after_actions_of_another_driver(env: EvalEnv, seed: int) -> None:
    obs, _ = env.reset(seed=seed)
    env.looked_at = False
    rng = np.random.default_rng(seed)
    is_slide = env.instruction.startswith("slide")  # A lifted puck cannot be slid any more.
    for tick in range(env.max_steps):
        action = expert_action(obs, env.instruction)
        if tick % 3 == 0 and not is_slide:
            action[:GRIPPER] += rng.normal(0, 0.3, 3)
        obs, _, _, _, info = env.step(Act(action))
        if info["success"]:
            return
    raise AssertionError(f"{env.instruction}: not solved")


@pytest.mark.parametrize("seed", range(10))
def test_neighbouring_states_have_similar_motions(env: EvalEnv, seed: int) -> None:
    """Otherwise a policy that learns from its actions hesitates."""
    obs, _ = env.reset(seed=seed)
    env.looked_at = False
    rng = np.random.default_rng(seed)
    for _ in range(env.max_steps):
        action = expert_action(obs, env.instruction)
        for _ in range(20):
            other = expert_action(moved(obs, rng), env.instruction)
            if other[GRIPPER] == action[GRIPPER]:  # Opening and closing are decisions.
                assert np.abs(other - action).max() < LARGEST_CHANGE, (obs.state, obs.gripper)
        action[:GRIPPER] = np.clip(action[:GRIPPER] + rng.normal(0, 0.5, 3), -1, 1)
        obs, _, _, _, _ = env.step(Act(action))
