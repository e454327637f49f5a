"""A scene of two arms from RCS's own pieces."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from vlagents_ray.envs import make_env
from vlagents_ray.envs.rcs import Rcs
from vlagents_ray.interface import Act
from vlagents_ray.testing import check_env

pytestmark = pytest.mark.assets("rcs")
LAB = {"module": "tests.families.rcs.two_arms", "max_steps": 8, "instruction": "pick up the cuboid"}


@pytest.fixture(scope="module")
def lab() -> Iterator[Rcs]:
    with Rcs("lab/two_arms", cameras=[], **LAB) as env:
        yield env


def test_an_id_that_somebody_registered_keeps_the_promises_of_an_env() -> None:
    check_env(make_env("rcs/lab/two_arms", width=32, height=32, **LAB))


def test_each_arm_has_its_parts_under_its_name(lab: Rcs) -> None:
    state = lab.reset(seed=0)[0].state
    assert {name: part.shape[0] for name, part in state.items()} == {
        f"{side}/{part}": size
        for side in ("left", "right")
        for part, size in (("joints", 7), ("tquat", 7), ("xyzrpy", 6), ("gripper", 1))
    }
    assert (lab.contract.action.dim, lab.contract.action.arms) == (16, ("left", "right"))
    assert lab.contract.gripper is False
    assert state["left/tquat"][1] - state["right/tquat"][1] == pytest.approx(0.8, abs=1e-3)  # in one frame


@pytest.mark.parametrize(("moved", "still", "first"), [("left", "right", 0), ("right", "left", 8)])
def test_each_arm_follows_its_part_of_the_action(lab: Rcs, moved: str, still: str, first: int) -> None:
    begin = lab.reset(seed=0)[0].state
    action = np.concatenate([[*begin[f"{side}/joints"], 1.0] for side in ("left", "right")]).astype(np.float32)
    action[first] += 0.2
    action[first + 7] = 0.0
    for _ in range(30):
        obs, *_ = lab.step(Act(action))
    assert obs.state[f"{moved}/joints"][0] - begin[f"{moved}/joints"][0] == pytest.approx(0.2, abs=0.01)
    np.testing.assert_allclose(obs.state[f"{still}/joints"], begin[f"{still}/joints"], atol=0.01)
    assert obs.state[f"{moved}/gripper"][0] < 0.05
    assert obs.state[f"{still}/gripper"][0] > 0.95
