"""Our environments as Gymnasium's vector envs, of which Stable-Baselines3's PPO learns as it is."""

from __future__ import annotations

import itertools
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from eval_fakes import LINE, Line
from gymnasium.utils import env_checker
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from vlagents_ray.contract import CameraSpec, Contract
from vlagents_ray.envs.base import SequentialBatch
from vlagents_ray.errors import (
    ConfigError,
    EnvFailed,
    InvalidAction,
    InvalidInput,
    MissingDependency,
    NotReset,
)
from vlagents_ray.interface import Act, Obs
from vlagents_ray.registry import pip_install
from vlagents_ray_learn import as_vector_env
from vlagents_ray_learn.vector_env import BatchVectorEnv, observation_space

TABLETOP: dict[str, Any] = {"env_options": {"width": 32, "height": 32, "max_steps": 6}}


class Ending(Line):
    """Ends with success, so that episodes have several lengths."""

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        obs, reward, _, truncated, info = super().step(act)
        return obs, reward, info["success"], truncated, info


class Single(gymnasium.Env[Any, Any]):
    """One of our environments as an `Env` of Gymnasium, for its own vector env and its own
    checker.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - as Gymnasium has it

    def __init__(self, venv: BatchVectorEnv) -> None:
        self._venv = venv
        self.observation_space, self.action_space = (
            venv.single_observation_space,
            venv.single_action_space,
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        obs, infos = self._venv.reset(seed=seed, options=options)
        return first(obs), first(infos)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        obs, rewards, terminated, truncated, infos = self._venv.step(action[np.newaxis])
        return first(obs), float(rewards[0]), bool(terminated[0]), bool(truncated[0]), first(infos)


def first(rows: Any) -> Any:
    """Row 0 of nested arrays, without the masks of infos."""
    if isinstance(rows, Mapping):
        return {name: first(value) for name, value in rows.items() if not name.startswith("_")}
    return rows[0]


class Numbered(gymnasium.Env[Any, Any]):
    """An `Env` that begins a numbered episode where it is given no seed, with the numbers that
    ours has.
    """

    def __init__(self, env: Line, numbers: Iterator[int]) -> None:
        self._env, self._numbers = env, numbers
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
        self.action_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        seed = next(self._numbers) if seed is None else seed
        obs, _ = self._env.reset(seed=seed, options=options)
        return obs.state["position"], {"instruction": self._env.instruction, "episode_seed": seed}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self._env.step(Act(action))
        return obs.state["position"], reward, terminated, truncated and not terminated, info


def of(
    env: type[Line], number: int, mode: AutoresetMode = AutoresetMode.SAME_STEP
) -> BatchVectorEnv:
    return BatchVectorEnv(SequentialBatch([env() for _ in range(number)]), "state", mode)


def same(one: Any, other: Any) -> None:
    """Compare nested arrays, dtypes included."""
    if isinstance(one, Mapping):
        assert one.keys() == other.keys()
        for name, value in one.items():
            same(value, other[name])
    elif isinstance(one, tuple) or (isinstance(one, np.ndarray) and one.dtype == object):
        for mine, theirs in zip(one, other, strict=True):
            same(mine, theirs)
    else:
        np.testing.assert_array_equal(one, other)
        assert np.asarray(one).dtype == np.asarray(other).dtype


@pytest.mark.program("Gymnasium's checkers")
@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_it_does_what_gymnasiums_own_vector_env_does(mode: AutoresetMode) -> None:
    ours, numbers = of(Ending, 3, mode), itertools.count(8)
    theirs = SyncVectorEnv([lambda: Numbered(Ending(), numbers)] * 3, autoreset_mode=mode)
    same(ours.reset(seed=5), theirs.reset(seed=5))
    rng, ends = np.random.default_rng(0), 0
    for _ in range(60):
        actions = rng.uniform(-2, 0.5, (3, 1)).astype(np.float32)
        got, want = ours.step(actions), theirs.step(actions)
        same(got, want)
        ends += int((got[2] | got[3]).sum())
    assert ends > 10, "or the test shows nothing"


def test_without_autoreset_those_that_are_over_are_reset_by_their_mask() -> None:
    venv = of(Line, 3, AutoresetMode.DISABLED)
    venv.reset(seed=0)
    for _ in range(10):
        _, _, _, truncated, _ = venv.step(np.zeros((3, 1)))
    assert truncated.all()
    with pytest.raises(NotReset, match=r"environments \[0, 1, 2\] are over"):
        venv.step(np.zeros((3, 1)))
    _, infos = venv.reset(options={"reset_mask": np.array([True, False, True])})
    assert infos["episode_seed"].tolist() == [3, 0, 4]
    assert infos["_episode_seed"].tolist() == [True, False, True]
    with pytest.raises(NotReset, match=r"environments \[1\] are over"):
        venv.step(np.zeros((3, 1)))


@pytest.mark.program("Gymnasium's checkers")
@pytest.mark.parametrize("observation", ["all", "state"])
# Positions have no bounds.
@pytest.mark.filterwarnings("ignore:.*A Box observation space m.*imum value is:UserWarning")
# As there are none.
@pytest.mark.filterwarnings("ignore:.*Not able to test alternative render modes:UserWarning")
def test_it_passes_gymnasiums_checkers(observation: Any) -> None:
    with as_vector_env_of_tabletop(1, observation) as venv:
        env_checker.check_env(Single(venv))
        # Of one environment: it asks whether the array is true.
        env_checker.check_returned_data_not_reused(venv)
    with as_vector_env_of_tabletop(3, observation) as venv:
        env_checker.check_reset_seed_determinism(venv)
        env_checker.check_reset_options(venv)
        env_checker.check_seed_deprecation(venv)
        env_checker.check_reset_return_info_deprecation(venv)
        env_checker.check_reset_return_type(venv)
        for _ in range(20):
            obs, rewards, terminated, truncated, infos = venv.step(venv.action_space.sample())
            assert obs in venv.observation_space
            assert [part.shape for part in (rewards, terminated, truncated)] == [(3,)] * 3
            assert (
                infos.get("final_obs") is None
                or infos["final_obs"][0] in venv.single_observation_space
            )


class as_vector_env_of_tabletop:  # noqa: N801 - a context manager
    """`as_vector_env` of a tabletop with small images, closed at the end."""

    def __init__(self, num_envs: int, observation: Any) -> None:
        self._venv = as_vector_env("tabletop", num_envs, observation=observation, **TABLETOP)

    def __enter__(self) -> BatchVectorEnv:
        return self._venv

    def __exit__(self, *_: object) -> None:
        self._venv.close()


@pytest.mark.program("Gymnasium's checkers")
def test_a_list_of_seeds_is_one_for_each_environment_and_later_episodes_go_on_after_them() -> None:
    with as_vector_env_of_tabletop(3, "all") as venv:
        several, infos = venv.reset(seed=[107, 4, 100])
        assert infos["episode_seed"].tolist() == [107, 4, 100]
        alone, _ = venv.reset(seed=4)
        np.testing.assert_array_equal(several["cameras/front"][1], alone["cameras/front"][0])
        venv.reset(seed=range(5, 8))
        for _ in range(6):
            _, _, _, _, infos = venv.step(np.zeros((3, 4), np.float32))
        assert infos["episode_seed"].tolist() == [8, 9, 10]
        for wrong in ([1, 2], [1, 2, None], [1, 2, -3], [1, 2, "3"]):
            with pytest.raises(InvalidInput, match="seed"):
                venv.reset(seed=wrong)


def test_spaces_are_those_of_the_contract() -> None:
    with as_vector_env_of_tabletop(2, "all") as venv:
        shapes = {
            name: (space.shape, space.dtype)
            for name, space in venv.single_observation_space.items()
        }
        assert shapes == {
            "cameras/front": ((32, 32, 3), np.uint8),
            "gripper": ((1,), np.float32),
            "state/xyzrpy": ((6,), np.float32),
        }
        assert (venv.action_space.low == -1).all()
        assert venv.action_space.shape == (2, 4)
        assert venv.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    with as_vector_env_of_tabletop(2, "state") as venv:
        assert venv.observation_space.shape == (2, 7)


def test_a_size_that_the_contract_leaves_open_is_an_error_that_names_it() -> None:
    with pytest.raises(ConfigError, match="front: height: expected it in the env's contract"):
        observation_space(Contract(cameras={"front": CameraSpec()}), "all")
    with pytest.raises(ConfigError, match="the env's contract has neither a state nor a gripper"):
        observation_space(Contract(), "state")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            {"observation": "states"},
            r"observation: expected one of \['all', 'state'\], got 'states'",
        ),
        ({"autoreset": "none"}, "autoreset: expected one of .*'disabled'.*, got 'none'"),
    ],
)
def test_an_unknown_word_is_refused_with_the_known_ones(words: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        as_vector_env("tabletop", **words)


def test_wrong_actions_and_a_step_before_the_reset_are_errors() -> None:
    venv = of(Line, 2)
    with pytest.raises(NotReset, match="reset"):
        venv.step(np.zeros((2, 1)))
    with pytest.raises(NotReset, match="expected a reset of all"):
        venv.reset(options={"reset_mask": np.array([True, False])})
    venv.reset(seed=0)
    with pytest.raises(InvalidAction, match=r"expected shape \(2, 1\), .* got \(1, 1\)"):
        venv.step(np.zeros((1, 1)))
    with pytest.raises(ConfigError, match="reset_mask: expected"):
        venv.reset(options={"reset_mask": np.zeros(2, np.bool_)})


def test_an_env_with_several_tasks_tells_each_of_them() -> None:
    class Tasks(Line):  # its instruction follows its position
        several_tasks = True

    envs = BatchVectorEnv(SequentialBatch([Tasks(), Tasks()]))
    _, infos = envs.reset(seed=0)
    told = [list(infos["instruction"])]
    for _ in range(2):
        _, _, _, _, infos = envs.step(np.full((2, 1), 0.5, np.float32))
        told.append(list(infos["instruction"]))
    for texts in zip(*told, strict=True):
        assert len(set(texts)) == 3


def test_an_error_of_the_simulator_is_the_envs() -> None:
    venv = as_vector_env(LINE, 2, observation="state", env_options={"trouble": {"raise": [1]}})
    venv.reset(seed=0)
    for _ in range(3):
        venv.step(np.zeros((2, 1)))
    with pytest.raises(EnvFailed, match="the simulator exploded"):
        venv.step(np.zeros((2, 1)))


def play(venv: BatchVectorEnv, actions: np.ndarray, steps: int) -> None:
    for _ in range(steps):
        venv.step(actions)


class Together(SequentialBatch):
    """As a simulator on a GPU, which resets all its environments at once."""

    restarts = False


def test_a_simulator_that_resets_all_at_once_serves_episodes_that_end_together() -> None:
    venv = BatchVectorEnv(Together([Line(), Line()]), "state")
    venv.reset(seed=0)
    for _ in range(10):
        _, _, _, truncated, infos = venv.step(np.zeros((2, 1)))
    assert truncated.all()
    assert infos["episode_seed"].tolist() == [2, 3]
    apart = BatchVectorEnv(Together([Ending(), Ending()]), "state")
    apart.reset(seed=0)
    with pytest.raises(
        ConfigError, match="1 of 2 episodes are over, and this simulator resets all"
    ):
        play(apart, np.array([[-1.0], [0.0]]), 10)


@pytest.mark.vulkan
def test_maniskill_on_the_cpu() -> None:
    options = {"width": 32, "height": 32, "max_steps": 3}
    venv = as_vector_env("maniskill/PushCube-v1", env_options=options)
    obs, infos = venv.reset(seed=3)
    assert infos["episode_seed"].tolist() == [3]
    for _ in range(3):
        assert obs in venv.observation_space
        obs, rewards, _, truncated, infos = venv.step(venv.action_space.sample())
        assert np.isfinite(rewards).all()
    assert truncated.all()
    assert infos["final_obs"][0] in venv.single_observation_space
    assert infos["episode_seed"].tolist() == [4]
    venv.close()


def test_without_gymnasium_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "vlagents_ray_learn.vector_env")
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(
        MissingDependency, match=re.escape(pip_install("rollouts", "vlagents-ray-learn"))
    ):
        __import__("importlib").import_module("vlagents_ray_learn.vector_env")


ROOT = Path(__file__).parents[3]
SOURCE = "STABLE_BASELINES3_SRC"  # a checkout, or a folder of `pip install --target`


@pytest.mark.source(SOURCE)
@pytest.mark.program("Stable-Baselines3")
@pytest.mark.torch
@pytest.mark.slow
def test_ppo_learns_to_swing_a_pendulum_up() -> None:
    environment = {
        **os.environ,
        "PYTHONPATH": f"{ROOT}:{os.environ[SOURCE]}",
        "OMP_NUM_THREADS": "1",
    }
    command = [sys.executable, "docs/evaluation/stable_baselines.py"]
    printed = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    ).stdout
    curve = [float(line.split()[1]) for line in printed.splitlines()]
    assert curve[0] < -900, "or the test shows nothing: untrained"
    assert curve[-1] > -400, curve


TORCHRL = "TORCHRL_SRC"  # a folder of `pip install --target`
OF_TORCHRL = """
import sys
from torchrl.envs import GymWrapper
from torchrl.envs.utils import check_env_specs
from vlagents_ray_learn import as_vector_env
options = {"width": 32, "height": 32, "max_steps": 6}
envs = as_vector_env("tabletop/lift", 2, observation=sys.argv[1], autoreset="disabled", env_options=options)
env = GymWrapper(envs)
env.set_seed(3)
check_env_specs(env)
played = env.rollout(20, break_when_any_done=False)
print(*played.shape, int(played["next", "done"].sum()))
"""


@pytest.mark.source(TORCHRL)
@pytest.mark.program("TorchRL")
@pytest.mark.torch
@pytest.mark.parametrize("observation", ["state", "all"])
def test_torchrl_takes_them_for_its_own_and_resets_each_that_is_over(observation: str) -> None:
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{os.environ[TORCHRL]}"}
    command = [sys.executable, "-c", OF_TORCHRL, observation]
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    # 2 environments, 20 steps, 3 whole episodes of 6 in each.
    assert done.stdout.splitlines()[-1] == "2 20 6"
