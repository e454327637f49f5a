"""The public suites, over every registered name."""

from __future__ import annotations

import pytest

from vlagents_ray.envs import make_env
from vlagents_ray.policies.scripted import Scripted
from vlagents_ray.registry import names, policy_class
from vlagents_ray.testing import check_agent, check_env

# Registered names whose own test modules run the suites, because they need a simulator, a setting or a checkpoint.
CHECKED_ELSEWHERE = {"maniskill", "metaworld", "openvla", "openvla_oft", "replay"}
ENV_NAMES = {
    "tabletop": ["tabletop"],
    "gymnasium": ["gymnasium/Pendulum-v1", "gymnasium/gym_pusht/PushT-v0"],
}


@pytest.mark.parametrize("suite", sorted(set(names("envs")) - CHECKED_ELSEWHERE))
def test_every_registered_env_passes(suite: str) -> None:
    for name in ENV_NAMES[suite]:
        check_env(make_env(name), step_limit=False, same_steps=True)


@pytest.mark.parametrize("name", sorted(set(names("policies")) - CHECKED_ELSEWHERE))
def test_every_registered_policy_passes(name: str) -> None:
    agent = policy_class(name).from_config({})
    if not isinstance(agent, Scripted):
        check_agent(agent)
        return
    with make_env("tabletop") as env:
        obs, _ = env.reset(seed=0)
        check_agent(agent, obs=obs, instructions=[env.instruction], reset_kwargs={"env": "tabletop"})
