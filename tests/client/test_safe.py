"""The safe action follows from what a policy's actions mean."""

from __future__ import annotations

import numpy as np
import pytest

from vlagents_ray import ActionSpec, ConfigError, Obs
from vlagents_ray.client.safe import Safe, SafeAction

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


def test_without_a_word_of_the_contract_nothing_is_guessed() -> None:
    with pytest.raises(ConfigError, match="relative or absolute"):
        SafeAction("auto", ActionSpec())


def test_named_gripper_columns_are_held() -> None:
    assert SafeAction("zero", ActionSpec(), [0, 2])(Obs(), LAST).tolist() == pytest.approx([0.3, 0, 0.8])


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
