"""The public test suites, for each registered name."""

from __future__ import annotations

import pytest

from vlagents_ray.envs import make_env
from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base import ModelPolicy
from vlagents_ray.policies.scripted import Scripted
from vlagents_ray.registry import entries, names, policy_class
from vlagents_ray.testing import check_agent, check_env

# Registered names whose own test modules run the suites, because they need a simulator or a
# setting.
CHECKED_ELSEWHERE = {
    "libero",
    "libero_pro",
    "maniskill",
    "metaworld",
    "rcs",
    "duobench",
    "robosuite",
    "robocasa",
    "calvin",
    "simpler",
    "aloha",
    "upstream",
}
VARIANTS = {  # further variants of environments to test, in addition to the plain name
    "gymnasium": ["gymnasium/Pendulum-v1", "gymnasium/gym_pusht/PushT-v0"],
    "pusht": ["pusht", "pusht/keypoints"],
}
POLICIES = entries("policies")
SIMULATED = {"gymnasium", "pusht"}


@pytest.mark.parametrize(
    "suite",
    [
        pytest.param(name, marks=pytest.mark.sim) if name in SIMULATED else name
        for name in sorted(set(names("envs")) - CHECKED_ELSEWHERE)
    ],
)
def test_every_registered_env_passes(suite: str) -> None:
    for name in VARIANTS.get(suite, [suite]):
        check_env(make_env(name), step_limit=False, same_steps=True)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.torch) if POLICIES[name].wants == "torch" else name
        for name in sorted(POLICIES.keys() - CHECKED_ELSEWHERE)
    ],
)
def test_every_registered_policy_passes(name: str) -> None:
    cls = policy_class(name)
    # The families' own tests run the suites for these policies.
    if issubclass(cls, ModelPolicy) and cls.Config.model_fields["checkpoint"].is_required():
        with pytest.raises(ConfigError, match="checkpoint"):
            cls.from_config({})
        return
    agent = cls.from_config({})
    if not isinstance(agent, Scripted):
        check_agent(agent)
        return
    with make_env("tabletop") as env:
        obs, _ = env.reset(seed=0)
        check_agent(
            agent, obs=obs, instructions=[env.instruction], reset_kwargs={"env": "tabletop"}
        )
