"""Tests of robosuite's tasks that need no robosuite: protocols, contracts, options, and
the expert.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from vlagents_ray.contract import CameraSpec
from vlagents_ray.envs.base import known_contract, make_env
from vlagents_ray.errors import (
    ConfigError,
    ContractMismatch,
    InvalidObservation,
    MissingState,
    NotReset,
    UnknownEnv,
)
from vlagents_ray.interface import Obs
from vlagents_ray_sims.experts.osc_pose import RobosuiteExpert
from vlagents_ray_sims.robosuite import TASKS, Robosuite


def test_the_protocols_are_robomimics() -> None:
    limits = {name: task.protocol.max_steps for name, task in TASKS.items()}
    assert limits == {
        "Lift": 400,
        "PickPlaceCan": 400,
        "NutAssemblySquare": 400,
        "ToolHang": 700,
        "TwoArmTransport": 700,
    }
    lift = TASKS["Lift"].protocol
    assert (lift.episodes, lift.control_hz, lift.ends_on_success) == (50, 20.0, True)
    assert lift.describe(max_steps=100)["deviations"] == ["max_steps: 100, the protocol says 400"]


def test_the_contract_is_known_before_the_simulator_is_made() -> None:
    lift = known_contract("robosuite/Lift", {})
    assert lift is not None
    assert lift.cameras == {
        "agentview": CameraSpec(84, 84),
        "robot0_eye_in_hand": CameraSpec(84, 84),
    }
    assert (lift.action.dim, lift.action.frame, lift.action.gripper_open, lift.control_hz) == (
        7,
        "base",
        -1.0,
        20.0,
    )
    both = known_contract("robosuite/TwoArmTransport", {"cameras": ["agentview"], "width": 96})
    assert both is not None
    assert both.cameras == {"agentview": CameraSpec(84, 96)}
    assert (both.action.dim, both.action.arms, both.gripper) == (14, ("robot0", "robot1"), False)
    assert both.state is not None
    assert both.state["robot1_eef_quat"].unit == "quat_xyzw"


def test_a_wrong_name_size_or_installation_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UnknownEnv, match="did you mean 'Lift'"):
        make_env("robosuite/Lifts")
    with pytest.raises(ConfigError, match="width: expected a number of at least 1, got 0"):
        make_env("robosuite/Lift", width=0)
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    assert "venv create robosuite" in str(Robosuite.missing())


def seen(hand: tuple[float, float, float], yaw: float = 0.0) -> Obs:
    """Return an observation of a hand that points down, and a nut that is turned by `yaw`."""
    state = {
        "robot0_eef_pos": np.array(hand, np.float32),
        "robot0_eef_quat": np.array([1, 0, 0, 0], np.float32),
    }
    nut = {
        "SquareNut_pos": np.array([0.1, 0.2, 0.83]),
        "SquareNut_quat": np.array([0, 0, math.sin(yaw / 2), math.cos(yaw / 2)]),
        "target_pos": np.array([0.23, 0.1, 0.85]),
    }
    return Obs(state=state, info={"sim_state": nut})


def test_the_expert_goes_over_the_handle_turns_across_it_and_opens_the_hand() -> None:
    expert = RobosuiteExpert("robosuite/NutAssemblySquare")
    yaw = math.pi / 4
    over = (0.1 + 0.054 * math.cos(yaw), 0.2 + 0.054 * math.sin(yaw), 0.83 + 0.12)
    start = seen((over[0], over[1] - 0.02, over[2]), yaw)
    expert.reset(start, "")
    np.testing.assert_allclose(expert.act(start).action, [0, 0.4, 0, 0, 0, 0.3, -1], atol=1e-3)
    there = seen(over, yaw)
    np.testing.assert_allclose(expert.act(there).action[:3], [0, 0, -1], atol=1e-3)


def test_the_expert_says_what_it_wants() -> None:
    expert = RobosuiteExpert("robosuite/PickPlaceCan")
    with pytest.raises(NotReset):
        expert.act(Obs())
    with pytest.raises(MissingState, match="robot0_eef_pos"):
        expert.reset(Obs(), "")
    with pytest.raises(InvalidObservation, match=r"expected 'Can_quat', \(4,\)"):
        expert.reset(seen((0, 0, 1)), "")
    with pytest.raises(ContractMismatch, match="robosuite/Lift"):
        RobosuiteExpert("robosuite/ToolHang")
