"""The real ManiSkill; each test here renders."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from vlagents_ray.contract import CameraSpec
from vlagents_ray.envs import make_env
from vlagents_ray.envs.maniskill import ManiSkill, simulator
from vlagents_ray.envs.maniskill.simulator import INSTRUCTIONS, instruction_for
from vlagents_ray.errors import ConfigError, EnvFailed, UnknownEnv
from vlagents_ray.interface import Act, Obs
from vlagents_ray.testing import check_env
from vlagents_ray.validation import check_observation

pytestmark = pytest.mark.vulkan

STEP_LIMITS = {
    "PushT-v1": 100,
    "PegInsertionSide-v1": 100,
    "PullCubeTool-v1": 100,
    "RollBall-v1": 80,
    "PlugCharger-v1": 200,
}
TWO_CAMERAS = ("PegInsertionSide-v1", "PlugCharger-v1", "StackCube-v1")
OPEN, CLOSED = 1.0, -1.0


def command(**parts: float) -> Act:
    """Return an action of `pd_ee_delta_pose`, with zeros except for the given parts."""
    names = ("x", "y", "z", "roll", "pitch", "yaw", "gripper")
    return Act(np.array([parts.get(name, 0.0) for name in names], dtype=np.float32))


def play(env: ManiSkill, seed: int, actions: list[np.ndarray]) -> list[Obs]:
    """Return the first observation of the episode and those after the actions."""
    seen = [env.reset(seed=seed)[0]]
    seen += [env.step(Act(action))[0] for action in actions]
    return seen


def assert_same(some: list[Obs], others: list[Obs]) -> None:
    for i, (a, b) in enumerate(zip(some, others, strict=True)):
        for name, image in a.cameras.items():
            np.testing.assert_array_equal(image, b.cameras[name], f"camera {name}, step {i}")
        np.testing.assert_array_equal(a.info["sim_state"], b.info["sim_state"], f"step {i}")


@pytest.fixture(scope="module")
def push() -> Iterator[ManiSkill]:
    with ManiSkill("PushCube-v1", width=64, height=48) as env:
        yield env


@pytest.mark.parametrize("task", ManiSkill.tasks())
def test_each_task_gives_what_its_contract_states(task: str) -> None:
    with make_env(f"maniskill/{task}", width=40, height=32) as env:
        contract = env.contract
        obs, _ = env.reset(seed=3)
        cameras = {"base_camera"} | ({"hand_camera"} if task in TWO_CAMERAS else set())
        assert set(obs.cameras) == set(contract.cameras or {}) == cameras
        assert (env.max_steps, env.instruction) == (STEP_LIMITS.get(task, 50), INSTRUCTIONS[task])
        has_gripper = task != "PushT-v1"  # its robot has a stick instead
        assert (contract.control_hz, contract.action.space, contract.gripper) == (
            20.0,
            "ee_pose",
            has_gripper,
        )
        assert contract.action.dim == (7 if has_gripper else 6)
        action = np.full(contract.action.dim or 0, 0.1, dtype=np.float32)
        for _ in range(3):
            obs, reward, terminated, truncated, info = env.step(Act(action))
            check_observation(obs, contract)
            assert set(obs.state) == set(contract.state or {}) == {"joints", "tquat", "xyzrpy"}
            assert (obs.gripper is not None) is has_gripper
            assert np.isfinite([reward, *obs.info["sim_state"]]).all()
            assert (terminated, truncated, type(info["success"])) == (False, False, bool)


def test_it_keeps_the_promises_of_an_env() -> None:
    check_env(ManiSkill("PickCube-v1", width=32, height=32, max_steps=6), steps=4)


@pytest.mark.parametrize("task", ["PegInsertionSide-v1", "PlugCharger-v1"])
def test_an_episode_does_not_depend_on_what_was_played_before(task: str) -> None:
    """PegInsertionSide draws its geometry for each episode; PlugCharger's contacts survive a reset
    without reconfiguration.
    """
    rng = np.random.default_rng(0)
    actions = [rng.uniform(-1, 1, 7).astype(np.float32) for _ in range(12)]
    with ManiSkill(task, width=16, height=16, cameras=["base_camera"]) as env:
        fresh = play(env, 3, actions)
        play(env, 1, actions[::-1])
        assert_same(play(env, 3, actions), fresh)
    with ManiSkill(task, width=16, height=16, cameras=["base_camera"]) as another:
        play(another, 2, actions[:5])
        assert_same(play(another, 3, actions), fresh)


def test_images_have_the_size_asked_for_and_stand_upright() -> None:
    """The camera looks back at the robot: points closer to the camera, at larger x, are lower in
    the image, and larger y is further right.
    """
    with ManiSkill("PushCube-v1", width=160, height=120) as env:
        assert env.contract.cameras == {"base_camera": CameraSpec(height=120, width=160)}
        columns = []
        for seed in range(4):
            obs, _ = env.reset(seed=seed)
            image = obs.cameras["base_camera"]
            assert image.shape == (120, 160, 3)
            assert image.dtype == np.uint8
            assert image.flags.c_contiguous
            red, green, blue = image.astype(int).transpose(2, 0, 1)
            cube = np.argwhere((blue > red + 40) & (blue > green + 30))
            target = np.argwhere((red > 60) & (red > 2 * green) & (red > 2 * blue))
            assert len(cube) > 5
            assert len(target) > 10
            assert target[:, 0].mean() > cube[:, 0].mean()
            # The cube's y in m, and its column in the image.
            columns.append((obs.info["sim_state"][29], cube[:, 1].mean()))
        columns.sort()
        assert [column for _, column in columns] == sorted(column for _, column in columns)


def test_the_gripper_opens_at_one_and_closes_at_minus_one(push: ManiSkill) -> None:
    push.reset(seed=0)
    for _ in range(10):
        obs, *_ = push.step(command(gripper=CLOSED))
    assert obs.gripper == pytest.approx(0.0, abs=0.02)
    for _ in range(10):
        obs, *_ = push.step(command(gripper=OPEN))
    assert obs.gripper == pytest.approx(1.0, abs=0.02)


def test_translations_are_along_the_bases_axes(push: ManiSkill) -> None:
    for i, name in enumerate("xyz"):
        start = push.reset(seed=0)[0].state["tquat"]
        for _ in range(4):
            obs, *_ = push.step(command(**{name: 0.5}))
        moved = obs.state["tquat"][:3] - start[:3]
        assert moved[i] > 0.03
        assert np.abs(np.delete(moved, i)).max() < 0.01


def test_a_positive_rotation_turns_the_tool_negatively(push: ManiSkill) -> None:
    """ManiSkill scales rotations by their lower bound, -0.1 rad, as `ManiSkill`'s docstring
    explains.
    """
    start = push.reset(seed=0)[0].state["xyzrpy"]
    for _ in range(5):
        obs, *_ = push.step(command(yaw=1.0))
    turned = (obs.state["xyzrpy"][5] - start[5] + np.pi) % (2 * np.pi) - np.pi
    assert -0.3 < turned < -0.1


def test_the_pose_is_in_the_robots_base_frame(push: ManiSkill) -> None:
    obs, _ = push.reset(seed=0)
    in_world = obs.info["sim_state"][18:21]  # the base stands at x = -0.615 m
    np.testing.assert_allclose(
        obs.state["tquat"][:3], in_world + np.array([0.615, 0.0, 0.0]), atol=1e-5
    )
    np.testing.assert_allclose(obs.state["joints"], obs.info["sim_state"][:7], atol=1e-6)


def test_only_the_cameras_asked_for_are_given_and_rendered() -> None:
    with ManiSkill("StackCube-v1", width=32, height=32, cameras=["hand_camera"]) as env:
        assert set(env.reset(seed=0)[0].cameras) == {"hand_camera"}
        assert set(env.step(command())[0].cameras) == {"hand_camera"}
        assert set(env._env.env.scene.sensors) == {"hand_camera"}


def test_other_control_modes_state_themselves() -> None:
    with ManiSkill("PushCube-v1", width=16, height=16, control_mode="pd_joint_delta_pos") as env:
        action = env.contract.action
        assert (action.dim, action.space, action.delta, action.rotation) == (
            8,
            "joint",
            True,
            "none",
        )
        facts = env.describe()
        assert (facts["control_mode"], facts["sim_backend"]) == ("pd_joint_delta_pos", "physx_cpu")
        assert facts["render_backend"] in ("sapien_cpu", "sapien_cuda")


def test_a_robot_without_the_default_control_mode_uses_its_own() -> None:
    with ManiSkill("PickCubeSO100-v1", width=16, height=16) as env:
        assert env.contract.action.space == "joint"
        env.reset(seed=0)
        obs, *_ = env.step(Act(np.zeros(env.contract.action.dim or 0, dtype=np.float32)))
        check_observation(obs, env.contract)


def test_what_is_unknown_is_named_with_what_there_is() -> None:
    with pytest.raises(UnknownEnv, match=r"PushCube-v1.*PushCub-v1"):
        ManiSkill("PushCub-v1")
    with pytest.raises(ConfigError, match=r"no_such_mode.*pd_ee_delta_pose"):
        ManiSkill("PushCube-v1", control_mode="no_such_mode")
    with pytest.raises(
        ConfigError, match=r"expected cameras of .*'base_camera'.*, got \['wrist'\]"
    ):
        ManiSkill("PushCube-v1", cameras=["wrist"])


def test_a_step_limit_of_ones_own_is_kept() -> None:
    with ManiSkill("PushCube-v1", width=16, height=16, max_steps=2) as env:
        env.reset(seed=0)
        assert [env.step(command())[3] for _ in range(2)] == [False, True]
    with pytest.raises(ConfigError, match="max_steps: expected a number of at least 1, got 0"):
        ManiSkill("PushCube-v1", max_steps=0)


@pytest.mark.parametrize(("torch_has_cuda", "backend"), [(True, "gpu"), (False, "cpu")])
def test_the_gpu_renders_where_sapien_and_torch_can_use_it(
    monkeypatch: pytest.MonkeyPatch, torch_has_cuda: bool, backend: str
) -> None:
    monkeypatch.setattr("sapien.Device", lambda _: object())
    monkeypatch.setattr("torch.cuda.is_available", lambda: torch_has_cuda)
    assert simulator.chosen_backend("auto") == backend
    assert simulator.chosen_backend("cpu") == "cpu"


def test_a_task_that_cannot_be_evaluated_is_refused() -> None:
    with pytest.raises(ConfigError, match="expected a task that reports success"):
        ManiSkill("Empty-v1", width=16, height=16)
    with pytest.raises(ConfigError, match="exactly one robot"):
        ManiSkill("TwoRobotPickCube-v1", width=16, height=16)


def test_missing_assets_fail_with_the_command_that_gets_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class Keyboard:
        def readline(self) -> str:
            pytest.fail("the program waited for an answer on stdin")

    from mani_skill.utils.assets import DATA_SOURCES

    monkeypatch.setattr(DATA_SOURCES["ycb"], "output_dir", tmp_path)
    keyboard = Keyboard()
    monkeypatch.setattr("sys.stdin", keyboard)
    with pytest.raises(
        EnvFailed, match=r"ycb.*python -m mani_skill.utils.download_asset PickSingleYCB-v1"
    ):
        ManiSkill("PickSingleYCB-v1", width=16, height=16)
    assert sys.stdin is keyboard


@pytest.mark.parametrize(
    ("task", "words"),
    [("PickSingleYCB-v1", "pick single ycb"), ("OpenCabinetDrawer-v1", "open cabinet drawer")],
)
def test_a_task_without_an_instruction_is_named_in_words(task: str, words: str) -> None:
    assert instruction_for(task) == words


def test_a_read_only_action_is_executed_and_left_alone(push: ManiSkill) -> None:
    push.reset(seed=0)
    action = np.full(7, 0.5, dtype=np.float32)
    action.flags.writeable = False
    push.step(Act(action))
    assert (action == 0.5).all()
