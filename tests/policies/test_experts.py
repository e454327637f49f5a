"""The experts of ManiSkill's tasks: they solve the installed tasks, and a missing requirement of an
expert is named.
"""

from __future__ import annotations

import numpy as np
import pytest

from vlagents_ray.envs.maniskill import ManiSkill
from vlagents_ray.errors import InvalidObservation
from vlagents_ray.interface import Obs
from vlagents_ray.policies.experts import expert_class

EPISODES = 4
CUBES = ("PushCube-v1", "PickCube-v1")


@pytest.mark.sim
@pytest.mark.vulkan
@pytest.mark.slow
@pytest.mark.parametrize("task", CUBES)
def test_the_expert_solves_the_task_and_the_cube_stays(task: str) -> None:
    name = f"maniskill/{task}"
    with ManiSkill(task, width=16, height=16) as env:  # experts do not use the image
        for seed in range(EPISODES):
            obs, _ = env.reset(seed=seed)
            expert = expert_class(name)(name)
            expert.reset(obs, env.instruction)
            successes = []
            truncated = terminated = False
            while not truncated:
                obs, _, terminated, truncated, info = env.step(expert.act(obs))
                successes.append(info["success"])
                assert not terminated
            assert len(successes) == env.max_steps == 50  # the environment continues after success
            assert successes[-1], f"seed {seed}"


def test_a_stuck_arm_gets_shorter_commands() -> None:
    """ManiSkill's inverse kinematics fails for some long steps, after which the arm does
    not move.
    """
    expert = expert_class("maniskill/PushCube-v1")("maniskill/PushCube-v1")
    state = np.zeros(35, np.float32)
    state[25:28] = (0.2, 0.0, 0.0)  # the goal
    state[18:21], state[28:31] = (-0.3, 0.0, 0.15), (0.0, 0.0, 0.02)  # the tool, far from the cube
    obs = Obs(info={"sim_state": state})
    expert.reset(obs, "")
    forward = [float(expert.act(obs).action[0]) for _ in range(6)]
    assert forward[0] == 1.0
    assert forward[:4] == sorted(forward[:4], reverse=True)
    assert 0.1 <= forward[-1] <= 0.3


@pytest.mark.parametrize("task", CUBES)
def test_without_the_simulators_state_the_expert_says_what_it_wants(task: str) -> None:
    name = f"maniskill/{task}"
    expert = expert_class(name)(name)
    for info in ({}, {"sim_state": np.zeros(7, np.float32)}):
        with pytest.raises(InvalidObservation, match=rf"sim_state.*{task}.*pd_ee_delta_pose"):
            expert.reset(Obs(info=info), "push the cube")
