"""LIBERO's environment is evaluated in as its literature does: seen in the simulator, not in the settings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from libero_episodes import STILL, begin, play, world

from vlagents_ray.envs.libero import Libero
from vlagents_ray.interface import Act

pytestmark = pytest.mark.assets("libero")


@pytest.mark.slow
def test_what_it_shows_is_what_peers_see_to_the_bit(bowl: Libero) -> None:
    """The loop of openpi's and OpenVLA's evaluation, on LIBERO's own class with all its rendering."""
    from libero.libero.envs import OffScreenRenderEnv

    ours = play(bowl, state=3)
    theirs = OffScreenRenderEnv(bddl_file_name=str(bowl._task.problem), camera_heights=64, camera_widths=64)
    before = np.random.get_state()  # noqa: NPY002
    theirs.seed(7)
    theirs.reset()
    raw = theirs.set_init_state(bowl._states[3])
    for _ in range(10):
        raw, *_ = theirs.step([0, 0, 0, 0, 0, 0, -1])
    np.random.set_state(before)  # noqa: NPY002
    for i, obs in enumerate(ours):
        np.testing.assert_array_equal(obs.cameras["front"], raw["agentview_image"][::-1, ::-1])
        np.testing.assert_array_equal(obs.cameras["wrist"], raw["robot0_eye_in_hand_image"][::-1, ::-1])
        np.testing.assert_array_equal(obs.state["gripper_qpos"], raw["robot0_gripper_qpos"].astype(np.float32))
        np.testing.assert_array_equal(obs.state["xyz_axis_angle"][:3], raw["robot0_eef_pos"].astype(np.float32))
        raw, *_ = theirs.step([0.5, -0.5, np.float32(0.2 * i), 0, 0, np.float32(0.3), (-1) ** i])
    theirs.close()


def test_an_episode_begins_with_a_reset_and_then_the_files_state(bowl: Libero, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_each_reset_seeds_what_the_state_leaves_open(bowl: Libero, monkeypatch: pytest.MonkeyPatch) -> None:
    def cabinet() -> np.ndarray:
        domain = world(bowl)._env.env
        return np.array(domain.object_states_dict["wooden_cabinet_1"].get_geom_state()["pos"])

    np.random.seed(3)  # noqa: NPY002
    undisturbed = np.random.random()  # noqa: NPY002
    np.random.seed(3)  # noqa: NPY002
    begin(bowl, state=0)
    assert np.random.random() == undisturbed  # noqa: NPY002 - the process's own generator is nobody else's
    stood = cabinet()
    begin(bowl, state=1)
    np.testing.assert_array_equal(cabinet(), stood)
    monkeypatch.setattr(world(bowl), "_protocol", replace(bowl._rules, simulator_seed=8))
    begin(bowl, state=0)
    assert not np.array_equal(cabinet(), stood)


def test_images_are_upright_and_mirrored(bowl: Libero) -> None:
    """The robot stands behind the table, above; the plate is at y = 0.2 m, to the right of who looks at the robot."""
    obs = begin(bowl)
    image = obs.cameras["front"].astype(int)
    reddish = image[..., 0] - image[..., 2]
    assert reddish[-8:].mean() > 20  # the wooden table, below
    assert reddish[:8].mean() < 10  # the grey wall
    white = np.argwhere(image[40:].min(axis=2) > 200)
    assert white[:, 1].mean() < 24  # the plate, on the left
    assert obs.info["sim_state"]["positions"]["plate_1"][1] > 0.15
    wrist = obs.cameras["wrist"].astype(int)
    assert wrist[-8:].mean() < 80 < wrist[:32].mean()  # the dark hand below, from where the fingers reach up


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
        assert 0.03 < moved[axis] < 0.25  # 0.05 m a unit commanded, with a lag
        assert np.abs(np.delete(moved, axis)).max() < 0.03
