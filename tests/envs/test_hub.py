"""LeRobot's EnvHub from the hub's cache: what is run, and what is refused before anything is."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from vlagents_ray import registry
from vlagents_ray.envs import make_env
from vlagents_ray.envs.base import known_contract, make_batch
from vlagents_ray.envs.gymnasium.hub import EnvHub, HubFile
from vlagents_ray.envs.gymnasium.vector import GymnasiumBatch
from vlagents_ray.errors import ConfigError, EnvFailed, MissingDependency, UnknownEnv
from vlagents_ray.interface import Act
from vlagents_ray.testing import check_env

constants = pytest.importorskip("huggingface_hub.constants")
pytestmark = pytest.mark.sim

COMMIT = "0123456789abcdef0123456789abcdef01234567"
NAME = f"hub/somebody/reach@{COMMIT}"
TRUSTED = {"trust_remote_code": True}
# As LeRobot's documentation has it: a mapping, observations under "pixels" and "agent_pos", and the task in words.
ENV = """
from dataclasses import dataclass

import gymnasium
import numpy as np


@dataclass
class Step:
    size: float = 0.1


class Reach(gymnasium.Env):
    task_description = "go to the corner"
    _max_episode_steps = 7
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    observation_space = gymnasium.spaces.Dict(
        pixels=gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8),
        agent_pos=gymnasium.spaces.Box(-9, 9, (2,), np.float32),
    )

    def __init__(self, goal=1.0):
        self.goal = goal

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.at = self.np_random.uniform(0, 0.5, 2).astype(np.float32)
        return self.seen(), {"is_success": False}

    def step(self, action):
        self.at = self.at + Step().size * action
        done = bool((self.at > self.goal).all())
        return self.seen(), float(done), done, False, {"is_success": done}

    def seen(self):
        return {"pixels": np.full((8, 8, 3), int(100 * self.at[0]) % 256, np.uint8), "agent_pos": self.at}


def make_env(n_envs=1, use_async_envs=False):
    mode = gymnasium.vector.AutoresetMode.SAME_STEP
    return {"reach": {0: gymnasium.vector.SyncVectorEnv([Reach] * n_envs, autoreset_mode=mode)}}
"""
FILES = {
    "env.py": ENV,
    "envs/far.py": ENV.replace('{"reach": {0:', '{"reach": {0: gymnasium.vector.SyncVectorEnv([Reach]), 3:'),
    "single.py": ENV + "\n\ndef make_env(n_envs=1, use_async_envs=False):\n    return Reach()\n",
    "wants.py": "import no_such_package\n",
    "empty.py": "",
    "breaks.py": "def make_env(n_envs=1, use_async_envs=False):\n    raise RuntimeError('no robot')\n",
    "wrong.py": "def make_env(n_envs=1, use_async_envs=False):\n    return n_envs\n",
}


@pytest.fixture(autouse=True)
def cached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Put the repository into a cache of the hub, as a download leaves it there."""
    snapshot = tmp_path / "models--somebody--reach" / "snapshots" / COMMIT
    for name, text in FILES.items():
        (snapshot / name).parent.mkdir(parents=True, exist_ok=True)
        (snapshot / name).write_text(text)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    yield
    for module in [name for name in sys.modules if name.startswith("hub_somebody_")]:
        del sys.modules[module]


def test_it_keeps_the_promises_of_an_env() -> None:
    check_env(make_env(NAME, **TRUSTED))


def test_task_step_limit_and_success_are_the_repositorys() -> None:
    with make_env(NAME, **TRUSTED) as env:
        assert (env.instruction, env.max_steps) == ("go to the corner", 7)
        obs, _ = env.reset(seed=0)
        assert (obs.cameras["pixels"].shape, obs.state["agent_pos"].shape) == ((8, 8, 3), (2,))
        described = env.describe()
        assert (described["repository"], described["commit"], described["file"]) == ("somebody/reach", COMMIT, "env.py")
        steps = []
        for _ in range(7):
            steps.append(env.step(Act(np.ones(2, np.float32))))
            if steps[-1][2]:
                break
        assert steps[-1][-1]["success"] is False  # 0.1 a step does not lead there from any seed within 7
        assert steps[-1][3] is True


def test_several_rows_are_stepped_together_and_succeed_as_alone() -> None:
    seeds, push = [3, 8, 1], Act(np.full(2, 1.0, np.float32))
    options = {**TRUSTED, "max_steps": 30}
    with make_batch(NAME, 3, **options) as batch, make_env(NAME, **options) as alone:
        assert isinstance(batch, GymnasiumBatch)
        first = batch.reset(seeds=seeds)
        over = [False] * 3
        rows = [[obs.state["agent_pos"]] for obs in first]
        successes = [0] * 3
        while not all(over):
            seen, _, terminated, _, infos = batch.step([None if done else push for done in over])
            for i in range(3):
                if not over[i]:
                    rows[i].append(seen[i].state["agent_pos"])
                    over[i], successes[i] = terminated[i], infos[i]["success"]
        assert successes == [True] * 3
        for i, seed in enumerate(seeds):
            expected = [alone.reset(seed=seed)[0].state["agent_pos"]]
            ended = False
            while not ended:
                obs, _, ended, *_ = alone.step(push)
                expected.append(obs.state["agent_pos"])
            np.testing.assert_array_equal(rows[i], expected)


def test_another_file_a_part_of_it_and_a_single_environment() -> None:
    with make_env(f"{NAME}:envs/far.py", part="reach/3", **TRUSTED) as env:
        assert env.describe()["file"] == "envs/far.py"
    with pytest.raises(ConfigError, match=r"want one of \['reach/0', 'reach/3'\]"):
        make_env(f"{NAME}:envs/far.py", **TRUSTED)
    with make_env(f"{NAME}:single.py", **TRUSTED) as env:
        assert env.max_steps == 7
    with pytest.raises(ConfigError, match="made 1; set num_envs to 1"):
        make_batch(f"{NAME}:single.py", 2, **TRUSTED)


def test_code_that_is_not_trusted_is_not_run() -> None:
    for attempt in (make_env, known_contract):
        with pytest.raises(ConfigError, match="set trust_remote_code: true"):
            attempt(NAME, **({} if attempt is make_env else {"options": {}}))
    assert not any(name.startswith("hub_somebody_") for name in sys.modules)
    assert known_contract(NAME, TRUSTED) is None


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("hub", "want USER/REPO@COMMIT"),
        ("hub/reach", "want USER/REPO@COMMIT"),
        ("hub/somebody/reach", "revision 'none', want a commit"),
        ("hub/somebody/reach@main", "revision 'main', want a commit"),
        (f"hub/somebody/reach@{COMMIT[:8]}", "want a commit, 40 hex digits"),
        (f"{NAME}:../env.py", "want a Python file of the repository"),
        (f"{NAME}:/env.py", "want a Python file of the repository"),
        (f"{NAME}:readme.md", "want a Python file of the repository"),
        (f"{NAME}:other.py", "neither in the hub's cache nor to be had"),
        (f"hub/somebody/else@{COMMIT}", "neither in the hub's cache nor to be had"),
    ],
)
def test_a_name_that_is_no_file_at_a_commit_is_refused(name: str, message: str) -> None:
    with pytest.raises(UnknownEnv, match=message):
        make_env(name, **TRUSTED)


@pytest.mark.parametrize(
    ("file", "error", "message"),
    [
        ("wants.py", MissingDependency, "'no_such_package', which is not installed"),
        ("empty.py", ConfigError, "no make_env"),
        ("breaks.py", EnvFailed, "make_env raised RuntimeError: no robot"),
        ("wrong.py", ConfigError, "make_env returned int"),
    ],
)
def test_code_that_makes_no_environment_is_named(file: str, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        make_env(f"{NAME}:{file}", **TRUSTED)


def test_a_colon_in_the_task_is_no_class() -> None:
    assert registry.env_class(f"{NAME}:envs/far.py") is EnvHub
    assert registry.env_task(f"{NAME}:envs/far.py") == f"somebody/reach@{COMMIT}:envs/far.py"
    assert registry.env_suite("my_envs:Shelf") == "my_envs:Shelf"
    assert HubFile.parse(f"a/b@{COMMIT}") == HubFile("a/b", COMMIT, "env.py")
