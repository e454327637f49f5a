"""Tests of the experts: they solve the tasks of installed simulators, and errors name missing
inputs.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from vlagents_ray.envs import make_env
from vlagents_ray.errors import ContractMismatch, InvalidObservation, MissingState
from vlagents_ray.interface import Obs
from vlagents_ray.policies.scripted import Scripted
from vlagents_ray_sims.experts.metaworld import MetaWorldExpert
from vlagents_ray_sims.experts.rcs import RcsPick
from vlagents_ray_sims.experts.simpler import SimplerExpert
from vlagents_ray_sims.metaworld import MetaWorld
from vlagents_ray_sims.simpler import Simpler


@pytest.mark.sim
@pytest.mark.integration
@pytest.mark.slow
@pytest.mark.parametrize("task", ["reach-v3", "button-press-topdown-v3"])
def test_the_oracle_solves_the_task(task: str) -> None:
    with MetaWorld(task, width=16, height=16) as env:
        for seed in range(2):
            obs, _ = env.reset(seed=seed)
            expert = MetaWorldExpert(f"metaworld/{task}")
            expert.reset(obs, env.instruction)
            success = False
            for _ in range(100):
                act = expert.act(obs)
                assert act.action.shape == (4,)
                assert np.abs(act.action).max() <= 1.0
                obs, _, _, _, info = env.step(act)
                if success := info["success"]:
                    break
            assert success, f"{task}, seed {seed}"


@pytest.mark.sim
@pytest.mark.integration
def test_the_oracle_says_what_it_wants() -> None:
    with pytest.raises(InvalidObservation, match=r"sim_state.*\(39,\)"):
        MetaWorldExpert("metaworld/reach-v3").reset(Obs(), "reach")
    with pytest.raises(ContractMismatch, match=r"reach-v2.*did you mean 'reach-v3'"):
        MetaWorldExpert("metaworld/reach-v2")


@pytest.mark.sim
@pytest.mark.vulkan
@pytest.mark.assets("simpler")
@pytest.mark.slow
@pytest.mark.parametrize(("task", "state"), list(zip(Simpler.tasks(), (1, 12, 12, 1), strict=True)))
def test_the_expert_of_simpler_solves_every_task_however_the_object_lies(
    task: str, state: int
) -> None:
    name = f"simpler/{task}"
    with make_env(name, shader="minimal") as env:  # experts do not look at the image
        obs, _ = env.reset(seed=0, options={"init_state": state})
        agent = Scripted.from_config({"expert": "vlagents_ray_sims.experts.simpler:SimplerExpert"})
        assert agent.reset(obs, env.instruction, env=name) == {"expert": "SimplerExpert"}
        over = False
        while not over:
            obs, _, _, over, info = env.step(agent.act(obs))
        assert info["success"]


@pytest.mark.parametrize("info", [{}, {"sim_state": np.zeros(7, np.float32)}])
def test_without_the_simulators_state_the_expert_says_what_it_wants(
    info: dict[str, np.ndarray],
) -> None:
    expert = SimplerExpert("simpler/PutCarrotOnPlateInScene-v1")
    with pytest.raises(InvalidObservation, match=r"sim_state.*\(13,\).*PutCarrotOnPlate"):
        expert.reset(Obs(info=info), "push the cube")


def seen(*, tool: tuple[float, float, float] = (0.3, 0.0, 0.5), turn: float = 0.0) -> Obs:
    """Return an observation with the tool's position, and a cuboid half a metre in front, turned
    about the vertical.
    """
    cuboid = np.array([0.5, 0.0, 0.03, math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)])
    state = {"tquat": np.array([*tool, 1.0, 0.0, 0.0, 0.0], np.float32)}
    return Obs(state=state, info={"objects": {"PickTask_box_joint": cuboid}})


def test_it_sets_out_for_the_cuboid_in_small_steps_with_an_open_gripper() -> None:
    expert = RcsPick("rcs/pick")
    expert.reset(seen(), "pick up the green cuboid")
    action = expert.act(seen()).action
    assert action.shape == (8,)
    way = action[:3] - [0.3, 0.0, 0.5]
    assert np.linalg.norm(way) == pytest.approx(0.02, abs=1e-5)
    assert way[0] > 0.0 > way[2]
    assert action[7] == 1.0


@pytest.mark.parametrize(
    ("turn", "hand"), [(0.0, 0.0), (0.5, 0.5), (-1.0, -1.0), (2.5, 2.5 - math.pi)]
)
def test_the_hand_turns_with_the_cuboid_the_shorter_way(turn: float, hand: float) -> None:
    expert = RcsPick("rcs/pick")
    expert.reset(seen(turn=turn), "pick up the green cuboid")
    quaternion = expert.act(seen(turn=turn)).action[3:7]
    np.testing.assert_allclose(
        quaternion, [math.cos(hand / 2), math.sin(hand / 2), 0.0, 0.0], atol=1e-6
    )


def test_what_it_cannot_do_without_is_named() -> None:
    expert = RcsPick("rcs/pick")
    with pytest.raises(InvalidObservation, match=r"PickTask_box_joint.*tquat"):
        expert.reset(Obs(state=seen().state), "pick up the green cuboid")
    with pytest.raises(MissingState, match="tquat"):
        expert.reset(Obs(info=seen().info), "pick up the green cuboid")
