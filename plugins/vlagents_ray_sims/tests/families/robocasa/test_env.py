"""Tests of RoboCasa's tasks with RoboCasa's own code, in a plain kitchen in place of its assets
(robocasa_stand_ins.py).
"""

from __future__ import annotations

import gc
import re
import sys
import weakref
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from in_process_episode import Always, play
from robocasa_stand_ins import write_package

from vlagents_ray import Agent
from vlagents_ray.errors import EnvFailed
from vlagents_ray.interface import Act, Obs
from vlagents_ray.testing import check_env
from vlagents_ray_sims.robocasa import (
    ATOMIC_SEEN,
    COMPOSITE_SEEN,
    COMPOSITE_UNSEEN,
    CONTROL_HZ,
    DOWNLOAD_TYPES,
    RoboCasa,
)

STILL = (0.0,) * 11 + (-1.0,)
MOVE = np.array([0.9, -0.8, 0.7, 0.2, 1.0, 0.5, -0.5, -0.3, 0, 0, 0.3, 1], np.float32)
BREAKAWAY = 0.25  # m/s or rad/s; the friction of the base's joints stops slower motions


@pytest.fixture(scope="module", autouse=True)
def kitchen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Yield the folder of a robocasa with stand-ins as its assets, which this process imports."""
    assert "robocasa" not in sys.modules
    folder = write_package(tmp_path_factory.mktemp("robocasa"))
    sys.path.insert(0, str(folder))
    yield folder
    sys.path.remove(str(folder))


@pytest.fixture(scope="module")
def drive(kitchen: Path) -> Iterator[RoboCasa]:
    with RoboCasa("NavigateKitchen", width=32, height=24) as env:
        yield env


class Driver(Agent):
    """Drives the base in a straight line to the task's goal, and turns it to the goal's
    orientation.
    """

    def __init__(self, env: RoboCasa) -> None:
        self._env = env._env  # only the simulator knows the goal

    def act(self, obs: Obs) -> Act:
        yaw = 2 * np.arctan2(obs.state["base_rotation"][2], obs.state["base_rotation"][3])
        east, north = self._env.target_pos[:2] - obs.state["base_position"][:2]
        turn = (self._env.target_ori[2] - yaw + np.pi) % (2 * np.pi) - np.pi
        forward, left = (
            east * np.cos(yaw) + north * np.sin(yaw),
            north * np.cos(yaw) - east * np.sin(yaw),
        )
        speeds = [1.5 * error + BREAKAWAY * np.sign(error) for error in (forward, left, turn)]
        return Act(np.clip([*speeds, 0, 1, *[0] * 6, -1], -1, 1).astype(np.float32))


@pytest.mark.slow
def test_it_keeps_the_promises_of_an_env() -> None:
    env = RoboCasa("OpenDrawer", width=16, height=16, cameras=("robot0_eye_in_hand",), max_steps=3)
    check_env(env, steps=2)


def test_what_it_shows_is_robocasas_own_to_the_bit_in_both_orders_of_an_action(
    drive: RoboCasa,
) -> None:
    from robocasa.utils.env_utils import convert_action
    from robocasa.wrappers.gym_wrapper import RoboCasaGymEnv

    arm_first = np.concatenate([MOVE[5:], MOVE[:5]])
    theirs = RoboCasaGymEnv("NavigateKitchen", split="target", camera_widths=32, camera_heights=24)
    raw, _ = theirs.reset(seed=5)
    obs, _ = drive.reset(seed=5)
    with RoboCasa("NavigateKitchen", cameras=(), action_order="arm_first") as other:
        unseen, _ = other.reset(seed=5)
        for _ in range(3):
            for camera, image in obs.cameras.items():
                np.testing.assert_array_equal(image, raw[f"video.{camera}"])
            for part, value in obs.state.items():
                np.testing.assert_array_equal(value, raw[f"state.{part}"])
                np.testing.assert_array_equal(value, unseen.state[part])
            assert (
                drive.instruction == other.instruction == raw["annotation.human.task_description"]
            )
            raw, reward, *_ = theirs.step(convert_action(arm_first))
            obs, got, *_ = drive.step(Act(MOVE))
            unseen, *_ = other.step(Act(arm_first))
            assert got == reward
    theirs.close()


def test_an_episode_is_its_seeds_with_a_kitchen_and_an_instruction_of_its_own(
    drive: RoboCasa,
) -> None:
    begins = [drive.reset(seed=seed) for seed in (0, 1, 2**32)]
    for part, value in begins[0][0].state.items():
        np.testing.assert_array_equal(value, begins[2][0].state[part])
    assert begins[0][1] == begins[2][1] != begins[1][1]
    assert drive.instruction == "Navigate to the stove."
    drive.looked_at = False
    unseen, *_ = drive.step(Act(MOVE))
    drive.looked_at = True
    assert unseen.cameras == {}


def test_a_reset_frees_the_last_episodes_renderer_at_once(drive: RoboCasa) -> None:
    drive.reset(seed=1)
    last = weakref.ref(drive._env.sim._render_context_offscreen)
    gc.disable()
    try:
        drive.reset(seed=1)
        assert last() is None
    finally:
        gc.enable()


def test_driving_there_solves_it_and_standing_still_does_not() -> None:
    with RoboCasa("NavigateKitchen", cameras=(), max_steps=200) as env:
        solved = play(env, "robocasa/NavigateKitchen", Driver(env), seed=0)
        assert (solved.success_once, solved.ending) == (True, "terminated")
    with RoboCasa("NavigateKitchen", cameras=(), max_steps=60) as env:
        idle = play(env, "robocasa/NavigateKitchen", Always(*STILL), seed=0)
        assert (idle.success_once, idle.episode_return, idle.steps) == (False, 0.0, 60)


def test_the_last_number_opens_and_closes_the_gripper_and_success_is_robocasas_check() -> None:
    with RoboCasa("OpenDrawer", cameras=()) as env:
        obs, info = env.reset(seed=3)
        assert "drawer" in env.instruction
        assert obs.info["sim_state"]["drawer_obj_pos"].shape == (3,)
        # Commands in [0, 1] work like commands in [-1, 1].
        for command, wider in ((1.0, False), (0.0, True)):
            before = obs.gripper
            for _ in range(8):
                obs, reward, done, _, info = env.step(
                    Act(np.array([*STILL[:11], command], np.float32))
                )
            assert (obs.gripper > before) is wider
        assert (reward, done, info["success"]) == (0.0, False, False)
        # Sets the drawer's joint.
        env._env.drawer.open_door(env._env, min=1.0, max=1.0, partial_open=False)
        assert env.step(Act(np.array(STILL, np.float32)))[1:] == (
            1.0,
            True,
            False,
            {"success": True},
        )


@pytest.mark.parametrize(
    ("task", "instruction"),
    [
        ("OpenDrawer", "Open the (left|right) drawer."),
        ("OpenCabinet", "Open the cabinet doors."),
        ("PickPlaceCounterToCabinet", "Pick the .* and place it in the cabinet"),
    ],
)
def test_it_begins_in_the_kitchens_of_either_split(task: str, instruction: str) -> None:
    for split, layouts in (("target", range(1, 11)), ("pretrain", range(11, 61))):
        with RoboCasa(task, cameras=(), split=split) as env:
            _, info = env.reset(seed=4)
            assert re.match(instruction, env.instruction), env.instruction
            assert info["layout"] in layouts
            assert info["style"] in layouts
            assert env.step(Act(np.array(STILL, np.float32)))[1:] == (
                0.0,
                False,
                False,
                {"success": False},
            )
            assert {thing["info"]["split"] for thing in env._env.object_cfgs} <= {split}


def test_the_table_of_tasks_and_the_downloads_are_robocasas(kitchen: object) -> None:
    import robocasa
    from robocasa.scripts.download_kitchen_assets import DOWNLOAD_ASSET_REGISTRY
    from robocasa.utils.dataset_registry import TARGET_TASKS
    from robocasa.utils.dataset_registry_utils import get_task_horizon

    longer = 1.5 if robocasa.__version__ == "1.0.0" else 1  # version 1.0.1 lengthened all horizons
    ours = {
        "atomic_seen": ATOMIC_SEEN,
        "composite_seen": COMPOSITE_SEEN,
        "composite_unseen": COMPOSITE_UNSEEN,
    }
    theirs = {
        name: {task: get_task_horizon(task) * longer for task in tasks}
        for name, tasks in TARGET_TASKS.items()
    }
    assert ours == theirs
    assert set(DOWNLOAD_TYPES.values()) <= set(DOWNLOAD_ASSET_REGISTRY)
    for folder, name in DOWNLOAD_TYPES.items():
        assert (
            f"models/assets/{folder.removesuffix('/stoves')}"
            in DOWNLOAD_ASSET_REGISTRY[name]["folder"]
        )


def test_a_description_states_versions_protocol_and_what_deviates_from_it(drive: RoboCasa) -> None:
    facts = drive.describe()
    assert (facts["task"], facts["robosuite"], facts["control_mode"]) == (
        "NavigateKitchen",
        "1.5.2",
        "OSC_POSE",
    )
    assert (facts["protocol"]["name"], facts["protocol"]["deviations"]) == (
        "RoboCasa365, split target",
        [],
    )
    with RoboCasa("OpenDrawer", cameras=(), object_registries=["lightwheel"], max_steps=5) as env:
        env.reset(seed=0)
        assert env._env.control_freq == CONTROL_HZ
        assert all("/lightwheel/" in thing["info"]["mjcf_path"] for thing in env._env.object_cfgs)
        assert env.describe()["protocol"]["deviations"] == [
            "max_steps: 5, the protocol says 750",
            "object_registries: ['lightwheel'], the protocol says ['objaverse', 'lightwheel']",
        ]


def test_a_camera_that_is_not_there_is_named() -> None:
    with (
        RoboCasa("NavigateKitchen", cameras=("eagle",), width=8, height=8) as env,
        pytest.raises(EnvFailed, match=r"NavigateKitchen failed to reset.*eagle"),
    ):
        env.reset(seed=0)
