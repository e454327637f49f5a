"""Tests of ALOHA and its protocol, rendered through EGL: images, episodes and success."""

from __future__ import annotations

import numpy as np
import pytest
from in_process_episode import Always, play

from vlagents_ray.contract import CameraSpec
from vlagents_ray.envs.base import known_contract, make_env
from vlagents_ray.errors import (
    ConfigError,
    ContractMismatch,
    InvalidObservation,
    NotReset,
    UnknownEnv,
)
from vlagents_ray.interface import Act, Obs
from vlagents_ray.testing import check_env
from vlagents_ray_sims.aloha import Aloha
from vlagents_ray_sims.experts.aloha import AlohaExpert

gym_aloha = pytest.importorskip("gym_aloha.env")
pytestmark = [pytest.mark.sim, pytest.mark.integration]

FIRST = (0.0, -0.96, 1.16, 0.0, -0.3, 0.0, 0.1)  # the pose in which both arms begin
STILL = Act(np.array(FIRST * 2, np.float32))
PARTS = ["left/joints", "left/gripper", "right/joints", "right/gripper"]


def test_it_keeps_the_promises_of_an_env() -> None:
    check_env(Aloha("insertion", width=32, height=32, max_steps=6), steps=4)


@pytest.mark.parametrize("task", ["transfer_cube", "insertion"])
def test_the_expert_solves_the_task_and_staying_put_does_not(task: str) -> None:
    with Aloha(task, cameras=()) as env:  # rendering would take most of the time
        for seed in (0, 1000):
            solved = play(
                env, f"aloha/{task}", "vlagents_ray_sims.experts.aloha:AlohaExpert", seed=seed
            )
            assert (solved.success_once, solved.ending) == (True, "terminated")
            assert solved.steps <= 400
        idle = play(env, f"aloha/{task}", Always(*FIRST, *FIRST), seed=0)
        assert (idle.success_once, idle.episode_return, idle.steps) == (False, 0.0, 400)


def test_observations_rewards_and_actions_are_gym_alohas_to_the_bit() -> None:
    theirs = gym_aloha.AlohaEnv("transfer_cube", obs_type="pixels_agent_pos")
    with Aloha() as ours:
        expected, _ = theirs.reset(seed=7)
        obs, _ = ours.reset(seed=7)
        beyond = STILL.action.copy()
        beyond[2] = 1.5  # outside gym-aloha's action space, like the elbow's first angle
        for _ in range(3):
            np.testing.assert_array_equal(obs.cameras["top"], expected["pixels"]["top"])
            joined = np.concatenate([obs.state[part] for part in PARTS])
            np.testing.assert_array_equal(joined, expected["agent_pos"].astype(np.float32))
            expected, reward, *_ = theirs.step(beyond.astype(np.float64))
            obs, got, *_ = ours.step(Act(beyond))
            assert got == reward
    theirs._env.physics.free()


def test_the_contract_is_known_before_the_simulator_is_made() -> None:
    with Aloha("insertion", width=40, height=32, cameras=("top", "angle")) as env:
        assert (
            known_contract(
                "aloha/insertion", {"width": 40, "height": 32, "cameras": ["top", "angle"]}
            )
            == env.contract
        )
        assert env.contract.cameras == {"top": CameraSpec(32, 40), "angle": CameraSpec(32, 40)}
        obs, _ = env.reset(seed=0)
        assert obs.cameras["angle"].shape == (32, 40, 3)
        assert env.instruction == "insert the peg into the socket"
        assert env.describe()["protocol"]["deviations"] == []


def test_a_deviation_from_the_protocol_is_recorded() -> None:
    with Aloha(width=16, height=16, max_steps=300, ends_on_success=False) as env:
        assert env.describe()["protocol"]["deviations"] == [
            "max_steps: 300, the protocol says 400",
            "ends_on_success: False, the protocol says True",
        ]


def test_a_wrong_option_is_named() -> None:
    with pytest.raises(ConfigError, match=r"expected cameras of .*'top'.*, got \['wrist'\]"):
        make_env("aloha", cameras=("wrist",))
    with pytest.raises(UnknownEnv, match="did you mean 'insertion'"):
        make_env("aloha/insert")


def test_the_expert_says_what_it_wants() -> None:
    expert = AlohaExpert("aloha/insertion")
    with pytest.raises(InvalidObservation, match=r"expected shape \(14,\)"):
        expert.reset(Obs(info={"sim_state": np.zeros(7)}), "")
    with pytest.raises(NotReset):
        expert.act(Obs())
    with pytest.raises(ContractMismatch, match="aloha/transfer_cube"):
        AlohaExpert("aloha/pour")
