"""The common features of all simulators, tested with one that simulates nothing; and their
protocols, as results record them.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pytest
from readme_blocks import section

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.envs.simulator import BenchmarkProtocol, SimulatorEnv
from vlagents_ray.errors import ConfigError, EnvFailed, InvalidAction, NotReset
from vlagents_ray.interface import Act, Obs
from vlagents_ray.registry import entries
from vlagents_ray.testing import require_wireable

# This project's example, and third-party environments by their ids.
ANY_PROTOCOL = {"tabletop", "gymnasium"}

PROTOCOL = BenchmarkProtocol(
    name="Shelf",
    source="a paper",
    max_steps=200,
    control_hz=20.0,
    control="joints",
    success="it is on the shelf",
    metric="success_once",
    begins="the seed's",
    ends_on_success=True,
)


def test_what_was_played_by_the_protocol_deviates_in_nothing() -> None:
    assert PROTOCOL.describe(max_steps=200, control_hz=20)["deviations"] == []


def test_each_deviation_is_told_with_what_the_protocol_says() -> None:
    told = PROTOCOL.describe(max_steps=50, control_hz=20.0, ends_on_success=False)["deviations"]
    assert told == [
        "max_steps: 50, the protocol says 200",
        "ends_on_success: False, the protocol says True",
    ]


def test_a_description_travels_in_a_result() -> None:
    described = replace(PROTOCOL, episodes=50).describe(max_steps=1)
    require_wireable(described, "describe()")
    assert (described["name"], described["episodes"]) == ("Shelf", 50)


def test_what_a_protocol_does_not_settle_cannot_deviate_from_it() -> None:
    with pytest.raises(AttributeError, match="colour"):
        PROTOCOL.describe(colour="red")


@pytest.mark.parametrize("suite", sorted(set(entries("envs")) - ANY_PROTOCOL))
def test_the_page_of_a_benchmark_states_its_protocol(suite: str) -> None:
    name = entries("envs")[suite].page or suite
    page = section("benchmarks", name.partition("#")[0])
    # Several benchmarks may share a page.
    own = page if "\n## Protocol\n" in page else section("benchmarks", name)
    protocol = re.search(r"^##+ Protocol.*?\n(.*?)(?=^##|\Z)", own, re.DOTALL | re.MULTILINE)
    assert protocol is not None
    for stated in ("step", "success"):
        assert stated in protocol[1].lower()


class Shelf(SimulatorEnv):
    """An environment that is solved by its third step, and fails on request."""

    suite, title, packages, cure = "shelf", "Shelf", (), ""
    distributions: ClassVar = ()
    max_steps = 5

    def __init__(
        self, *, states: int | None = None, ends_on_success: bool = True, breaks: str = ""
    ) -> None:
        super().__init__("top", width=8)
        self.init_states, self._ends_on_success = states, ends_on_success
        self._contract, self._protocol = Contract(action=ActionSpec(dim=2)), PROTOCOL
        self.breaks, self.closed = breaks, 0
        with self._making():
            self._resources.callback(self._count)
            self._break("make")
            self._env = object()

    def _count(self) -> None:
        self.closed += 1

    def _break(self, when: str) -> None:
        if self.breaks == when:
            raise RuntimeError("unstable")

    def _begin(self, seed: int, state: int) -> tuple[Obs, dict[str, Any]]:
        self._break("reset")
        return Obs(info={"begun": [seed, state]}), {}

    def _advance(self, action: np.ndarray) -> tuple[Obs, float, bool, dict[str, Any]]:
        self._break("step")
        return Obs(), 0.0, *self._solved(self._steps == 2)


def step(env: Shelf, *action: Any) -> tuple[bool, bool, bool]:
    _, _, terminated, truncated, info = env.step(Act(np.array(action or (0, 0), np.float32)))
    return terminated, truncated, info["success"]


@pytest.mark.parametrize("ends", [True, False])
def test_success_ends_an_episode_unless_told_otherwise_and_the_limit_truncates(ends: bool) -> None:
    env = Shelf(ends_on_success=ends)
    env.reset(seed=0)
    assert [step(env) for _ in range(5)] == [(False, False, False)] * 2 + [
        (ends, False, True), (False, False, False), (False, True, False)
    ]  # fmt: skip
    assert len(env.describe()["protocol"]["deviations"]) == (1 if ends else 2)
    env.reset(seed=0)
    assert not step(env)[1], "the count must begin again"


def test_initial_states_go_by_the_option_or_the_seed() -> None:
    env = Shelf(states=3)
    for seed, options, begun in (
        (7, None, [7, 1]),
        (7, {"init_state": 2}, [7, 2]),
        (2**32 + 3, None, [3, 1]),
    ):
        obs, info = env.reset(seed=seed, options=options)
        assert (obs.info["begun"], info["init_state"]) == (begun, begun[1])
    for state in (3, -1, "1", True):
        with pytest.raises(ConfigError, match="expected a number from 0 to 2"):
            env.reset(seed=0, options={"init_state": state})
    for odd, options in ((env, {"goal": 1}), (Shelf(), {"init_state": 0})):
        with pytest.raises(ConfigError, match=r"got \['(goal|init_state)'\]"):
            odd.reset(seed=0, options=options)


@pytest.mark.parametrize("when", ["make", "reset", "step"])
def test_a_simulator_that_breaks_is_an_infrastructure_failure(when: str) -> None:
    def play() -> None:
        env = Shelf(breaks=when)
        env.reset(seed=0)
        step(env)

    with pytest.raises(EnvFailed, match=f"shelf/top failed to {when}: RuntimeError: unstable"):
        play()


def test_a_bad_action_is_an_error_of_the_policy() -> None:
    env = Shelf()
    env.reset(seed=0)
    for action in ((0, 0, 0), (np.nan, 0), ((0, 0), (0, 0))):
        with pytest.raises(InvalidAction):
            step(env, *action)


def test_an_env_that_is_not_reset_or_closed_says_so() -> None:
    env = Shelf()
    with pytest.raises(NotReset, match="reset"):
        step(env)
    env.close()
    env.close()
    assert env.closed == 1
    with pytest.raises(EnvFailed, match="closed"):
        env.reset(seed=0)
