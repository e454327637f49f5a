"""Whether a checkpoint's training fits the arm, before the first motion."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vlagents_ray import Act, ActionSpec, Agent, ConfigError, Contract, Obs
from vlagents_ray.cli.robot import _require_fit, parse
from vlagents_ray.contract import StateSpec
from vlagents_ray.errors import ContractMismatch
from vlagents_ray.robot import Limits
from vlagents_ray.robot.fit import Trained, require_fit

LOW, HIGH = [-1.0, -2.0, 0.0], [1.0, 0.5, 1.0]
TRAINED = Trained((np.array(LOW), np.array(HIGH)), (np.array(LOW), np.array(HIGH)))
NAMES = ("pan", "lift", "gripper")


@pytest.mark.parametrize(
    "content",
    [
        {"observation.state": {"min": LOW, "max": HIGH, "mean": LOW}, "action": {"min": LOW, "max": HIGH}},
        {"norm_stats": {"state": {"q01": LOW, "q99": HIGH}, "actions": {"q01": LOW, "q99": HIGH}}},
        {
            "so101": {
                part: {"arm": {"min": LOW[:2], "max": HIGH[:2]}, "gripper": {"min": LOW[2:], "max": HIGH[2:]}}
                for part in ("state", "action")
            }
        },
    ],
)
def test_the_statistics_of_three_libraries_are_read(tmp_path: Path, content: dict[str, object]) -> None:
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
        ([57.0, -1.0, 0.5], r"state\[0\] \(pan\): got 57, was trained from -1 to 1; degrees for radians\?"),
        ([-1.9, -1.0, 0.5], r"state\[0\] \(pan\): got -1.9, .*fit number \[1\] \(lift\): another order\?"),
        ([0.5, -1.0], "got 2 numbers, was trained with 3"),
    ],
)
def test_a_state_outside_of_the_training_is_found_with_its_number(state: list[float], said: str | None) -> None:
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
    assert found.startswith("first chunk[2]: got 4, was trained from 0 to 1")
    [found] = TRAINED.misfits(None, None, Limits(low=(-1.0, -1.5, 0.0), joints=NAMES))
    assert found.startswith("action[1] (lift): was trained to -2, the arm's limit is -1.5")


def test_an_accepted_misfit_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        require_fit(["state[0]: got 57"], accept=True)
    assert "state[0]: got 57" in caplog.text


def test_the_command_compares_the_arm_in_the_order_of_the_contract(tmp_path: Path) -> None:
    class Still(Agent):
        contract = Contract(state={"joints": StateSpec(2)}, gripper=True, action=ActionSpec(dim=3))

        def act(self, obs: Obs) -> Act:
            return Act(np.zeros((4, 3), np.float32))

    ranges = {"min": LOW, "max": HIGH}
    (tmp_path / "stats.json").write_text(json.dumps({"observation.state": ranges, "action": ranges}))
    given = ["http://gpu-box:8000", "--trained-on", str(tmp_path / "stats.json")]
    far = Obs(gripper=1.0, state={"joints": np.array([57, 0], np.float32)})
    _require_fit(parse(given), Still(), replace(far, state={"joints": np.zeros(2, np.float32)}), None)
    with pytest.raises(ContractMismatch, match="degrees for radians"):
        _require_fit(parse(given), Still(), far, None)
    _require_fit(parse([*given, "--accept-misfit"]), Still(), far, None)
