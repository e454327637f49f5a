"""What every environment of a simulator inherits: resets, steps, its end and its errors, without a simulator."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.envs.simulator import SimulatorEnv
from vlagents_ray.errors import ConfigError, EnvFailed, InvalidAction, NotReset
from vlagents_ray.interface import Act, Obs

STILL = Act(np.zeros(2, np.float32))


class Shelf(SimulatorEnv):
    """Notes the seeds and the initial states with which episodes begin, and fails on request."""

    suite, max_steps = "shelf", 3
    _contract = Contract(action=ActionSpec(dim=2))

    def __init__(self, states: int | None = None, broken: str = "") -> None:
        super().__init__("shelf/tidy")
        self.init_states, self.broken, self.begun, self.closed = states, broken, list[tuple[int, int]](), 0
        with self._making():
            self._resources.callback(self._count)
            self._fail("make")
            self._env = object()

    def _begin(self, seed: int, state: int) -> tuple[Obs, dict[str, Any]]:
        self._fail("reset")
        self.begun.append((seed, state))
        return Obs(), {}

    def _advance(self, action: np.ndarray) -> tuple[Obs, float, bool, dict[str, Any]]:
        self._fail("step")
        return Obs(), 0.0, False, {"success": False}

    def _fail(self, when: str) -> None:
        if self.broken == when:
            raise RuntimeError("mj_step: unstable")

    def _count(self) -> None:
        self.closed += 1


def test_an_episode_begins_by_its_seed_and_ends_at_the_limit() -> None:
    env = Shelf()
    assert env.reset(seed=2**32 + 1)[1] == {"success": False}
    assert env.begun == [(1, 0)]
    for _ in range(2):
        assert [env.step(STILL)[3] for _ in range(3)] == [False, False, True]
        env.reset(seed=1)


def test_a_fixed_initial_state_is_that_of_the_options_or_of_the_seed() -> None:
    env = Shelf(states=50)
    assert [env.reset(seed=107)[1]["init_state"], env.reset(seed=0, options={"init_state": 3})[1]["init_state"]] == [
        7,
        3,
    ]
    assert env.begun == [(107, 7), (0, 3)]


@pytest.mark.parametrize(
    ("states", "options", "says"),
    [
        (50, {"init_state": 50}, "init_state is 50, want 0 to 49"),
        (50, {"init_state": "first"}, "init_state is 'first', want 0 to 49"),
        (50, {"goal": 1}, r"unknown reset options \['goal'\], want init_state or none"),
        (None, {"init_state": 0}, r"unknown reset options \['init_state'\], want none"),
    ],
)
def test_unknown_reset_options_are_refused(states: int | None, options: dict[str, object], says: str) -> None:
    env = Shelf(states)
    with pytest.raises(ConfigError, match=f"shelf/tidy: {says}"):
        env.reset(seed=0, options=options)
    assert env.begun == []


@pytest.mark.parametrize("action", [np.zeros(3), np.zeros((2, 2)), np.full(2, np.nan)])
def test_an_unusable_action_is_refused(action: np.ndarray) -> None:
    env = Shelf()
    env.reset(seed=0)
    with pytest.raises(InvalidAction):
        env.step(Act(action.astype(np.float32)))


@pytest.mark.parametrize("when", ["make", "reset", "step"])
def test_an_error_of_the_simulator_is_the_envs(when: str) -> None:
    def play() -> None:
        env = Shelf(broken=when)
        env.reset(seed=0)
        env.step(STILL)

    with pytest.raises(EnvFailed, match=f"shelf/tidy failed to {when}: RuntimeError: mj_step: unstable"):
        play()


def test_one_that_was_not_reset_or_is_closed_says_so() -> None:
    env = Shelf()
    with pytest.raises(NotReset, match="shelf/tidy: step before reset"):
        env.step(STILL)
    env.reset(seed=0)
    env.close()
    env.close()
    assert env.closed == 1
    for call in (lambda: env.step(STILL), lambda: env.reset(seed=0)):
        with pytest.raises(EnvFailed, match="shelf/tidy is closed; make a new one"):
            call()
