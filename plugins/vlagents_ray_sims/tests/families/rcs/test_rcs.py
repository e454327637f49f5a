"""Tests of RCS's pick task in a separate Python environment, of a scene with two arms, and of
DuoBench 0.1.2 with the bodies of `rcs_stand_ins`.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from in_process_episode import Always, play

from vlagents_ray.contract import ActionSpec, Contract, differences
from vlagents_ray.envs import make_env
from vlagents_ray.errors import ConfigError, MissingDependency, UnknownEnv
from vlagents_ray.interface import Act, Obs
from vlagents_ray.testing import check_env
from vlagents_ray_sims.rcs import DuoBench, Rcs

pytestmark = pytest.mark.assets("rcs")

# The pose of the tool after a reset, m and xyzw; the tool points down.
HOME = (0.307, 0.0, 0.487, 1.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def pick() -> Iterator[Rcs]:
    with Rcs("pick", cameras=[]) as env:
        yield env


def led(env: Rcs, command: Sequence[float], steps: int = 40) -> Obs:
    """Reset, repeat a command for some steps, and return the last observation."""
    env.reset(seed=0)
    for _ in range(steps):
        obs, *_ = env.step(Act(np.array(command, np.float32)))
    return obs


def test_the_expert_picks_the_cuboid_up_and_that_ends_the_episode(pick: Rcs) -> None:
    for seed in range(4):
        result = play(pick, "rcs/pick", "vlagents_ray_sims.experts.rcs:RcsPick", seed=seed)
        assert (result.success_once, result.success_at_end, result.ending) == (
            True,
            True,
            "terminated",
        )
        assert result.steps < 100


@pytest.mark.parametrize("gripper", [0.0, 1.0])
def test_an_arm_that_stays_where_it_is_does_not_succeed(pick: Rcs, gripper: float) -> None:
    result = play(pick, "rcs/pick", Always(*HOME, gripper))
    assert (result.success_once, result.ending, result.steps) == (False, "truncated", 300)


def test_the_gripper_opens_at_one_and_closes_at_zero(pick: Rcs) -> None:
    assert led(pick, (*HOME, 1.0)).gripper == pytest.approx(1.0, abs=0.05)
    assert led(pick, (*HOME, 0.0)).gripper == pytest.approx(0.0, abs=0.05)
    with Rcs("pick", cameras=[], binary_gripper=False) as half_way:
        assert led(half_way, (*HOME, 0.5)).gripper == pytest.approx(0.5, abs=0.1)


def test_a_tquat_command_is_where_the_tool_goes(pick: Rcs) -> None:
    # The tool is turned by 0.6 rad about the vertical.
    turned = (0.45, 0.1, 0.3, math.cos(0.3), math.sin(0.3), 0.0, 0.0)
    np.testing.assert_allclose(led(pick, (*turned, 1.0)).state["tquat"], turned, atol=0.01)


def test_an_xyzrpy_command_is_where_the_tool_goes() -> None:
    pose = (0.45, 0.1, 0.3, math.pi - 0.1, 0.05, 0.4)
    with Rcs("pick", cameras=[], control_mode="xyzrpy") as env:
        assert (env.contract.action.dim, env.contract.action.rotation) == (7, "euler_xyz")
        np.testing.assert_allclose(led(env, (*pose, 1.0)).state["xyzrpy"], pose, atol=0.01)
        assert (
            "control: xyzrpy, the protocol says tquat" in env.describe()["protocol"]["deviations"]
        )


def test_a_joints_command_is_where_the_joints_go() -> None:
    joints = (0.2, -0.6, 0.1, -2.2, 0.0, 1.6, 0.9)
    with Rcs("pick", cameras=[], control_mode="joints") as env:
        np.testing.assert_allclose(led(env, (*joints, 1.0)).state["joints"], joints, atol=0.01)


def test_a_delta_command_moves_on_from_where_the_arm_is() -> None:
    with Rcs("pick", cameras=[], control_mode="xyzrpy", delta=True) as env:
        assert env.contract.action.delta is True
        y = [
            led(env, (0.0, 0.01, 0.0, 0.0, 0.0, 0.0, 1.0), steps).state["xyzrpy"][1]
            for steps in (10, 20)
        ]
    assert 0.01 < y[0] < y[1] - 0.01


def test_a_single_arms_parts_have_plain_names(pick: Rcs) -> None:
    contract = pick.contract
    assert {name: part.dim for name, part in (contract.state or {}).items()} == {
        "joints": 7,
        "tquat": 7,
        "xyzrpy": 6,
    }
    assert (contract.cameras, contract.gripper, contract.action.arms, contract.control_hz) == (
        {},
        True,
        None,
        30.0,
    )


def test_the_image_shows_the_cuboid_where_mujoco_projects_it() -> None:
    """A MuJoCo camera looks along its -z axis, with x to the right and y up."""
    with Rcs("pick", width=160, height=120, cameras=["bird_eye"]) as env:
        for seed in range(3):
            env.reset(seed=seed)
            obs, *_ = env.step(Act(np.array([*HOME, 1.0], np.float32)))
            red, green, blue = (obs.cameras["bird_eye"][..., i].astype(int) for i in range(3))
            rows, columns = np.nonzero((green > red + 60) & (green > blue + 40))
            data, [place] = env._sim.data, list(obs.info["objects"].values())
            x, y, z = data.camera("bird_eye").xmat.reshape(3, 3).T @ (
                place[:3] - data.camera("bird_eye").xpos
            )
            focal = 60 / math.tan(math.radians(env._sim.model.camera("bird_eye").fovy[0]) / 2)
            assert columns.mean() == pytest.approx(80 + focal * x / -z, abs=2)
            assert rows.mean() == pytest.approx(60 - focal * y / -z, abs=2)


def test_a_description_names_versions_robot_and_protocol(pick: Rcs) -> None:
    facts = pick.describe()
    assert (facts["rcs-core"], facts["robots"]) == ("0.7.3", {"right": "FR3"})
    assert (facts["protocol"]["name"], facts["protocol"]["deviations"]) == ("RCS pick", [])


def test_without_assets_nothing_is_downloaded_but_the_cure_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: object
) -> None:
    assert Rcs.missing() is None
    monkeypatch.setenv("RCS_PREFIX", str(tmp_path))
    assert "set RCS_PREFIX" in (Rcs.missing() or "")
    with pytest.raises(
        MissingDependency, match=r"rcs/pick: rcs's assets are not in .*set RCS_PREFIX"
    ):
        Rcs("pick")


def test_what_cannot_be_evaluated_is_refused() -> None:
    with pytest.raises(UnknownEnv, match=r"expected a task of \['pick'\].*got 'fr3'"):
        Rcs("fr3")
    with pytest.raises(UnknownEnv, match=r"knows no 'rcs/crane'"):
        Rcs("rcs/crane", module="rcs.envs.configs", max_steps=5)
    with pytest.raises(ConfigError, match="set max_steps"):
        Rcs("rcs/fr3", module="rcs.envs.configs")
    with pytest.raises(ConfigError, match=r"expected cameras of .*'bird_eye'.*, got \['top'\]"):
        Rcs("pick", cameras=["top"])
    with Rcs(
        "rcs/fr3", module="rcs.envs.configs", max_steps=5, cameras=[], instruction="wave"
    ) as env:
        env.reset(seed=0)
        with pytest.raises(ConfigError, match="expected a task that reports success"):
            env.step(Act(np.array([*HOME, 1.0], np.float32)))


LAB = {"module": "two_arms", "max_steps": 8, "instruction": "pick up the cuboid"}


@pytest.fixture(scope="module")
def lab() -> Iterator[Rcs]:
    with Rcs("lab/two_arms", cameras=[], **LAB) as env:
        yield env


def test_each_arm_has_its_parts_under_its_name(lab: Rcs) -> None:
    state = lab.reset(seed=0)[0].state
    assert {name: part.shape[0] for name, part in state.items()} == {
        f"{side}/{part}": size
        for side in ("left", "right")
        for part, size in (("joints", 7), ("tquat", 7), ("xyzrpy", 6), ("gripper", 1))
    }
    assert (lab.contract.action.dim, lab.contract.action.arms) == (16, ("left", "right"))
    assert lab.contract.gripper is False
    # Both poses are in the same frame.
    assert state["left/tquat"][1] - state["right/tquat"][1] == pytest.approx(0.8, abs=1e-3)


@pytest.mark.parametrize(("moved", "still", "first"), [("left", "right", 0), ("right", "left", 8)])
def test_each_arm_follows_its_part_of_the_action(
    lab: Rcs, moved: str, still: str, first: int
) -> None:
    begin = lab.reset(seed=0)[0].state
    action = np.concatenate([[*begin[f"{side}/joints"], 1.0] for side in ("left", "right")]).astype(
        np.float32
    )
    action[first] += 0.2
    action[first + 7] = 0.0
    for _ in range(30):
        obs, *_ = lab.step(Act(action))
    assert obs.state[f"{moved}/joints"][0] - begin[f"{moved}/joints"][0] == pytest.approx(
        0.2, abs=0.01
    )
    np.testing.assert_allclose(obs.state[f"{still}/joints"], begin[f"{still}/joints"], atol=0.01)
    assert obs.state[f"{moved}/gripper"][0] < 0.05
    assert obs.state[f"{still}/gripper"][0] > 0.95


@pytest.fixture(scope="module")
def transfer() -> Iterator[DuoBench]:
    with DuoBench("transfer_cube", cameras=["head"], width=32, height=32) as env:
        yield env


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("rcs/pick", {"cameras": ["wrist"], "width": 40, "height": 32, "max_steps": 8}),
        # The id of a scene that a user has registered.
        ("rcs/lab/two_arms", {"width": 32, "height": 32, **LAB}),
        (
            "duobench/transfer_cube",
            {"cameras": ["head"], "width": 16, "height": 16, "max_steps": 6},
        ),
    ],
)
def test_it_keeps_the_promises_of_an_env(name: str, options: dict[str, Any]) -> None:
    check_env(make_env(name, **options))


def test_it_is_set_up_as_its_authors_evaluate(transfer: DuoBench) -> None:
    simulator = transfer._env
    config = simulator.get_wrapper_attr("sim").get_config()
    assert (config.async_control, config.realtime, config.frequency) == (True, False, 30)
    assert transfer.contract.action.space == "joint"
    assert transfer.contract.action.delta is False
    assert (transfer.contract.action.dim, transfer.contract.action.arms) == (16, ("left", "right"))
    assert transfer.describe()["protocol"]["deviations"] == []
    assert transfer.describe()["duobench"] == "0.1.2"


def test_its_instruction_is_the_simulators(transfer: DuoBench) -> None:
    transfer.reset(seed=0)
    assert "right arm" in transfer.instruction
    assert "white bowl" in transfer.instruction


def test_the_last_stage_is_success_and_ends_the_episode(transfer: DuoBench) -> None:
    obs, info = transfer.reset(seed=0)
    still = np.concatenate(
        [[*obs.state[f"{side}/joints"], 1.0] for side in ("left", "right")]
    ).astype(np.float32)
    *_, info = transfer.step(Act(still))
    assert (info["success"], info["stage"], info["max_stage"]) == (False, 0, 4)
    data = transfer._sim.data
    bowl = obs.info["objects"]["TransferAndPlace_white_bowl_joint"]
    data.joint("TransferAndPlace_white_long_box_joint").qpos[:3] = bowl[:3] + np.array(
        [0.0, 0.0, 0.03]
    )
    _, reward, terminated, _, info = transfer.step(Act(still))
    assert (info["success"], info["stage"], reward, terminated) == (True, 4, 1.0, True)


def test_all_its_tasks_are_registered_by_its_package() -> None:
    for task in DuoBench.known.values():
        importlib.import_module(str(task.module))
    assert {task.id for task in DuoBench.known.values()} <= set(gymnasium.registry)


def test_rcs_own_tasks_keep_their_scene_beside_it() -> None:
    duobench = importlib.import_module("duobench")
    with Rcs("pick", cameras=[]) as env:
        scene = importlib.import_module("rcs").SCENE_PATHS["empty_world"]
        assert scene != duobench.SCENE_PATHS["empty_world"]
        assert env._sim.model.geom("floor").type == mujoco.mjtGeom.mjGEOM_PLANE


def test_a_policy_for_one_arm_is_refused(transfer: DuoBench) -> None:
    [found] = differences(Contract(action=ActionSpec(dim=7)), transfer.contract)
    assert "action.dim" in found


def test_without_its_assets_the_cure_is_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: object
) -> None:
    monkeypatch.setenv("DUOBENCH_PREFIX", str(tmp_path))
    with pytest.raises(MissingDependency, match="set DUOBENCH_PREFIX"):
        DuoBench("transfer_cube")
    with pytest.raises(ConfigError, match="max_steps: expected a number of at least 1, got 0"):
        DuoBench("transfer_cube", max_steps=0)
