"""The expert for SIMPLER, on the twins that it is for, through the policy that serves experts."""

from __future__ import annotations

import numpy as np
import pytest
from experts.simpler import SimplerExpert

from vlagents_ray.envs import make_env
from vlagents_ray.envs.simpler import Simpler
from vlagents_ray.errors import InvalidObservation
from vlagents_ray.interface import Obs
from vlagents_ray.policies.scripted import Scripted

pytestmark = pytest.mark.sim


@pytest.mark.vulkan
@pytest.mark.assets("simpler")
@pytest.mark.slow
@pytest.mark.parametrize(("task", "state"), list(zip(Simpler.tasks(), (1, 12, 12, 1), strict=True)))
def test_it_solves_every_task_however_the_object_lies(task: str, state: int) -> None:
    name = f"simpler/{task}"
    with make_env(name, shader="minimal") as env:  # experts do not look at the image
        obs, _ = env.reset(seed=0, options={"init_state": state})
        agent = Scripted.from_config({"expert": "experts.simpler:SimplerExpert"})
        assert agent.reset(obs, env.instruction, env=name) == {"expert": "SimplerExpert"}
        over = False
        while not over:
            obs, _, _, over, info = env.step(agent.act(obs))
        assert info["success"]


@pytest.mark.parametrize("state", [None, np.zeros(7, np.float32)])
def test_without_the_simulators_state_the_expert_says_what_it_wants(state: np.ndarray | None) -> None:
    expert = SimplerExpert("simpler/PutCarrotOnPlateInScene-v1")
    with pytest.raises(InvalidObservation, match=r"sim_state.*\(13,\).*PutCarrotOnPlate"):
        expert.reset(Obs(info={} if state is None else {"sim_state": state}), "put carrot on plate")
