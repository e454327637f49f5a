"""Tests of Meta-World with its simulator; each test renders through EGL."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from in_process_episode import Always, play

from vlagents_ray.contract import CameraSpec
from vlagents_ray.envs.base import known_contract
from vlagents_ray.errors import ConfigError, UnknownEnv
from vlagents_ray.interface import Act
from vlagents_ray.testing import check_env
from vlagents_ray.validation import check_observation
from vlagents_ray_sims.metaworld import PROTOCOL, MetaWorld

metaworld = pytest.importorskip("metaworld")
pytestmark = [pytest.mark.sim, pytest.mark.integration]

STILL = Act(np.zeros(4, np.float32))


@pytest.fixture(scope="module")
def reach() -> Iterator[MetaWorld]:
    with MetaWorld("reach-v3", width=48, height=32) as env:
        yield env


def command(*action: float) -> Act:
    return Act(np.array(action, dtype=np.float32))


def test_it_keeps_the_promises_of_an_env() -> None:
    check_env(MetaWorld("drawer-open-v3", width=32, height=32, max_steps=6), steps=4)


@pytest.mark.parametrize("task", ["assembly-v3", "pick-place-v3", "window-close-v3"])
def test_each_task_gives_what_its_contract_states(task: str) -> None:
    with MetaWorld(task, width=40, height=32) as env:
        obs, _ = env.reset(seed=3)
        obs, reward, terminated, truncated, info = env.step(STILL)
        check_observation(obs, env.contract)
        assert env.contract.cameras == {"corner2": CameraSpec(32, 40)}
        assert env.contract.control_hz == pytest.approx(80.0)
        assert known_contract(f"metaworld/{task}", {"width": 40, "height": 32}) == replace(
            env.contract, control_hz=None
        )
        assert env.instruction == task.removesuffix("-v3").replace("-", " ")
        assert obs.info["sim_state"].shape == (39,)
        assert np.isfinite(reward)
        assert (terminated, truncated, info["success"]) == (False, False, False)


def test_the_image_stands_upright() -> None:
    """The plain grey background is at the top of the image; the bottom left corner shows the white
    floor.
    """
    with MetaWorld("drawer-open-v3", width=60, height=60) as env:
        image = env.reset(seed=0)[0].cameras["corner2"].astype(int)
    assert image.shape == (60, 60, 3)
    assert np.ptp(image[:8], axis=(0, 1)).max() < 20
    assert image[:8].mean() < 150
    assert image[-4:, :4].mean() > 200


def test_cameras_are_chosen_by_name() -> None:
    with MetaWorld("reach-v3", width=32, height=32, cameras=("corner", "gripperPOV")) as env:
        images = env.reset(seed=0)[0].cameras
        assert set(images) == {"corner", "gripperPOV"}
        assert not np.array_equal(images["corner"], images["gripperPOV"])


def test_what_is_unknown_or_too_long_is_named() -> None:
    assert len(MetaWorld.tasks()) == 50
    with pytest.raises(UnknownEnv, match=r"reach-v2.*reach-v3"):
        MetaWorld("reach-v2")
    with pytest.raises(ConfigError, match=r"expected cameras of .*'corner2'.*, got \['wrist'\]"):
        MetaWorld("reach-v3", cameras=("wrist",))
    with pytest.raises(ConfigError, match="500"):
        MetaWorld("reach-v3", max_steps=501)


def test_the_gripper_closes_at_one_and_opens_at_minus_one(reach: MetaWorld) -> None:
    reach.reset(seed=0)
    for _ in range(30):
        closed, *_ = reach.step(command(0, 0, 0, 1))
    for _ in range(30):
        opened, *_ = reach.step(command(0, 0, 0, -1))
    assert closed.gripper is not None
    assert opened.gripper is not None
    assert closed.gripper < 0.4
    assert opened.gripper > 0.9


def test_a_command_moves_the_hand_along_its_axis(reach: MetaWorld) -> None:
    for i in range(3):
        start = reach.reset(seed=0)[0].state["xyz"]
        action = np.zeros(4, np.float32)
        action[i] = 1.0
        for _ in range(10):
            obs, *_ = reach.step(Act(action))
        moved = obs.state["xyz"] - start
        assert 0.03 < moved[i] <= 0.1 + 1e-3  # at most 0.01 m per step
        assert np.abs(np.delete(moved, i)).max() < 0.02


def test_fifty_initial_states_are_those_of_mt1() -> None:
    tasks = metaworld.MT1("reach-v3", seed=42).train_tasks
    with MetaWorld("reach-v3", width=16, height=16, goals_seed=42) as env:
        assert env.init_states == 50
        for index in (0, 7, 49):
            goal = env.reset(seed=index, options={"init_state": index})[0].info["sim_state"][36:39]
            drawn = pickle.loads(tasks[index].data)["rand_vec"]  # noqa: S301 - Meta-World's own pickle, made by this process
            np.testing.assert_array_equal(goal, drawn[3:])
        again = env.reset(seed=99, options={"init_state": 7})[0].info["sim_state"]
        np.testing.assert_array_equal(
            again, env.reset(seed=7, options={"init_state": 7})[0].info["sim_state"]
        )


@pytest.mark.parametrize("ends", [True, False])
def test_success_ends_the_episode_unless_told_otherwise(ends: bool) -> None:
    with MetaWorld("reach-v3", cameras=(), max_steps=120, ends_on_success=ends) as env:
        solved = play(
            env, "metaworld/reach-v3", "vlagents_ray_sims.experts.metaworld:MetaWorldExpert"
        )
        assert solved.success_once
        assert (solved.ending == "terminated") is ends
        assert (solved.steps == 120) is not ends
        assert not play(env, "metaworld/reach-v3", Always(0, 0, 0, 0)).success_once
        assert len(env.describe()["protocol"]["deviations"]) == (1 if ends else 2)


def test_a_camera_stands_where_it_is_told() -> None:
    seen = []
    for positions in (None, {"corner2": (0.75, 0.075, 0.7)}, {"corner2": (0.75, 0.075, 0.7)}):
        with MetaWorld("reach-v3", width=32, height=32, camera_positions=positions) as env:
            seen.append(env.reset(seed=0)[0].cameras["corner2"])
    np.testing.assert_array_equal(seen[1], seen[2])
    assert not np.array_equal(seen[0], seen[1])


def test_without_shadows_the_image_is_otherwise_the_same() -> None:
    def image(shadows: bool) -> np.ndarray:
        with MetaWorld("drawer-open-v3", width=64, height=64, shadows=shadows) as env:
            return env.reset(seed=1)[0].cameras["corner2"].astype(int)

    difference = np.abs(image(True) - image(False))
    assert 0 < (difference.max(-1) > 20).mean() < 0.5
    assert difference.mean() < 25


def test_the_protocols_constants_are_the_simulators(reach: MetaWorld) -> None:
    assert PROTOCOL.max_steps == reach._env.max_path_length
    assert pytest.approx(1 / reach._env.dt) == PROTOCOL.control_hz
    assert reach.describe()["protocol"]["deviations"] == []
