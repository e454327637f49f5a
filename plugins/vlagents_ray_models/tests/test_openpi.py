"""openpi's statistics in the units of the robot, with stand-ins of its transforms, which the
families' tests use.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vlagents_ray import Obs
from vlagents_ray.robot.fit import Trained
from vlagents_ray_models.openpi import ROBOTS, RobotConvention, Transforms

LOW, WIDTH = 0.5, 2.0  # of all statistics, in transformed units


def transforms(**changes: Any) -> Transforms:
    """Transforms that scale ALOHA's joints, bend its grippers, and make the first six actions
    relative to the state.
    """

    def normalise(data: dict[str, Any]) -> dict[str, Any]:
        return {**data, **{name: (data[name] - 3) / 7 for name in ("state", "actions")}}

    def forward(data: dict[str, Any]) -> dict[str, Any]:
        assert data["images"]["cam_high"].shape[0] == 3
        data["actions"][..., :6] -= data["state"][:6]  # in place, as openpi does
        state = data["state"] * np.array([1, -1] + 12 * [1])
        state[[6, 13]] = np.arcsin(state[[6, 13]])
        return normalise({**data, "state": state})

    bounds = [
        normalise({"state": np.full(32, end), "actions": np.full(32, end)})
        for end in (LOW, LOW + WIDTH)
    ]
    given: dict[str, Any] = {"forward": forward, "bounds": bounds} | changes
    return Transforms(inputs=None, outputs=None, robot="AlohaInputs", needs_prompt=True, **given)


def test_ranges_are_in_the_units_of_the_robot_and_unknown_where_numbers_are_mixed() -> None:
    found = transforms().ranges(ROBOTS["AlohaInputs"])
    assert found is not None
    assert found["parts"] == ["left/joints", "left/gripper", "right/joints", "right/gripper"]
    low, high = (np.array(found["observation.state"][end], float) for end in ("q01", "q99"))
    assert (
        np.flatnonzero(np.isnan(low)).tolist() == np.flatnonzero(np.isnan(high)).tolist() == [6, 13]
    )
    assert (low[1], high[1]) == (pytest.approx(-LOW - WIDTH), pytest.approx(-LOW)), (
        "the joint of the other sign"
    )
    np.testing.assert_allclose(np.delete(low, [1, 6, 13]), LOW)
    for end, value in (("q01", LOW), ("q99", LOW + WIDTH)):
        assert found["action"][end][:6] == [None] * 6
        assert found["action"][end][6:] == pytest.approx([value] * 8)


def test_a_robot_is_compared_by_the_numbers_that_are_known() -> None:
    trained = Trained.from_statistics(transforms().ranges(ROBOTS["AlohaInputs"]) or {})
    joints, opening = np.full(6, 1.0), np.array([40.0])
    joints[1] = -1.0
    right = np.full(6, 1.0)
    parts = {
        "left/joints": joints,
        "left/gripper": opening,
        "right/joints": right,
        "right/gripper": opening,
    }
    assert trained.misfits(trained.vector(Obs(state=parts), []), np.full((2, 14), 1.0), None) == []
    joints[1] = 1.0
    [found] = trained.misfits(trained.vector(Obs(state=parts), []), None, None)
    assert found.startswith("state[1]: got 1, was trained from -2.5 to -0.5")
    assert len(trained.draw(np.full((2, 14), 1.0), None)) == 15


def test_nothing_is_stated_without_quantiles_or_the_number_of_actions() -> None:
    assert transforms(bounds=[]).ranges(ROBOTS["AlohaInputs"]) is None
    assert transforms().ranges(RobotConvention({}, {"state": {"joints": 14}})) is None
