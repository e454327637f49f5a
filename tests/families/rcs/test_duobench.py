"""DuoBench 0.1.2's own code, driven on simple bodies in place of its assets: see `stand_ins`."""

from __future__ import annotations

import importlib
from collections.abc import Iterator

import gymnasium
import mujoco
import numpy as np
import pytest

from vlagents_ray.contract import ActionSpec, Contract, differences
from vlagents_ray.envs import make_env
from vlagents_ray.envs.rcs import DuoBench, Rcs
from vlagents_ray.errors import ConfigError, MissingDependency
from vlagents_ray.interface import Act
from vlagents_ray.testing import check_env

pytestmark = pytest.mark.assets("rcs")


@pytest.fixture(scope="module")
def transfer() -> Iterator[DuoBench]:
    with DuoBench("transfer_cube", cameras=["head"], width=32, height=32) as env:
        yield env


def test_it_keeps_the_promises_of_an_env() -> None:
    check_env(make_env("duobench/transfer_cube", cameras=["head"], width=16, height=16, max_steps=6))


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
    still = np.concatenate([[*obs.state[f"{side}/joints"], 1.0] for side in ("left", "right")]).astype(np.float32)
    *_, info = transfer.step(Act(still))
    assert (info["success"], info["stage"], info["max_stage"]) == (False, 0, 4)
    data = transfer._sim.data
    bowl = obs.info["objects"]["TransferAndPlace_white_bowl_joint"]
    data.joint("TransferAndPlace_white_long_box_joint").qpos[:3] = bowl[:3] + np.array([0.0, 0.0, 0.03])
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


def test_without_its_assets_the_cure_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: object) -> None:
    monkeypatch.setenv("DUOBENCH_PREFIX", str(tmp_path))
    with pytest.raises(MissingDependency, match="set DUOBENCH_PREFIX"):
        DuoBench("transfer_cube")
    with pytest.raises(ConfigError, match="max_steps is 0"):
        DuoBench("transfer_cube", max_steps=0)
