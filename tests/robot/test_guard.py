"""The guard: the actions that it rejects, and the actions that it passes unchanged."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from vlagents_ray import ActionSpec, ConfigError, Contract, Obs
from vlagents_ray.errors import InvalidAction
from vlagents_ray.robot import Guard, MotionLimits


def row(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


GUARD = Guard(Contract(action=ActionSpec(dim=3, low=-1.0, high=1.0)))


@pytest.mark.parametrize(
    ("action", "said"),
    [
        (row(0, 0), r"expected \(3,\) float32, a single row, got \(2,\) float32"),
        (np.zeros((1, 3), np.float32), "single row"),
        (np.zeros(3, np.int64), "int64"),
        (row(0, np.nan, 0), "finite"),
        (row(0, np.inf, 0), "finite"),
        (row(0, 0, -1.01), r"action\[2\]: expected .*, got -1.01, below the limit -1"),
        (row(0, 1.01, 0), r"action\[1\]: expected .*, got 1.01, above the limit 1"),
    ],
)
def test_an_action_that_breaks_the_contract_is_refused_by_its_number(
    action: np.ndarray, said: str
) -> None:
    with pytest.raises(InvalidAction, match=said):
        GUARD(action)


def test_an_action_within_the_contract_passes_as_it_is() -> None:
    action = row(-1, 0, 1)
    assert GUARD(action) is action


def test_the_stricter_of_the_contracts_and_ones_own_bounds_holds() -> None:
    guard = Guard(Contract(action=ActionSpec(low=-1.0, high=1.0)), high=np.array([2.0, 0.1]))
    guard(row(1, 0.1))
    for action in (row(1.5, 0), row(0, 0.2)):
        with pytest.raises(InvalidAction, match="above"):
            guard(action)


def test_a_jump_is_refused_and_a_first_action_is_none() -> None:
    guard = Guard(max_step=np.array([0.1, 5.0]))
    guard(row(9, 9))
    guard(row(0.05, 4), row(0, 0))
    with pytest.raises(InvalidAction, match=r"action\[0\]: expected .*, got 0.2 after 0"):
        guard(row(0.2, 0), row(0, 0))


def test_while_the_robot_stands_the_measured_pose_counts_if_it_is_known() -> None:
    obs = Obs(state={"joints": row(1, 2)})
    last = row(0, 0)
    assert np.array_equal(Guard().reference(obs, last), last)  # type: ignore[arg-type]
    guard = Guard(measure=lambda obs: obs.state["joints"])
    for before in (last, None):
        pose = guard.reference(obs, before)
        assert pose is not None
        assert pose.tolist() == [1, 2]


def test_a_measured_pose_that_is_none_is_refused() -> None:
    obs = Obs(state={"joints": row(1, np.nan), "tick": row(1)})
    with pytest.raises(InvalidAction, match="finite"):
        Guard(measure=lambda obs: obs.state["joints"]).reference(obs, None)
    with pytest.raises(
        ConfigError, match=r"measure: expected the shape of an action, \(2,\), got \(1,\)"
    ):
        Guard(measure=lambda obs: obs.state["tick"]).reference(obs, row(0, 0))
    with pytest.raises(
        ConfigError, match=r"measure: expected None for relative actions.*, got a function"
    ):
        Guard(Contract(action=ActionSpec(delta=True)), measure=lambda obs: obs.state["joints"])


@pytest.mark.parametrize("max_step", [float("nan"), -0.1, np.array([0.1, np.nan])])
def test_a_largest_step_that_would_bound_nothing_is_refused(max_step: float | np.ndarray) -> None:
    with pytest.raises(ConfigError, match="max_step"):
        Guard(max_step=max_step)


SHAPES = (None, 1.0, (1.0,), (1.0, 2.0), (1.0, 2.0, 3.0), ((1.0, 2.0, 3.0),))


@pytest.mark.parametrize("dim", [None, 3])
@pytest.mark.parametrize("name", ["low", "high", "max_step", "velocity", "first"])
def test_bounds_of_another_size_than_an_action_are_an_error_of_the_settings(
    name: str, dim: int | None
) -> None:
    """All pairs of sources: the guard's own bounds, and those of the limits."""
    for own, of_limits in itertools.product(SHAPES, SHAPES):
        bounds: dict[str, Any] = {}
        limits: dict[str, Any] = {}
        if own is not None and name in ("low", "high", "max_step"):
            bounds[name] = np.array(own)
        if of_limits is not None:
            limits["acceleration" if name == "max_step" else name] = of_limits

        sizes = [np.shape(value) for value in (*bounds.values(), *limits.values())]
        fits = all(size in ((), (3,)) for size in sizes)
        assert is_accepted(dim, bounds, limits) == fits, (own, of_limits)


def is_accepted(dim: int | None, bounds: dict[str, Any], limits: dict[str, Any]) -> bool:
    """Return whether a guard with these bounds and limits accepts actions of three numbers."""
    contract = Contract(action=ActionSpec(dim=dim, delta=False))
    try:
        guard = Guard(contract, limits=MotionLimits(**limits), hz=50, **bounds)
        guard(row(1, 2, 3) if "low" in {*bounds, *limits} else row(1, 1, 1))
    except ConfigError:
        return False
    return True
