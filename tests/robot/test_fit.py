"""The comparison of a checkpoint's training data with the arm, before the first motion."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import numpy as np
import pytest

from vlagents_ray import Act, ActionSpec, Agent, ConfigError, Contract, Obs
from vlagents_ray.cli.robot import _require_fit, parse
from vlagents_ray.contract import StateSpec, require_match
from vlagents_ray.errors import ContractMismatch
from vlagents_ray.robot import MotionLimits
from vlagents_ray.robot.fit import Trained, require_fit
from vlagents_ray.robot.loop import contract_of

LOW, HIGH = [-1.0, -2.0, 0.0], [1.0, 0.5, 1.0]
TRAINED = Trained((np.array(LOW), np.array(HIGH)), (np.array(LOW), np.array(HIGH)))
NAMES = ("pan", "lift", "gripper")


@pytest.mark.parametrize(
    "content",
    [
        {
            "observation.state": {"min": LOW, "max": HIGH, "mean": LOW},
            "action": {"min": LOW, "max": HIGH},
        },
        {"norm_stats": {"state": {"q01": LOW, "q99": HIGH}, "actions": {"q01": LOW, "q99": HIGH}}},
        {
            "so101": {
                part: {
                    "arm": {"min": LOW[:2], "max": HIGH[:2]},
                    "gripper": {"min": LOW[2:], "max": HIGH[2:]},
                }
                for part in ("state", "action")
            }
        },
    ],
)
def test_the_statistics_of_three_libraries_are_read(
    tmp_path: Path, content: dict[str, object]
) -> None:
    (tmp_path / "stats.json").write_text(json.dumps(content))
    found = Trained.read(tmp_path / "stats.json")
    for part in (found.state, found.action):
        assert part is not None
        assert [one.tolist() for one in part] == [LOW, HIGH]


@pytest.mark.parametrize("text", ["[]", "{", "{}", '{"action": {"mean": [0]}}'])
def test_a_file_without_ranges_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "stats.json").write_text(text)
    with pytest.raises(ConfigError, match=r"stats\.json"):
        Trained.read(tmp_path / "stats.json")


@pytest.mark.parametrize(
    ("state", "said"),
    [
        ([0.5, -1.0, 0.5], None),
        (
            [57.0, -1.0, 0.5],
            r"state\[0\] \(pan\): expected -1 to 1, the range of the training, got 57; degrees for radians\?",
        ),
        (
            [-1.9, -1.0, 0.5],
            r"state\[0\] \(pan\): expected .*, got -1.9.*fit number \[1\] \(lift\): another order\?",
        ),
        ([0.5, -1.0], "expected 3 numbers, as the policy was trained with, got 2"),
    ],
)
def test_a_state_outside_of_the_training_is_found_with_its_number(
    state: list[float], said: str | None
) -> None:
    found = TRAINED.misfits(np.array(state), None, None, NAMES)
    if said is None:
        assert found == []
        require_fit(found)
    else:
        with pytest.raises(ContractMismatch, match=said):
            require_fit(found)


def test_a_first_chunk_and_limits_are_compared_with_the_training() -> None:
    chunk = np.zeros((5, 3))
    chunk[3, 2] = 4.0
    [found] = TRAINED.misfits(None, chunk, None)
    assert found.startswith("first chunk[2]: expected 0 to 1, the range of the training, got 4")
    [found] = TRAINED.misfits(None, None, MotionLimits(low=(-1.0, -1.5, 0.0), joints=NAMES))
    assert found.startswith("action[1] (lift): was trained to -2, the arm's limit is -1.5")


def test_an_accepted_misfit_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        require_fit(["state[0]: got 57"], accept=True)
    assert "state[0]: got 57" in caplog.text


def test_the_first_chunk_is_drawn_beside_the_training_and_the_limits() -> None:
    chunk = np.array([[0.0, 0.1, 1.0], [0.3, 0.2, 0.9]])
    header, *lines = TRAINED.draw(
        chunk, MotionLimits(low=(-1.5, -2.5, 0.0), high=(1.5, 1.0, 1.0)), NAMES
    )
    assert header.split()[-3:] == ["chunk", "training", "limits"]
    assert [line.split("|")[0].strip() for line in lines] == [
        "[0] (pan)",
        "[1] (lift)",
        "[2] (gripper)",
    ]
    assert lines[0].split("|")[1:] == [
        ".....----------####-------......",
        "             0 … 0.3              -1 … 1          -1.5 … 1.5",
    ]


def test_a_chunk_is_drawn_without_training_and_limits() -> None:
    assert ["#" in line for line in Trained().draw(np.zeros((2, 2)), None)[1:]] == [True, True]


def test_joints_in_another_order_than_that_of_the_limits_are_found_by_name() -> None:
    limits = MotionLimits(joints=("lift.pos", "pan.pos", "gripper.pos"))
    first, second = Trained().misfits(None, None, limits, NAMES)
    assert (
        first == "joints: number 0 is 'pan' in the arm and 'lift' in its limits; use the same order"
    )
    assert "number 1 is 'lift'" in second
    assert Trained().misfits(None, None, MotionLimits(joints=("pan.pos", "lift.pos")), NAMES) == []
    assert Trained().misfits(None, None, MotionLimits(joints=("joint1", "joint2")), NAMES) == [], (
        "other names prove nothing"
    )


def test_joints_in_another_order_than_that_of_the_policy_are_found_by_name() -> None:
    policy = Contract(action=ActionSpec(dim=3, names=("lift.pos", "pan.pos", "gripper.pos")))
    with pytest.raises(
        ContractMismatch, match="number 0 is 'lift' in the policy and 'pan' in the env"
    ) as caught:
        require_match(policy, contract_of(Standing(0, 0)))
    assert str(caught.value).count("- action.names: number") == 2
    require_match(Contract(action=ActionSpec(names=NAMES)), contract_of(Standing(0, 0)))
    require_match(policy, contract_of(Nameless()))


class Still(Agent):
    contract: Contract | None = Contract(  # type: ignore[assignment]
        state={"joints": StateSpec(2)}, gripper=True, action=ActionSpec(dim=3)
    )

    def __init__(self, statistics: dict[str, object] | None = None) -> None:
        self.statistics = statistics

    def act(self, obs: Obs) -> Act:
        return Act(np.zeros((4, 3), np.float32))


class Standing:
    """A robot at rest."""

    joint_names: tuple[str, ...] = NAMES[:2]

    def __init__(self, *joints: float) -> None:
        self.joints = np.array(joints, np.float32)

    def observe(self) -> Obs:
        return Obs(gripper=1.0, state={"joints": self.joints})

    def apply(self, action: np.ndarray) -> None:
        raise AssertionError

    def stop(self) -> None: ...


class Nameless(Standing):
    """A robot without names of joints."""

    joint_names = ()

    def __init__(self) -> None:
        super().__init__(0, 0)


RANGES = {"min": LOW, "max": HIGH}


def test_the_command_compares_the_arm_in_the_order_of_the_contract(tmp_path: Path) -> None:
    (tmp_path / "stats.json").write_text(
        json.dumps({"observation.state": RANGES, "action": RANGES})
    )
    given = ["http://gpu-box:8000", "--stats", str(tmp_path / "stats.json")]
    said: list[str] = []
    _require_fit(parse(given), Still(), Standing(0, 0), None, said.append)
    assert len(said) == 4
    with pytest.raises(ContractMismatch, match="degrees for radians"):
        _require_fit(parse(given), Still(), Standing(57, 0), None, said.append)
    _require_fit(parse([*given, "--ignore-mismatch"]), Still(), Standing(57, 0), None, said.append)


def test_the_statistics_are_those_of_the_server_unless_a_file_is_named(
    caplog: pytest.LogCaptureFixture,
) -> None:
    stated = {
        "parts": ["gripper", "joints"],
        "observation.state": {"min": [0, -1, -2], "max": [1, 1, 0.5]},
    }
    agent, said = Still(stated), list[str]()
    words = ["http://gpu-box:8000", "--robot", "test_fit:Standing"]
    with caplog.at_level(logging.INFO):
        _require_fit(parse(words), agent, Standing(0.9, -1.9), None, said.append)
    assert said[0] in caplog.text
    with pytest.raises(ContractMismatch, match=r"state\[1\] \(lift\): expected .*, got 57"):
        _require_fit(parse(words), agent, Standing(57, 0), None, said.append)
    said.clear()
    _require_fit(parse(words), Still(), Standing(57, 0), None, said.append)
    [line] = said
    assert "declares no ranges of its training" in line
    assert "--stats" in line
