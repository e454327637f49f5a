"""openpi's statistics in the units of the robot, with stand-ins for its transforms; tests of the
families use the real ones.
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
    """Return transforms that scale ALOHA's joints, transform its grippers by a curve, and make the
    first six actions relative to the state.
    """

    def normalise(data: dict[str, Any]) -> dict[str, Any]:
        scaled = {name: (data[name] - 3) / 7 for name in ("state", "actions")}
        return {**data, **scaled}

    def forward(data: dict[str, Any]) -> dict[str, Any]:
        assert data["images"]["cam_high"].shape[0] == 3
        data["actions"][..., :6] -= data["state"][:6]  # in place, as openpi does
        state = data["state"] * np.array([1, -1] + 12 * [1])
        state[[6, 13]] = np.arcsin(state[[6, 13]])
        return normalise({**data, "state": state})

    bounds = []
    for bound in (LOW, LOW + WIDTH):
        bounds.append(normalise({"state": np.full(32, bound), "actions": np.full(32, bound)}))
    fields: dict[str, Any] = {"forward": forward, "bounds": bounds} | changes
    return Transforms(inputs=None, outputs=None, robot="AlohaInputs", needs_prompt=True, **fields)


def test_ranges_are_in_the_units_of_the_robot_and_unknown_where_numbers_are_mixed() -> None:
    ranges = transforms().ranges(ROBOTS["AlohaInputs"])
    assert ranges is not None
    assert ranges["parts"] == ["left/joints", "left/gripper", "right/joints", "right/gripper"]

    low, high = (np.array(ranges["observation.state"][name], float) for name in ("q01", "q99"))
    for bound in (low, high):
        assert np.flatnonzero(np.isnan(bound)).tolist() == [6, 13]
    # Joint 1 has the opposite sign.
    assert (low[1], high[1]) == (pytest.approx(-LOW - WIDTH), pytest.approx(-LOW))
    np.testing.assert_allclose(np.delete(low, [1, 6, 13]), LOW)

    for name, value in (("q01", LOW), ("q99", LOW + WIDTH)):
        assert ranges["action"][name][:6] == [None] * 6
        assert ranges["action"][name][6:] == pytest.approx([value] * 8)


def test_a_robot_is_compared_by_the_numbers_that_are_known() -> None:
    trained = Trained.from_statistics(transforms().ranges(ROBOTS["AlohaInputs"]) or {})
    joints, opening = np.full(6, 1.0), np.array([40.0])
    joints[1] = -1.0
    right = np.full(6, 1.0)
    state = {
        "left/joints": joints,
        "left/gripper": opening,
        "right/joints": right,
        "right/gripper": opening,
    }
    assert trained.misfits(trained.vector(Obs(state=state), []), np.full((2, 14), 1.0), None) == []

    joints[1] = 1.0
    [misfit] = trained.misfits(trained.vector(Obs(state=state), []), None, None)
    assert misfit.startswith("state[1]: expected -2.5 to -0.5, the range of the training, got 1")
    assert len(trained.draw(np.full((2, 14), 1.0), None)) == 15


def test_nothing_is_stated_without_quantiles_or_the_number_of_actions() -> None:
    assert transforms(bounds=[]).ranges(ROBOTS["AlohaInputs"]) is None
    assert transforms().ranges(RobotConvention({}, {"state": {"joints": 14}})) is None
