"""Each entry point that moves an arm compares policy and arm before the first motion: all misfits
at all entry points.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robot_trials import ScriptedPerson, judged

import vlagents_ray.cli.robot as command
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.contract import ActionSpec, Contract, StateSpec
from vlagents_ray.errors import ContractMismatch
from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.evaluate.robot import evaluate_on_robot
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.robot import run_loop

RANGE = {"min": [-1.0, 0.2], "max": [0.1, 1.0]}
RIGHT: dict[str, Any] = {
    "state": {"joints": StateSpec(2, "rad")},
    "action": ActionSpec(dim=2, space="joint", delta=False, names=("pan", "lift")),
}
NAME = "policy-zebra"


@dataclass
class Case:
    """A policy and an arm."""

    contract: dict[str, Any] = field(default_factory=lambda: RIGHT)
    statistics: dict[str, Any] | None = None
    pose: tuple[float, float] = (0.0, 0.5)
    rows: tuple[float, float] = (0.0, 0.5)  # rows of the policy's chunk


def action(**changes: Any) -> dict[str, Any]:
    right = {"dim": 2, "space": "joint", "delta": False, "names": ("pan", "lift")}
    return RIGHT | {"action": ActionSpec(**right | changes)}


STATED = {"observation.state": RANGE, "action": RANGE}
MISFITS: dict[str, tuple[Case, str]] = {
    "unit": (
        Case(RIGHT | {"state": {"joints": StateSpec(2, "deg")}}),
        "needs 'deg', the env provides 'rad'",
    ),
    "relative actions": (Case(action(delta=True)), "action.delta: the policy returns True"),
    "order of joints": (Case(action(names=("lift", "pan"))), "number 0 is 'lift' in the policy"),
    "number of joints": (
        Case(RIGHT | {"state": {"joints": StateSpec(3, "rad")}}),
        "needs 3 numbers",
    ),
    "dimension of actions": (Case(action(dim=7, names=None)), "action.dim: the policy returns 7"),
    "a missing camera": (Case(RIGHT | {"state": {"elbow": StateSpec(1)}}), "state 'elbow'"),
    "a state outside of the training": (
        Case(statistics=STATED, pose=(57.0, 0.5)),
        "degrees for radians",
    ),
    "another order by the training": (Case(statistics=STATED, pose=(0.9, 0.5)), "another order"),
    "a chunk outside of the training": (
        Case(statistics=STATED, rows=(0.0, 9.0)),
        r"first chunk\[1\]",
    ),
}
FITS = Case(statistics=STATED)


class Policy(Agent):
    transport = "local"

    def __init__(self, case: Case) -> None:
        self._case = case
        self.statistics = case.statistics
        self.metadata = {"policy": NAME}

    @property
    def contract(self) -> Contract:
        return Contract(**self._case.contract)

    def act(self, obs: Obs) -> Act:
        dim = self._case.contract["action"].dim
        return Act(np.tile(np.resize(np.array(self._case.rows, np.float32), dim), (4, 1)))


class Arm:
    """An arm that counts its motions; the command line creates it by name."""

    contract = Contract(**RIGHT)
    joint_names = ("pan", "lift")
    pose: tuple[float, float] = (0.0, 0.5)
    applied = 0
    closed = 0

    def observe(self) -> Obs:
        return Obs(state={"joints": np.array(Arm.pose, np.float32)})

    def apply(self, action: np.ndarray) -> None:
        Arm.applied += 1

    def stop(self) -> None: ...

    def close(self) -> None:
        Arm.closed += 1


def by_run_loop(case: Case, tmp_path: Path) -> None:
    run_loop(Arm(), ChunkPlayer(Policy(case), PlayerSettings("open_loop")), hz=200, seconds=0.02)


def by_run_loop_of_single_rows(case: Case, tmp_path: Path) -> None:
    class Single(Policy):
        def act(self, obs: Obs) -> Act:
            return Act(super().act(obs).rows()[0])

    run_loop(Arm(), Single(case), hz=200, seconds=0.02)


def by_an_asynchronous_player(case: Case, tmp_path: Path) -> None:
    run_loop(
        Arm(),
        ChunkPlayer(Policy(case), PlayerSettings("async", deadline_s=0.5)),
        hz=200,
        seconds=0.02,
    )


def by_the_command(case: Case, tmp_path: Path) -> None:
    options = ["http://nowhere", "--robot", f"{__name__}:Arm", "--seconds", "0.02", "--hz", "200"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "RemoteAgent", lambda *_, **__: Policy(case))
        patch.setitem(sys.modules, __name__, sys.modules[Arm.__module__])
        command._run(command.parse([*options, "--mode", "open_loop"]))
    assert Arm.closed == 1


def by_a_blind_evaluation(case: Case, tmp_path: Path) -> None:
    tasks = {"cup": {"instruction": "lift the cup", "max_steps": 4}}
    config = EvalConfig.model_validate(
        {
            "policies": [{"name": NAME, "url": "http://x"}],
            "suites": [{"envs": ["cup"], "episodes": 1}],
            "out": tmp_path / "out",
            "robot": {"arm": f"{__name__}:Arm", "hz": 200, "mode": "open_loop", "tasks": tasks},
        }
    )
    try:
        evaluate_on_robot(config, ScriptedPerson(judged("s")), agent_factory=lambda _: Policy(case))
    finally:
        assert Arm.closed == 1, "the evaluation closes the robot that it made"


Entry = Callable[[Case, Path], None]
ENTRIES: list[Entry] = [
    by_run_loop,
    by_run_loop_of_single_rows,
    by_an_asynchronous_player,
    by_the_command,
    by_a_blind_evaluation,
]


@pytest.fixture(autouse=True)
def _fresh_arm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Arm, "applied", 0)
    monkeypatch.setattr(Arm, "closed", 0)


@pytest.mark.parametrize("entry", ENTRIES)
@pytest.mark.parametrize("misfit", MISFITS)
def test_a_misfit_is_found_before_the_first_motion(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, misfit: str, entry: Entry
) -> None:
    case, said = MISFITS[misfit]
    monkeypatch.setattr(Arm, "pose", case.pose)
    with pytest.raises(ContractMismatch, match=said) as raised:
        entry(case, tmp_path)
    assert Arm.applied == 0
    assert NAME not in str(raised.value), "a blind evaluation does not name the policy"


@pytest.mark.parametrize("entry", ENTRIES)
def test_a_policy_that_fits_moves_the_arm(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, entry: Entry
) -> None:
    monkeypatch.setattr(Arm, "pose", FITS.pose)
    entry(FITS, tmp_path)
    assert Arm.applied > 0


@pytest.mark.parametrize("entry", ENTRIES)
def test_no_entry_point_moves_an_arm_that_holds(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, entry: Entry
) -> None:
    monkeypatch.setattr(Arm, "pose", FITS.pose)
    monkeypatch.setattr(Arm, "holds", "the wrist camera hangs", raising=False)
    entry(FITS, tmp_path)
    assert Arm.applied == 0
