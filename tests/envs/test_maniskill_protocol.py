"""This package's ManiSkill compared with ManiSkill's own evaluation protocol, and the protocol in
the results.
"""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from vlagents_ray.envs.base import SequentialBatch, make_batch
from vlagents_ray.envs.maniskill import ManiSkill, ManiSkillBatch
from vlagents_ray.errors import ConfigError, NotReset
from vlagents_ray.interface import Act
from vlagents_ray.policies.experts import expert_class

pytestmark = pytest.mark.vulkan

SMALL = {"width": 16, "height": 16}
SEEDS = [4, 9]


@pytest.mark.parametrize("task", ["PushCube-v1", "PickCube-v1"])
def test_success_and_return_are_those_of_maniskills_own_wrapper(task: str) -> None:
    """ManiSkill's environment is created as in its guide for CPU simulation, and gets the same
    actions as this package's environment.
    """
    with ManiSkill(task, **SMALL) as env:
        obs, _ = env.reset(seed=5)
        expert = expert_class(f"maniskill/{task}")(f"maniskill/{task}")
        expert.reset(obs, env.instruction)
        actions, rewards, solved, over = [], [], [], False
        while not over:
            actions.append(expert.act(obs).action)
            obs, reward, terminated, over, info = env.step(Act(actions[-1]))
            rewards.append(reward)
            solved.append(info["success"])
            assert not terminated
        modes = {
            name: env.describe()[name]
            for name in ("control_mode", "obs_mode", "sim_backend", "render_backend")
        }
    from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper

    theirs = CPUGymWrapper(
        gymnasium.make(task, reconfiguration_freq=1, sensor_configs=SMALL, **modes),
        ignore_terminations=True,
        record_metrics=True,
    )
    theirs.reset(seed=5)
    for action in actions:
        *_, truncated, info = theirs.step(action)
    theirs.close()
    assert truncated
    episode = info["episode"]
    assert bool(episode["success_once"]) is any(solved) is True
    assert bool(episode["success_at_end"]) is solved[-1]
    assert float(episode["return"]) == pytest.approx(sum(rewards), rel=1e-5)
    assert int(episode["episode_len"]) == len(actions)


def test_the_scene_is_rebuilt_for_each_episode() -> None:
    with ManiSkill("PegInsertionSide-v1", **SMALL, cameras=["base_camera"]) as env:
        scenes, lengths = [], []
        for seed in SEEDS:
            env.reset(seed=seed)
            scenes.append(env._env.env.scene)
            lengths.append(float(env._env.env.peg_half_sizes[0, 0]))
        assert scenes[0] is not scenes[1]
        # lengths of the peg, which are drawn when the scene is built
        assert lengths[0] != lengths[1]


def test_results_say_which_protocol_was_followed_and_what_was_not() -> None:
    with ManiSkill("PushCube-v1", **SMALL) as env:
        protocol = env.describe()["protocol"]
    assert protocol["ignore_terminations"] is True
    assert protocol["reconfiguration_freq"] == 1
    assert protocol["metrics"] == ["success_once", "success_at_end"]
    assert protocol["deviations"] == []
    with ManiSkill("PushCube-v1", **SMALL, reconfigure=False, max_steps=7) as env:
        deviations = env.describe()["protocol"]["deviations"]
    assert len(deviations) == 2
    assert deviations[0].startswith("reconfigure is False")
    assert deviations[1] == "max_steps is 7, the task's limit is 50"


def test_a_batch_of_one_plays_what_a_single_environment_plays() -> None:
    """ManiSkill's physics on the CPU has only one environment, so a larger batch cannot be
    tested.
    """
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 7)).astype(np.float32)
    with (
        ManiSkill("PegInsertionSide-v1", **SMALL) as alone,
        ManiSkillBatch(
            "PegInsertionSide-v1", num_envs=1, sim_backend="physx_cpu", **SMALL
        ) as batch,
    ):
        assert batch.contract == alone.contract
        assert batch.max_steps == alone.max_steps
        with pytest.raises(NotReset):
            batch.step([None])
        for seed in SEEDS:
            expected, [seen] = alone.reset(seed=seed)[0], batch.reset(seeds=[seed])
            assert batch.instructions == [alone.instruction]
            np.testing.assert_array_equal(seen.info["sim_state"], expected.info["sim_state"])
            for action in actions:
                expected, reward, *flags, info = alone.step(Act(action))
                [seen], rewards, *rows, infos = batch.step([Act(action)])
                assert ([reward], [[flag] for flag in flags], [info]) == (rewards, rows, infos)
                np.testing.assert_array_equal(
                    seen.cameras["base_camera"], expected.cameras["base_camera"]
                )
                np.testing.assert_array_equal(seen.info["sim_state"], expected.info["sim_state"])
        assert batch.describe() == alone.describe()


def test_several_environments_share_a_simulator_only_on_a_gpu() -> None:
    with pytest.raises(ConfigError, match="use physx_cuda"):
        ManiSkillBatch("PushCube-v1", num_envs=2, sim_backend="physx_cpu")
    with make_batch("maniskill/PushCube-v1", 2, **SMALL) as batch:
        assert isinstance(batch, SequentialBatch)
        assert len(batch.reset(seeds=SEEDS)) == 2


@pytest.mark.gpu
@pytest.mark.parametrize("task", ["PickCube-v1", "PegInsertionSide-v1"])
def test_on_a_gpu_an_episode_does_not_depend_on_its_neighbours(task: str) -> None:
    with make_batch(f"maniskill/{task}", 4, **SMALL, sim_backend="physx_cuda") as batch:
        assert isinstance(batch, ManiSkillBatch)
        first = batch.reset(seeds=[1, 2, 3, 4])
        base = first[0].cameras["base_camera"].base
        assert base is not None
        assert base.shape == (4, 16, 16, 3)
        other = batch.reset(seeds=[7, 2, 8])
        assert len(other) == 3
        np.testing.assert_allclose(
            other[1].info["sim_state"], first[1].info["sim_state"], atol=1e-5
        )
        assert not np.allclose(other[0].info["sim_state"], first[0].info["sim_state"], atol=1e-3)
        action = Act(np.zeros(7, np.float32))
        seen, rewards, terminated, truncated, infos = batch.step([action, None, action])
        assert [len(rows) for rows in (seen, rewards, terminated, truncated, infos)] == [3] * 5
        assert not any(terminated + truncated)
