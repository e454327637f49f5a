"""One policy that runs the expert of each environment."""

from __future__ import annotations

import numpy as np
import pytest

from vlagents_ray import Act, Obs
from vlagents_ray.envs import make_env
from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.errors import (
    ContractMismatch,
    InvalidInput,
    InvalidObservation,
    MissingCamera,
    MissingState,
    NotReset,
)
from vlagents_ray.policies.experts import EXPERTS, expert_class
from vlagents_ray.policies.experts.tabletop import TabletopExpert
from vlagents_ray.policies.scripted import Scripted
from vlagents_ray.registry import env_suite
from vlagents_ray.testing import check_agent


def tabletop_views() -> tuple[list[Obs], list[str]]:
    views, instructions = [], []
    with make_env("tabletop") as env:
        for seed in range(3):
            views.append(env.reset(seed=seed)[0])
            instructions.append(env.instruction)
    return views, instructions


def test_keeps_the_contract() -> None:
    views, instructions = tabletop_views()
    check_agent(
        Scripted(), obs=views, instructions=instructions, reset_kwargs={"env": "tabletop"}, steps=10
    )


def test_the_env_of_reset_comes_before_the_task_of_the_config() -> None:
    views, instructions = tabletop_views()
    agent = Scripted.from_config({"task": "tabletop"})
    assert agent.reset(views[0], instructions[0]) == {"expert": "TabletopExpert"}
    with pytest.raises(ContractMismatch, match="kitchen"):
        agent.reset(views[0], instructions[0], env="kitchen/Cook-v1")


def test_a_task_without_expert_is_refused_with_those_there_are() -> None:
    with pytest.raises(ContractMismatch, match="maniskill/PushCube-v1") as caught:
        expert_class("maniskill/PlugCharger-v1")
    assert "PlugCharger" in str(caught.value)


def test_every_registered_expert_is_named_after_a_registered_env() -> None:
    from vlagents_ray.registry import names

    assert {env_suite(name) for name in EXPERTS} <= set(names("envs"))


def test_without_env_and_task_reset_says_what_is_missing() -> None:
    with pytest.raises(InvalidInput, match="env='tabletop'"):
        Scripted().reset(Obs(), "lift the red puck")


def test_act_before_reset_is_refused() -> None:
    with pytest.raises(NotReset):
        Scripted().act(Obs())
    with pytest.raises(NotReset):
        TabletopExpert("tabletop").act(Obs())


def test_a_failed_reset_keeps_no_expert() -> None:
    views, instructions = tabletop_views()
    agent = Scripted()
    agent.reset(views[0], instructions[0], env="tabletop")
    with pytest.raises(MissingCamera):
        agent.reset(Obs(), "lift the red puck", env="tabletop")
    with pytest.raises(NotReset):
        agent.act(views[0])


@pytest.mark.parametrize(
    "text", ["", "lift the orange puck", "open the drawer", "put the red puck on the blue puck"]
)
def test_an_instruction_that_it_does_not_understand_is_refused(text: str) -> None:
    views, _ = tabletop_views()
    with pytest.raises(InvalidObservation, match="expected an instruction like"):
        TabletopExpert("tabletop").reset(views[0], text)


def test_a_puck_that_is_not_in_sight_is_named() -> None:
    with pytest.raises(InvalidObservation, match="no red puck"):
        TabletopExpert("tabletop").reset(
            Obs(cameras={"front": np.full((64, 64, 3), 200, np.uint8)}), "lift the red puck"
        )


def test_missing_proprioception_is_named() -> None:
    views, instructions = tabletop_views()
    expert = TabletopExpert("tabletop")
    expert.reset(views[0], instructions[0])
    with pytest.raises(MissingState, match="xyzrpy"):
        expert.act(Obs(gripper=1.0))
    with pytest.raises(InvalidObservation, match="gripper"):
        expert.act(Obs(state=views[0].state))


def test_it_looks_again_and_succeeds_when_the_puck_was_moved_away_under_it() -> None:
    env = Tabletop("lift")
    agent = Scripted()
    for seed in range(10):
        obs, _ = env.reset(seed=seed)
        colour = env.instruction.split()[2]
        agent.reset(obs, env.instruction, env="tabletop/lift")
        assert env._world is not None
        puck = env._world.puck(colour)
        puck.x, puck.y = 0.26, -0.19  # an empty corner
        success = truncated = False
        while not truncated and not success:
            obs, _, _, truncated, info = env.step(agent.act(obs))
            success = info["success"]
        assert success, (seed, env.instruction)


def test_done_is_said_when_and_only_when_the_task_is_fulfilled() -> None:
    env = Tabletop()
    agent = Scripted()
    for seed in range(20):
        obs, _ = env.reset(seed=seed)
        agent.reset(obs, env.instruction, env="tabletop")
        act, success, truncated = Act(np.zeros(4)), False, False
        while not act.done and not truncated:
            act = agent.act(obs)
            obs, _, _, truncated, info = env.step(act)
            success = info["success"]
        assert act.done
        assert success
