"""Tests of robosuite's tasks in LIBERO's Python environment, which contains robosuite 1.4."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator
from importlib.metadata import version

import numpy as np
import pytest
from in_process_episode import Always, play

from vlagents_ray.errors import ConfigError, EnvFailed
from vlagents_ray.interface import Act
from vlagents_ray.testing import check_env
from vlagents_ray_sims.robosuite import Robosuite, _controllers, seeded

STILL = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0)
MOVE = Act(np.array([0.5, -0.5, -0.3, 0, 0, 0.3, 1], np.float32))


@pytest.fixture(scope="module")
def lift() -> Iterator[Robosuite]:
    with Robosuite("Lift", width=32, height=24) as env:
        yield env


@pytest.mark.slow
def test_it_keeps_the_promises_of_an_env() -> None:
    check_env(Robosuite("Lift", width=16, height=16, cameras=("agentview",), max_steps=3), steps=2)


def test_what_it_shows_is_robosuites_own_to_the_bit(lift: Robosuite) -> None:
    import robosuite

    with seeded(0):
        theirs = robosuite.make(
            "Lift",
            robots="Panda",
            controller_configs=_controllers(robosuite),
            control_freq=20,
            camera_names=["agentview", "robot0_eye_in_hand"],
            camera_heights=24,
            camera_widths=32,
        )
    if hasattr(theirs, "rng"):  # robosuite 1.5
        theirs.rng.bit_generator.state = np.random.default_rng(5).bit_generator.state
    with seeded(5):
        raw = theirs.reset()
    obs, _ = lift.reset(seed=5)
    for _ in range(3):
        for camera in ("agentview", "robot0_eye_in_hand"):
            np.testing.assert_array_equal(obs.cameras[camera], raw[f"{camera}_image"][::-1])
        np.testing.assert_array_equal(
            obs.state["robot0_eef_quat"], raw["robot0_eef_quat"].astype(np.float32)
        )
        np.testing.assert_array_equal(obs.info["sim_state"]["cube_pos"], raw["cube_pos"])
        raw, reward, *_ = theirs.step(MOVE.action.astype(np.float64))
        obs, got, *_ = lift.step(MOVE)
        assert got == reward
    theirs.close()


def test_a_reset_frees_the_last_episodes_renderer_at_once(lift: Robosuite) -> None:
    """A renderer that a later garbage collection frees would free buffers of the renderer that is
    in use at that time.
    """
    lift.reset(seed=1)
    last = weakref.ref(lift._env.sim._render_context_offscreen)
    gc.disable()
    try:
        lift.reset(seed=1)
        assert last() is None
    finally:
        gc.enable()


def test_an_episode_is_its_seeds_and_what_nobody_looks_at_is_not_rendered(lift: Robosuite) -> None:
    drawn = np.random.get_state()[1].copy()  # noqa: NPY002
    begins = []
    for seed in (1, 2, 2**32 + 1):
        obs, _ = lift.reset(seed=seed)
        begins.append(obs)
    lift.looked_at = False
    unseen, *_ = lift.step(MOVE)
    lift.looked_at = True
    assert unseen.cameras == {}
    where = [obs.info["sim_state"]["cube_pos"] for obs in begins]
    np.testing.assert_array_equal(where[0], where[2])
    assert not np.array_equal(where[0], where[1])
    np.testing.assert_array_equal(np.random.get_state()[1], drawn)  # noqa: NPY002 - the process's own generator must not change


def test_the_expert_lifts_the_cube_and_doing_nothing_does_not() -> None:
    with Robosuite("Lift", cameras=(), max_steps=80) as env:
        solved = play(
            env, "robosuite/Lift", "vlagents_ray_sims.experts.osc_pose:RobosuiteExpert", seed=0
        )
        assert (solved.success_once, solved.ending) == (True, "terminated")
        idle = play(env, "robosuite/Lift", Always(*STILL), seed=0)
        assert (idle.success_once, idle.episode_return, idle.steps) == (False, 0.0, 80)


def test_a_description_states_versions_protocol_and_what_deviates_from_it(lift: Robosuite) -> None:
    facts = lift.describe()
    assert (facts["task"], facts["robosuite"], facts["control_mode"]) == (
        "Lift",
        version("robosuite"),
        "OSC_POSE",
    )
    assert (facts["protocol"]["name"], facts["protocol"]["deviations"]) == ("robomimic", [])


def test_errors_say_what_is_wanted() -> None:
    if version("robosuite").startswith("1.4"):
        with pytest.raises(
            ConfigError,
            match=r"robosuite 1\.4.* has no such task, but 1\.5 has.*venv create robosuite",
        ):
            Robosuite("ToolHang")
    with pytest.raises(EnvFailed, match=r"Lift failed to make.*eagle"):
        Robosuite("Lift", cameras=("eagle",), width=8, height=8)
