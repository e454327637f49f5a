"""Tests of SIMPLER's Bridge environments with their simulator; no package contains the assets."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vlagents_ray.contract import CameraSpec
from vlagents_ray.envs import make_env
from vlagents_ray.errors import ConfigError, EnvFailed
from vlagents_ray.interface import Act, Obs
from vlagents_ray.testing import check_env
from vlagents_ray.validation import check_observation
from vlagents_ray_sims.experts.simpler import SimplerExpert
from vlagents_ray_sims.simpler import Simpler

pytestmark = [pytest.mark.vulkan, pytest.mark.assets("simpler")]

CAMERA = "3rd_view_camera"
CARROT = "PutCarrotOnPlateInScene-v1"
EGGPLANT = "PutEggplantInBasketScene-v1"
PROTOCOL = {  # for each task: instruction, number of configurations, step limit
    CARROT: ("put carrot on plate", 24, 60),
    EGGPLANT: ("put eggplant into yellow basket", 64, 120),
    "PutSpoonOnTableClothInScene-v1": ("put the spoon on the towel", 24, 60),
    "StackGreenCubeOnYellowCubeBakedTexInScene-v1": (
        "stack the green block on the yellow block",
        24,
        60,
    ),
}


def command(**parts: float) -> Act:
    """Return an action with these values; the others are 0, and the gripper is open."""
    names = ("x", "y", "z", "roll", "pitch", "yaw", "gripper")
    return Act(np.array([parts.get(name, float(name == "gripper")) for name in names], np.float32))


def begin(env: Simpler, state: int, seed: int = 0) -> Obs:
    return env.reset(seed=seed, options={"init_state": state})[0]


@pytest.fixture(scope="module")
def carrot() -> Iterator[Simpler]:
    with Simpler(CARROT) as env:
        yield env


@pytest.mark.parametrize("task", Simpler.tasks())
def test_each_task_keeps_to_simplers_constants(task: str) -> None:
    with make_env(f"simpler/{task}") as env:
        obs, info = env.reset(seed=3)
        check_observation(obs, env.contract)
        assert (env.instruction, env.init_states, env.max_steps) == PROTOCOL[task]
        assert info["init_state"] == 3
        assert env.contract.cameras == {CAMERA: CameraSpec(480, 640)}
        assert env.contract.control_hz == 5.0
        action = env.contract.action
        assert (action.dim, action.space, action.delta, action.frame) == (
            7,
            "ee_pose",
            True,
            "base",
        )
        assert (action.gripper_open, action.gripper_closed) == (1.0, 0.0)
        facts = env.describe()
        assert facts["control_mode"] == "arm_pd_ee_target_delta_pose_align2_gripper_pd_joint_pos"
        assert facts["shaders"] == {CAMERA: "default"}
        assert facts["success"].startswith("the object lies")
        assert facts["protocol"]["setting"] == "visual matching"
        assert facts["protocol"]["success"] == "at the end"
        assert facts["protocol"]["deviations"] == []


def test_it_keeps_the_promises_of_an_env() -> None:
    check_env(Simpler(CARROT, max_steps=4), steps=3)


def test_an_initial_state_is_a_configuration_of_the_tasks_own_list(carrot: Simpler) -> None:
    twin = carrot._env.env
    for state in (0, 5, 23):
        begin(carrot, state)
        where, turned = divmod(state, len(twin.quat_configs))
        for i, name in enumerate((twin.source_obj_name, twin.target_obj_name)):
            pose = twin.objs[name].pose
            # The object has settled on the table since its pose was set.
            np.testing.assert_allclose(pose.p[0, :2], twin.xyz_configs[where, i, :2], atol=0.005)
            assert abs(float((pose.q[0] * twin.quat_configs[turned, i]).sum())) > 0.99


def test_the_state_alone_decides_where_an_episode_begins(carrot: Simpler) -> None:
    first, other = begin(carrot, 7, seed=0), begin(carrot, 8, seed=0)
    again = begin(carrot, 7, seed=99)
    np.testing.assert_array_equal(first.cameras[CAMERA], again.cameras[CAMERA])
    np.testing.assert_array_equal(first.info["sim_state"], again.info["sim_state"])
    assert not np.array_equal(first.cameras[CAMERA], other.cameras[CAMERA])
    by_seed, info = carrot.reset(seed=24 + 7)
    assert info["init_state"] == 7
    np.testing.assert_array_equal(first.cameras[CAMERA], by_seed.cameras[CAMERA])


def test_images_stand_upright(carrot: Simpler) -> None:
    """The camera looks from the robot over the table, so larger x is higher in the image, and
    larger y is further left.
    """
    places = []
    for state in (0, 6, 12, 18):
        obs = begin(carrot, state)
        red, green, blue = obs.cameras[CAMERA].astype(int).transpose(2, 0, 1)
        orange = np.argwhere((red > 200) & (green > 90) & (green < 170) & (blue < 60))
        assert len(orange) > 100
        row, column = np.median(orange, axis=0)
        places.append((*obs.info["sim_state"][:2], 1.0, row, column))
    where, seen = np.hsplit(np.array(places), [3])
    pixels_a_metre = np.linalg.lstsq(where, seen, rcond=None)[0]
    assert pixels_a_metre[0, 0] < -300  # the row decreases with x
    assert pixels_a_metre[1, 1] < -300  # the column decreases with y


def test_the_gripper_opens_at_one_and_closes_at_zero(carrot: Simpler) -> None:
    assert begin(carrot, 0).gripper == 1.0
    for value, opening in ((0.0, 0.0), (0.4, 0.0), (0.6, 1.0)):  # the gripper is binarised at 0.5
        for _ in range(4):
            obs, *_ = carrot.step(command(gripper=value))
        assert obs.gripper == pytest.approx(opening, abs=0.02)


def test_translations_are_metres_along_the_bases_axes(carrot: Simpler) -> None:
    for i, name in enumerate("xyz"):
        start = begin(carrot, 0).state["tquat"]
        for _ in range(3):
            carrot.step(command(**{name: 0.02}))
        obs, *_ = carrot.step(command())  # the arm catches up with its commands
        moved = obs.state["tquat"][:3] - start[:3]
        assert moved[i] == pytest.approx(0.06, abs=0.01)
        assert np.abs(np.delete(moved, i)).max() < 0.01


def test_rotations_are_radians_about_the_bases_axes(carrot: Simpler) -> None:
    for i, name in enumerate(("roll", "pitch", "yaw")):
        start = Rotation.from_quat(begin(carrot, 0).state["tquat"][3:])
        for _ in range(3):
            carrot.step(command(**{name: 0.1}))
        obs, *_ = carrot.step(command())
        turned = (Rotation.from_quat(obs.state["tquat"][3:]) * start.inv()).as_rotvec()
        assert turned[i] == pytest.approx(0.3, abs=0.1)
        assert np.abs(np.delete(turned, i)).max() < 0.1


@pytest.mark.slow
def test_the_expert_succeeds_and_doing_nothing_does_not(carrot: Simpler) -> None:
    expert = SimplerExpert(f"simpler/{CARROT}")
    for solved in (True, False):
        obs, over = begin(carrot, 3), False
        expert.reset(obs, carrot.instruction)
        while not over:
            obs, _, terminated, over, info = carrot.step(expert.act(obs) if solved else command())
            assert not terminated
        assert info["success"] is solved


@pytest.mark.slow
def test_two_twins_in_one_process_keep_their_own_pictures(carrot: Simpler) -> None:
    alone = begin(carrot, 2).cameras[CAMERA]
    with Simpler(EGGPLANT) as sink:
        in_sink = begin(sink, 0).cameras[CAMERA]
        np.testing.assert_array_equal(begin(carrot, 2).cameras[CAMERA], alone)
        np.testing.assert_array_equal(begin(sink, 0).cameras[CAMERA], in_sink)
    np.testing.assert_array_equal(begin(carrot, 2).cameras[CAMERA], alone)


def test_what_deviates_from_the_protocol_is_said() -> None:
    with Simpler(CARROT, max_steps=3, shader="minimal") as env:
        assert env.describe()["protocol"]["deviations"] == [
            "max_steps is 3, not 60",
            "shader is minimal, not default",
        ]


def test_missing_assets_are_named_with_the_commands_that_get_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    commands = (
        r"download_asset bridge_v2_real2sim && python -m mani_skill.utils.download_asset widowx250s"
    )
    with pytest.raises(ConfigError, match="MS_ASSET_DIR before it starts"):
        Simpler(CARROT, assets=str(tmp_path))
    monkeypatch.setattr("mani_skill.ASSET_DIR", tmp_path / "data")
    with pytest.raises(EnvFailed, match=commands):
        Simpler(CARROT, assets=str(tmp_path))
    assert Simpler.missing() is None
    monkeypatch.setenv("MS_ASSET_DIR", str(tmp_path))
    assert commands.partition(" && ")[0] in str(Simpler.missing())
