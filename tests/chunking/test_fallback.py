"""The safe action follows from what a policy's actions mean."""

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


@pytest.mark.parametrize("safe", ["auto", "zero"])
def test_without_a_word_of_the_contract_nothing_is_guessed(safe: Safe) -> None:
    with pytest.raises(ConfigError, match=r"relative or absolute.*safe='hold'"):
        SafeAction(safe, ActionSpec())


@pytest.mark.parametrize(
    ("safe", "spec", "cure"),
    [
        ("zero", ActionSpec(delta=False), "safe='hold'"),
        ("hold", ActionSpec(delta=True), "safe='zero'"),
        ("hold", ActionSpec(space="joint_velocity", delta=False), "safe='zero'"),
    ],
)
def test_a_choice_that_would_move_the_robot_is_refused(safe: Safe, spec: ActionSpec, cure: str) -> None:
    with pytest.raises(ConfigError, match=cure):
        SafeAction(safe, spec)


def test_named_gripper_columns_are_held() -> None:
    spec = ActionSpec(delta=True)
    assert SafeAction("zero", spec, [0, 2])(Obs(), LAST).tolist() == pytest.approx([0.3, 0, 0.8])


def test_what_is_made_from_the_last_action_wants_one() -> None:
    for spec in (ActionSpec(delta=True), ActionSpec(delta=False)):
        with pytest.raises(InvalidAction, match="before the first action"):
            SafeAction("auto", spec)(Obs(), None)
    assert SafeAction(LAST, ActionSpec())(Obs(), None).tolist() == LAST.tolist()


def test_before_the_first_action_a_gripper_is_kept_as_it_is_measured() -> None:
    spec = ActionSpec(dim=3, delta=True, gripper_open=1.0, gripper_closed=-1.0)
    assert SafeAction("auto", spec)(Obs(gripper=0.75), None).tolist() == [0, 0, 0.5]
    for unknown, obs in ((spec, Obs()), (ActionSpec(dim=3, delta=True, gripper_open=1.0), Obs(gripper=1.0))):
        with pytest.raises(InvalidAction, match="before the first action"):
            SafeAction("auto", unknown)(obs, None)


def test_an_action_of_ones_own_is_taken_as_it_is() -> None:
    home = np.array([1.0, 2.0, 3.0])
    own: list[Safe] = [home, lambda obs: obs.state["joints"]]
    obs = Obs(state={"joints": home})
    for safe in own:
        assert SafeAction(safe, ActionSpec())(obs, LAST).tolist() == home.tolist()


def test_the_last_action_is_not_handed_out_itself() -> None:
    SafeAction("hold", ActionSpec())(Obs(), LAST)[:] = 9
    assert LAST[0] == np.float32(0.3)


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(ConfigError, match="want one of"):
        SafeAction("freeze", ActionSpec())  # type: ignore[arg-type]
