"""The expert for RCS's pick task, without RCS."""

from __future__ import annotations

import math

import numpy as np
import pytest
from experts.rcs import RcsPick

from vlagents_ray.errors import InvalidObservation, MissingState
from vlagents_ray.interface import Obs


def seen(*, tool: tuple[float, float, float] = (0.3, 0.0, 0.5), turn: float = 0.0) -> Obs:
    """The tool's place, and a cuboid half a metre in front, turned about the vertical."""
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


@pytest.mark.parametrize(("turn", "hand"), [(0.0, 0.0), (0.5, 0.5), (-1.0, -1.0), (2.5, 2.5 - math.pi)])
def test_the_hand_turns_with_the_cuboid_the_shorter_way(turn: float, hand: float) -> None:
    expert = RcsPick("rcs/pick")
    expert.reset(seen(turn=turn), "pick up the green cuboid")
    quaternion = expert.act(seen(turn=turn)).action[3:7]
    np.testing.assert_allclose(quaternion, [math.cos(hand / 2), math.sin(hand / 2), 0.0, 0.0], atol=1e-6)


def test_what_it_cannot_do_without_is_named() -> None:
    expert = RcsPick("rcs/pick")
    with pytest.raises(InvalidObservation, match=r"PickTask_box_joint.*tquat"):
        expert.reset(Obs(state=seen().state), "pick up the green cuboid")
    with pytest.raises(MissingState, match="tquat"):
        expert.reset(Obs(info=seen().info), "pick up the green cuboid")
