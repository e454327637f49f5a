"""Tests that LIBERO's environment and its protocol agree with the literature, the simulator and its
files.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from libero_episodes import STILL, begin, fingerprint, play, world
from unseen_images import require_same_without_unseen_images

from vlagents_ray.contract import CameraSpec
from vlagents_ray.envs.base import known_contract
from vlagents_ray.errors import UnknownEnv
from vlagents_ray.interface import Act
from vlagents_ray.testing import check_env
from vlagents_ray_sims.libero import SUITES, Libero, axis_angle, find_task, read_states


@pytest.mark.slow
def test_it_keeps_the_promises_of_an_env() -> None:
    check_env(Libero("libero_object/1", width=32, height=32, max_steps=4), steps=3)


def test_an_initial_state_gives_one_episode_whatever_was_played_and_whatever_the_seed(
    soup: Libero,
) -> None:
    first = fingerprint(play(soup, state=5))
    play(soup, state=6)
    begin(soup, state=5, seed=1234)
    assert fingerprint(play(soup, state=5)) == first
    assert fingerprint(play(soup, state=6)) != first


def test_two_envs_of_one_process_do_not_disturb_each_other(bowl: Libero, soup: Libero) -> None:
    alone = fingerprint(play(bowl))
    begin(soup)
    assert fingerprint(play(bowl, between=lambda: soup.step(STILL))) == alone
    begin(bowl)
    begin(soup)
    assert fingerprint(play(bowl)) == alone


def test_doing_nothing_solves_no_task_and_ends_at_the_limit(
    soup: Libero, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert soup.max_steps == 280
    monkeypatch.setattr(soup, "max_steps", 20)
    begin(soup)
    ended = [soup.step(STILL)[1:] for _ in range(20)]
    assert {(reward, terminated, info["success"]) for reward, terminated, _, info in ended} == {
        (0.0, False, False)
    }
    assert [truncated for _, _, truncated, _ in ended] == [False] * 19 + [True]


_CHILD = """
from libero_episodes import Libero, fingerprint, play
with Libero("libero_object/0", width=32, height=32) as env:
    print(fingerprint(play(env, 2)))
"""


@pytest.mark.slow
def test_another_process_plays_the_same_episode_and_leaves_the_home_alone(
    soup: Libero, tmp_path: Path
) -> None:
    """The other process has no GPU, like a Ray worker, and a home folder in which LIBERO was never
    used.
    """
    support = Path(__file__).parents[2] / "support"
    variables = {"HOME": str(tmp_path), "PYTHONHASHSEED": "5", "CUDA_VISIBLE_DEVICES": ""}
    child = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", _CHILD],
        env={**os.environ, **variables, "PYTHONPATH": os.pathsep.join([str(support), *sys.path])},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
    )
    assert child.returncode == 0, child.stderr
    assert child.stdout.split()[-1] == fingerprint(play(soup, 2))
    assert not (tmp_path / ".libero").exists()


def test_tasks_go_by_number_and_by_name() -> None:
    by_number = find_task("libero_object/7")
    assert find_task(f"libero_object/{by_number.name}") == by_number
    assert by_number.language == by_number.name.replace("_", " ")
    # The instruction omits "KITCHEN_SCENE10" of the task's name.
    assert find_task("libero_90/0").language == "close the top drawer of the cabinet"
    for suite, known in SUITES.items():
        with pytest.raises(
            UnknownEnv, match=f"expected a task from 0 to {known.tasks - 1}.*{known.tasks}"
        ):
            find_task(f"{suite}/{known.tasks}")


def test_a_description_states_task_versions_and_protocol(bowl: Libero) -> None:
    facts = bowl.describe()
    assert facts["task"] == "libero_spatial/0"
    assert facts["name"] == facts["language"].replace(" ", "_")
    assert bowl.instruction == facts["language"]
    assert (facts["hf-libero"], facts["robosuite"], facts["render_backend"]) == (
        "0.1.4",
        "1.4.0",
        "egl",
    )
    assert facts["protocol"]["deviations"] == ["image_size: (64, 64), the protocol says (256, 256)"]
    assert facts["protocol"]["max_steps"] == bowl.max_steps == 220
    assert bowl.contract.cameras == {"front": CameraSpec(64, 64), "wrist": CameraSpec(64, 64)}
    assert bowl.contract == known_contract("libero/libero_spatial/0", {"width": 64, "height": 64})


def test_images_that_nobody_looks_at_are_not_rendered_and_change_nothing(
    soup: Libero, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(soup, "max_steps", 9)
    require_same_without_unseen_images(soup)


@pytest.mark.parametrize(
    "suite", ["libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90"]
)
def test_each_suite_has_fifty_initial_states_a_task(suite: str) -> None:
    states = read_states(find_task(f"{suite}/3").states)
    assert states.shape[0] == 50
    assert states.dtype == np.float64
    assert np.isfinite(states).all()


def test_a_file_of_states_that_would_run_code_does_not(tmp_path: Path) -> None:
    import torch

    class Trap:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return Path.touch, (tmp_path / "ran",)  # type: ignore[return-value]

    torch.save(Trap(), tmp_path / "states")
    with pytest.raises(pickle.UnpicklingError, match="Weights only"):
        read_states(tmp_path / "states")
    assert not (tmp_path / "ran").exists()


def test_axis_angles_are_robosuites_for_both_signs_of_a_quaternion() -> None:
    find_task("libero_spatial/0")  # imports LIBERO
    from robosuite.utils.transform_utils import quat2axisangle

    drawn = np.random.default_rng(0).normal(size=(20, 4))
    for quaternion in drawn / np.linalg.norm(drawn, axis=1, keepdims=True):
        for signed in (quaternion, -quaternion):
            np.testing.assert_allclose(
                axis_angle(signed), quat2axisangle(signed.copy()), atol=1e-12
            )
    np.testing.assert_array_equal(axis_angle(np.array([0.0, 0.0, 0.0, 1.0])), np.zeros(3))


@pytest.mark.slow
def test_what_it_shows_is_what_peers_see_to_the_bit(bowl: Libero) -> None:
    """The reference is the loop of openpi's and OpenVLA's evaluation, with LIBERO's own class,
    which renders every image.
    """
    from libero.libero.envs import OffScreenRenderEnv

    ours = play(bowl, state=3)
    theirs = OffScreenRenderEnv(
        bddl_file_name=str(bowl._task.problem), camera_heights=64, camera_widths=64
    )
    before = np.random.get_state()  # noqa: NPY002
    theirs.seed(7)
    theirs.reset()
    raw = theirs.set_init_state(bowl._states[3])
    for _ in range(10):
        raw, *_ = theirs.step([0, 0, 0, 0, 0, 0, -1])
    np.random.set_state(before)  # noqa: NPY002
    for i, obs in enumerate(ours):
        np.testing.assert_array_equal(obs.cameras["front"], raw["agentview_image"][::-1, ::-1])
        np.testing.assert_array_equal(
            obs.cameras["wrist"], raw["robot0_eye_in_hand_image"][::-1, ::-1]
        )
        np.testing.assert_array_equal(
            obs.state["gripper_qpos"], raw["robot0_gripper_qpos"].astype(np.float32)
        )
        np.testing.assert_array_equal(
            obs.state["xyz_axis_angle"][:3], raw["robot0_eef_pos"].astype(np.float32)
        )
        raw, *_ = theirs.step([0.5, -0.5, np.float32(0.2 * i), 0, 0, np.float32(0.3), (-1) ** i])
    theirs.close()


def test_an_episode_begins_with_a_reset_and_then_the_files_state(
    bowl: Libero, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []
    states: list[np.ndarray] = []
    simulator = world(bowl)._env

    def spy(owner: object, name: str) -> None:
        real = getattr(owner, name)

        def noted(*args: object) -> object:
            calls.append(name)
            result = real(*args)
            states.append(np.array(world(bowl)._env.get_sim_state()))
            return result

        monkeypatch.setattr(owner, name, noted)

    spy(simulator.env, "reset")
    spy(simulator, "set_init_state")
    spy(simulator, "step")
    begin(bowl, state=7)
    assert calls == ["reset", "set_init_state", *["step"] * 10]
    np.testing.assert_array_equal(states[1], bowl._states[7])
    assert bowl.init_states == 50


def test_each_reset_seeds_what_the_state_leaves_open(
    bowl: Libero, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cabinet() -> np.ndarray:
        domain = world(bowl)._env.env
        return np.array(domain.object_states_dict["wooden_cabinet_1"].get_geom_state()["pos"])

    np.random.seed(3)  # noqa: NPY002
    undisturbed = np.random.random()  # noqa: NPY002
    np.random.seed(3)  # noqa: NPY002
    begin(bowl, state=0)
    assert np.random.random() == undisturbed  # noqa: NPY002 - the process's own generator must not change
    stood = cabinet()
    begin(bowl, state=1)
    np.testing.assert_array_equal(cabinet(), stood)
    monkeypatch.setattr(world(bowl), "_protocol", replace(bowl._rules, simulator_seed=8))
    begin(bowl, state=0)
    assert not np.array_equal(cabinet(), stood)


def test_images_are_upright_and_mirrored(bowl: Libero) -> None:
    """In the image the robot is at the top, behind the table. The cabinet is at y = -0.27 m, on the
    right of the image.
    """
    obs = begin(bowl)
    image = obs.cameras["front"].astype(int)
    reddish = image[..., 0] - image[..., 2]
    assert reddish[-8:].mean() > 20  # the wooden table, at the bottom
    assert reddish[:8].mean() < 10  # the grey wall, at the top
    dark = np.argwhere(image[30:].max(axis=2) < 60)
    assert dark[:, 1].mean() > 44  # the cabinet, on the right
    assert obs.info["sim_state"]["positions"]["wooden_cabinet_1"][1] < -0.2
    wrist = obs.cameras["wrist"].astype(int)
    # The dark hand is at the bottom of the image, with its fingers pointing up.
    assert wrist[-8:].mean() < 80 < wrist[:32].mean()


def test_the_gripper_opens_at_minus_one_and_closes_at_one(soup: Libero) -> None:
    opened = begin(soup)
    for _ in range(12):
        closed, *_ = soup.step(Act(np.array([0, 0, 0, 0, 0, 0, 1], np.float32)))
    assert opened.gripper is not None
    assert closed.gripper is not None
    assert opened.gripper > 0.9
    assert closed.gripper < 0.1
    np.testing.assert_allclose(opened.state["gripper_qpos"], [0.04, -0.04], atol=0.002)
    np.testing.assert_allclose(closed.state["gripper_qpos"], [0, 0], atol=0.004)
    assert (soup.contract.action.gripper_open, soup.contract.action.gripper_closed) == (-1.0, 1.0)


def test_a_command_moves_the_hand_along_its_axis(soup: Libero) -> None:
    for axis in range(3):
        start = begin(soup).state["xyz_axis_angle"][:3]
        action = STILL.action.copy()
        action[axis] = 1.0
        for _ in range(5):
            obs, *_ = soup.step(Act(action))
        moved = obs.state["xyz_axis_angle"][:3] - start
        assert 0.03 < moved[axis] < 0.25  # the commands add up to 0.25 m, and the hand lags behind
        assert np.abs(np.delete(moved, axis)).max() < 0.03
