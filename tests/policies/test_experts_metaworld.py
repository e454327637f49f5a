"""Meta-World's oracles behind the experts' interface."""

from __future__ import annotations

import numpy as np
import pytest
from experts.metaworld import MetaWorldExpert

from vlagents_ray.envs.metaworld import MetaWorld
from vlagents_ray.errors import ContractMismatch, InvalidObservation
from vlagents_ray.interface import Obs

pytestmark = [pytest.mark.sim, pytest.mark.integration]


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


def test_without_the_simulators_observation_the_oracle_says_what_it_wants() -> None:
    expert = MetaWorldExpert("metaworld/reach-v3")
    with pytest.raises(InvalidObservation, match=r"sim_state.*\(39,\)"):
        expert.reset(Obs(), "reach")


def test_a_task_without_oracle_is_refused() -> None:
    with pytest.raises(ContractMismatch, match=r"reach-v2.*reach-v3"):
        MetaWorldExpert("metaworld/reach-v2")
