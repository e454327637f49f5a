"""The mode that is chosen for a policy: by its contract, its measured success and the delay."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from vlagents_ray import Act, ActionSpec, Agent, Contract, Obs, PlayerSettings
from vlagents_ray.chunking.choice import WAIT_S, Choice, choose, choose_for, measured_delay
from vlagents_ray.errors import ConfigError, PolicyFailed
from vlagents_ray.success import Solved, SuccessCurve

HZ = 20.0
RELATIVE, ABSOLUTE = ActionSpec(dim=2, delta=True), ActionSpec(dim=2, delta=False)
VELOCITY, UNDECLARED = ActionSpec(dim=2, space="ee_velocity"), ActionSpec(dim=2)
PREFIXES = {"execute": 4, "real_time_chunking": True}


def contract(action: ActionSpec = RELATIVE, chunk: int | None = 8) -> Contract:
    return Contract(action=action, chunk=chunk)


def curve(
    solved: dict[int, int], env: str = "tabletop", mode: str = "async", **settings: Any
) -> SuccessCurve:
    """Return a curve of 100 episodes at each delay."""
    entries = {rows: Solved(count, 100, 25.0) for rows, count in solved.items()}
    return SuccessCurve(env, HZ, mode, settings or {"execute": 4}, entries)


def chosen(policy: Contract | None, rows: int | None = None, **options: Any) -> Choice:
    delay_s = None if rows is None else rows / HZ
    return choose(policy, hz=HZ, delay_s=delay_s, **options)


def pair(with_prefixes: int, without: int, env: str = "tabletop") -> list[SuccessCurve]:
    """Return the curves of a checkpoint with these numbers of solved episodes at three rows."""
    return [
        curve({0: 98, 3: without}, env),
        curve({0: 98, 3: with_prefixes}, env, **PREFIXES),
    ]


@pytest.mark.parametrize(
    ("policy", "rows", "mode", "execute", "reason"),
    [
        (contract(RELATIVE), 3, "async", None, "the contract declares relative actions"),
        (contract(ABSOLUTE), 3, "async", None, "the contract declares absolute actions"),
        (contract(VELOCITY), 3, "async", None, "the contract declares relative actions"),
        (contract(RELATIVE), None, "async", None, "relative actions"),
        (contract(RELATIVE, None), 3, "async", None, "relative actions"),
        (contract(UNDECLARED), 3, "open_loop", 4, "does not declare whether actions are"),
        (contract(UNDECLARED, 1), 0, "open_loop", 1, "does not declare whether actions are"),
        (contract(UNDECLARED, None), 3, "open_loop", None, "does not declare whether actions"),
        (None, 3, "open_loop", None, "does not declare whether actions are"),
        (contract(RELATIVE, 1), 0, "open_loop", 1, "each answer has a single action"),
        (contract(ABSOLUTE, 1), 3, "open_loop", 1, "each answer has a single action"),
        (contract(RELATIVE), 4, "async", None, "relative actions"),
        (contract(RELATIVE), 5, "open_loop", 4, r"5 rows of delay (250 ms) is more than half of"),
        (contract(RELATIVE, 2), 1, "async", None, "relative actions"),
        (contract(RELATIVE, 2), 2, "open_loop", 1, "2 rows of delay (100 ms) is more than half"),
        (contract(RELATIVE, 3), 2, "open_loop", 1, "more than half of a chunk of 3 rows"),
    ],
)
def test_the_mode_follows_from_the_contract_and_the_delay(
    policy: Contract | None, rows: int | None, mode: str, execute: int | None, reason: str
) -> None:
    choice = chosen(policy, rows)
    assert (choice.mode, choice.settings.execute) == (mode, execute)
    assert choice.settings.deadline_s == (0.0 if mode == "async" else WAIT_S)
    assert choice.line.startswith(f"mode {mode}")
    assert reason in choice.line
    assert choice.line.endswith("no measured success for this checkpoint in this mode")


def test_a_part_of_a_row_is_a_row() -> None:
    """An answer is executed from the tick after its arrival on."""
    assert choose(contract(), hz=HZ, delay_s=4.0001 / HZ).mode == "open_loop"
    assert choose(contract(), hz=10.0, delay_s=1.1 / 10 * 3).mode == "async"  # 3.3: four rows
    assert "12 rows" in choose(contract(), hz=10.0, delay_s=1.2).line


def test_a_horizon_shortens_the_chunk() -> None:
    assert chosen(contract(), 4, horizon=6).mode == "open_loop"
    assert chosen(contract(), 4, horizon=6).settings.execute == 3
    assert chosen(contract(), 3, horizon=6).mode == "async"


def test_the_measured_success_is_named_at_the_next_longer_measured_delay() -> None:
    curves = [curve({0: 99, 1: 97, 3: 95, 5: 91}), curve({0: 90, 3: 80}, "metaworld")]
    says = {
        0: "measured: 99 % of 100 at 0 rows, tabletop; 90 % of 100 at 0 rows, metaworld",
        2: "measured: 95 % of 100 at 3 rows, tabletop; 80 % of 100 at 3 rows, metaworld",
        4: "measured: 91 % of 100 at 5 rows, tabletop; metaworld not at 4 rows of delay (200 ms), "
        "only up to 3 rows",
    }
    for rows, text in says.items():
        assert chosen(contract(), rows, curves=curves).line.endswith(text)
    assert chosen(contract(), curves=[curve({0: 98, 1: 98, 3: 50})]).line.endswith(
        "measured: 98 % of 100 at the tolerated delay of 0 rows, tabletop"
    )


def test_the_robot_runs_as_the_measured_one_did() -> None:
    """The figure in the line is then the robot's."""
    curves = [curve({0: 98, 3: 95}, execute=2), curve({0: 98, 3: 10}, execute=2, horizon=6)]
    choice = chosen(contract(), 3, curves=curves)
    assert choice.settings == PlayerSettings("async", execute=2)
    assert "95 % of 100" in choice.line
    assert "10 %" not in choice.line, "a horizon was set when this was measured"
    assert "no measured success" in chosen(contract(), 3, curves=curves, execute=3).line
    assert "10 % of 100" in chosen(contract(), 3, curves=curves, execute=2, horizon=6).line


@pytest.mark.parametrize("execute", [0, -1, 1.5, "2", True, [2]])
def test_no_value_of_a_server_is_a_number_of_rows_that_a_robot_cannot_execute(execute: Any) -> None:
    choice = chosen(contract(), 3, curves=[curve({0: 98, 3: 95}, execute=execute)])
    assert choice.settings.execute is None
    assert "no measured success" in choice.line


def test_success_without_careful_rows_is_not_that_of_the_default() -> None:
    curves = [curve({0: 98, 3: 82}, fresh_grip=None), curve({0: 98, 3: 95})]
    assert chosen(contract(), 3, curves=curves).line.endswith("95 % of 100 at 3 rows, tabletop")
    at_once = chosen(contract(), 3, curves=curves, fresh_grip=None)
    assert at_once.line.endswith("82 % of 100 at 3 rows, tabletop")


@pytest.mark.parametrize(
    ("curves", "prefix", "rows", "is_with_prefixes"),
    [
        (pair(96, 90), 4, 3, True),
        (pair(90, 96), 4, 3, False),
        (pair(95, 95), 4, 3, False),
        (pair(96, 90), 0, 3, False),  # the policy cannot begin with given rows
        (pair(96, 90), 2, 3, False),  # it cannot begin with as many rows as the delay has
        (pair(96, 90), 4, None, False),
        (pair(96, 90), 8, 4, False),  # not measured
        (pair(96, 90), 4, 0, False),  # no row is given
        ([*pair(96, 90), *pair(90, 92, "metaworld")], 4, 3, False),
        ([*pair(96, 90), *pair(93, 92, "metaworld")], 4, 3, True),
        ([curve({0: 98, 3: 96}, **PREFIXES)], 4, 3, False),  # nothing to compare it with
        ([*pair(96, 90)[1:], curve({0: 98, 3: 90}, "metaworld")], 4, 3, False),
    ],
)
def test_prefixes_are_sent_only_if_the_checkpoint_solves_more_with_them(
    curves: list[SuccessCurve], prefix: int, rows: int | None, is_with_prefixes: bool
) -> None:
    choice = chosen(contract(), rows, curves=curves, longest_prefix=prefix)
    assert choice.mode == "async"
    assert choice.settings.real_time_chunking is is_with_prefixes
    assert choice.line.startswith(
        "mode async with prefixes:" if is_with_prefixes else "mode async:"
    )
    if is_with_prefixes:
        assert choice.settings.execute == 4
        assert "96 % of 100 at 3 rows, tabletop" in choice.line


def test_an_explicit_mode_is_obeyed() -> None:
    curves = [curve({0: 98, 3: 95}), curve({0: 98, 3: 96}, mode="open_loop")]
    for mode in ("open_loop", "ensemble", "async"):
        choice = chosen(None, 30, mode=mode, curves=curves)
        assert (choice.mode, choice.settings.execute) == (mode, None)
        assert choice.line.startswith(f"mode {mode}")
        assert ": as set; " in choice.line
    assert "96 % of 100" in chosen(None, 3, mode="open_loop", execute=4, curves=curves).line


def test_settings_of_async_need_that_mode() -> None:
    for settings in ({"merge": "average"}, {"real_time_chunking": True}):
        with pytest.raises(ConfigError, match="expected mode='async' with them, got mode='auto'"):
            choose(contract(), **settings)
        assert choose(contract(), mode="async", **settings).mode == "async"


SPECS = st.builds(
    ActionSpec,
    dim=st.none() | st.integers(1, 14),
    space=st.sampled_from([None, "joint", "ee_pose", "joint_velocity", "ee_velocity"]),
    delta=st.sampled_from([None, True, False]),
)
CONTRACTS = st.none() | st.builds(Contract, action=SPECS, chunk=st.none() | st.integers(1, 60))
SETTINGS = st.fixed_dictionaries(
    {},
    optional={
        "execute": st.none() | st.integers(1, 8),
        "real_time_chunking": st.booleans(),
        "horizon": st.none() | st.integers(1, 8),
        "merge": st.sampled_from(["newest", "average"]),
    },
)


NAMES = ["execute", "horizon", "merge", "real_time_chunking", "fresh_grip", "mode", "x"]
VALUES = st.none() | st.booleans() | st.integers(-1, 3) | st.floats(0, 2) | st.text(max_size=1)


@st.composite
def success_curves(draw: st.DrawFn) -> SuccessCurve:
    delays = draw(st.sets(st.integers(1, 20), max_size=4)) | {0}
    solved: dict[int, Solved] = {}
    for rows in delays:
        episodes = draw(st.integers(1, 500))
        solved[rows] = Solved(draw(st.integers(0, episodes)), episodes, 25.0)
    mode = draw(st.sampled_from(["async", "open_loop", "ensemble"]))
    env = draw(st.sampled_from(["tabletop", "metaworld"]))
    # Values of any type, as a server may send them.
    settings = draw(SETTINGS | st.dictionaries(st.sampled_from(NAMES), VALUES, max_size=2))
    return SuccessCurve(env, HZ, mode, settings, solved)


@given(
    policy=CONTRACTS,
    curves=st.lists(success_curves(), max_size=5),
    prefix=st.integers(0, 20),
    rows=st.none() | st.integers(0, 40),
    settings=SETTINGS.map(
        lambda drawn: {k: v for k, v in drawn.items() if k in ("execute", "horizon")}
    ),
)
@example(contract(), pair(96, 90), 4, 3, {})
def test_no_choice_contradicts_what_is_known(
    policy: Contract | None,
    curves: list[SuccessCurve],
    prefix: int,
    rows: int | None,
    settings: dict[str, Any],
) -> None:
    choice = chosen(policy, rows, curves=curves, longest_prefix=prefix, **settings)
    relative = None if policy is None else policy.action.relative
    chunk = None if policy is None else policy.chunk
    usable = None if chunk is None else min(chunk, settings.get("horizon") or chunk)

    # The line names the mode, the reason and the success.
    assert choice.line.startswith(f"mode {choice.mode}")
    assert any(reason in choice.line for reason in ("declare", "single action", "more than half"))
    assert "measured" in choice.line

    # Late rows are executed only if their meaning is known, and only within half of a chunk.
    if relative is None or usable == 1:
        assert choice.mode == "open_loop"
    if choice.mode == "async" and usable is not None and rows is not None:
        assert 2 * rows <= usable
    if choice.mode == "open_loop" and settings.get("execute") is None and usable is not None:
        assert choice.settings.execute == max(1, usable // 2)

    # Prefixes are better in some environment, and worse in none.
    if choice.settings.real_time_chunking:
        assert choice.mode == "async"
        assert rows is not None
        assert 0 < rows <= prefix
        with_prefixes = [one for one in curves if one.settings.get("real_time_chunking")]
        without = [one for one in curves if not one.settings.get("real_time_chunking")]
        assert any(
            one.env == other.env and one.floor(rows) > other.floor(rows)
            for one in with_prefixes
            for other in without
        )

    # A setting that was given is kept, and the choice is the same each time.
    for name, value in settings.items():
        if value is not None:
            assert getattr(choice.settings, name) == value
    assert choice == chosen(policy, rows, curves=curves, longest_prefix=prefix, **settings)


@given(curves=st.lists(success_curves(), max_size=5), rows=st.integers(0, 8))
def test_a_curve_is_named_only_if_the_robot_runs_with_its_settings(
    curves: list[SuccessCurve], rows: int
) -> None:
    choice = chosen(contract(chunk=60), rows, curves=curves)
    names = {"execute", "real_time_chunking", "horizon", "merge", "fresh_grip"}
    defaults = {field.name: field.default for field in fields(PlayerSettings)}
    matching = [
        one
        for one in curves
        if one.mode == choice.mode
        and one.settings.keys() <= names
        and all(
            {**defaults, **one.settings}[name] == getattr(choice.settings, name) for name in names
        )
    ]
    assert ("no measured success" in choice.line) is (not matching)


class Answering(Agent):
    """A policy with the abilities of a served one."""

    longest_prefix = 4
    success_curves = tuple(pair(96, 90))

    def __init__(self, answers: list[bool]) -> None:
        self.answers = answers

    @property
    def contract(self) -> Contract:
        return contract()

    def act(self, obs: Obs) -> Act:
        if not self.answers.pop(0):
            raise PolicyFailed("too busy")
        return Act(np.zeros((8, 2), np.float32))


def test_an_agent_declares_what_the_choice_needs() -> None:
    agent = Answering([])
    choice = choose_for(agent, hz=HZ, delay_s=3 / HZ, safe="hold")
    assert choice == chosen(
        contract(), 3, curves=agent.success_curves, longest_prefix=4, safe="hold"
    )
    assert choice.settings.real_time_chunking
    assert choice.settings.safe == "hold"


@pytest.mark.parametrize(
    ("answers", "is_known"), [([True] * 3, True), ([False], False), ([True, False], True)]
)
def test_the_delay_is_unknown_if_the_policy_does_not_answer(
    answers: list[bool], is_known: bool
) -> None:
    agent = Answering(answers)
    assert (measured_delay(agent, Obs()) is not None) is is_known
    assert not agent.answers
