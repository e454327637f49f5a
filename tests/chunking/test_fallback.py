"""The safe action is derived from the meaning of a policy's actions."""

from __future__ import annotations

import numpy as np
import pytest

from vlagents_ray import ActionSpec, ConfigError, Obs
from vlagents_ray.chunking.fallback import Safe, SafeAction
from vlagents_ray.errors import InvalidAction

LAST = np.array([0.3, -0.2, 0.8], np.float32)


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        (ActionSpec(delta=False), LAST),
        (ActionSpec(delta=True), [0, 0, 0]),
        (ActionSpec(delta=True, gripper_open=1.0, gripper_closed=-1.0), [0, 0, LAST[2]]),
        (ActionSpec(space="joint_velocity"), [0, 0, 0]),
    ],
)
def test_the_contract_decides(spec: ActionSpec, expected: object) -> None:
    assert np.array_equal(SafeAction("auto", spec)(Obs(), LAST), np.asarray(expected, np.float32))


@pytest.mark.parametrize(
    ("safe", "spec", "cure"),
    [
        ("auto", ActionSpec(), r"relative or absolute.*safe='hold'"),
        ("zero", ActionSpec(), r"relative or absolute.*safe='hold'"),
        ("zero", ActionSpec(delta=False), "expected 'hold' or 'auto', got 'zero'"),
        ("hold", ActionSpec(delta=True), "expected 'zero' or 'auto', got 'hold'"),
        (
            "hold",
            ActionSpec(space="joint_velocity", delta=False),
            "expected 'zero' or 'auto', got 'hold'",
        ),
        ("freeze", ActionSpec(), "expected one of"),
    ],
)
def test_a_choice_that_would_or_might_move_the_robot_is_refused(
    safe: Safe, spec: ActionSpec, cure: str
) -> None:
    with pytest.raises(ConfigError, match=cure):
        SafeAction(safe, spec)


def test_the_last_actions_gripper_is_held_and_an_own_action_taken_as_it_is() -> None:
    spec, arm = ActionSpec(delta=True), ActionSpec(names=("left_gripper", "elbow", "gripper"))
    assert SafeAction("zero", spec, arm)(Obs(), LAST).tolist() == pytest.approx([0.3, 0, 0.8])
    home = np.array([1.0, 2.0, 3.0])
    own: list[Safe] = [home, lambda obs: obs.state["joints"]]
    for safe in own:
        assert (
            SafeAction(safe, ActionSpec())(Obs(state={"joints": home}), LAST).tolist()
            == home.tolist()
        )
    SafeAction("hold", ActionSpec())(Obs(), LAST)[:] = 9
    assert LAST[0] == np.float32(0.3), "the safe action must be a copy of the last action"


def test_what_is_made_from_the_last_action_wants_one() -> None:
    for spec in (ActionSpec(delta=True), ActionSpec(delta=False)):
        with pytest.raises(InvalidAction, match="before the first action"):
            SafeAction("auto", spec)(Obs(), None)
    assert SafeAction(LAST, ActionSpec())(Obs(), None).tolist() == LAST.tolist()


def test_before_the_first_action_a_gripper_is_kept_as_it_is_measured() -> None:
    spec = ActionSpec(dim=3, delta=True, gripper_open=1.0, gripper_closed=-1.0)
    assert SafeAction("auto", spec)(Obs(gripper=0.75), None).tolist() == [0, 0, 0.5]
    for unknown, obs in (
        (spec, Obs()),
        (ActionSpec(dim=3, delta=True, gripper_open=1.0), Obs(gripper=0.5)),
    ):
        with pytest.raises(InvalidAction, match="before the first action"):
            SafeAction("auto", unknown)(obs, None)
