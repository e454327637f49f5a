"""Tests of CALVIN with its own simulator, success checks, chains and assets from a checkout."""

from __future__ import annotations

import ast
import contextlib
import math
import os
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from in_process_episode import run_episode

from vlagents_ray.errors import ConfigError, EnvFailed, NotReset
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.testing import check_env
from vlagents_ray_sims.calvin import STEPS, Calvin, Chains, fnv1_32, quietly

pytestmark = pytest.mark.source("CALVIN_SRC")
MOVE = Act(np.array([1, 0.3, -1, 0, 0.1, 1, -1], np.float32))
# A chunk of equal rows; no images are rendered between its rows.
STILL = np.tile(np.array([0, 0, 0, 0, 0, 0, 1], np.float32), (60, 1))
LED = 1  # the chain that begins with "turn_off_led"


@pytest.fixture(scope="module")
def checkout() -> Path:
    return Path(os.environ["CALVIN_SRC"]).resolve()


@pytest.fixture(scope="module")
def env() -> Iterator[Calvin]:
    with Calvin("D", renderer="tiny") as made:
        yield made


@pytest.fixture
def alone(env: Calvin) -> Iterator[None]:
    """Let a test open another environment, although CALVIN's code allows one per process."""
    Calvin._open = None
    yield
    Calvin._open = env._name


def test_the_chains_are_upstreams(checkout: Path) -> None:
    """The first chains are compared with the output of CALVIN's evaluation, and the chains of one
    state with those that CALVIN's own functions draw.
    """
    chains = Chains(checkout)
    assert chains[0].tasks == (
        "rotate_blue_block_right",
        "move_slider_right",
        "lift_red_block_slider",
        "place_in_slider",
        "turn_off_lightbulb",
    )
    assert chains[LED].tasks[0] == "turn_off_led"
    state, (seed, _) = chains._order[7]
    before = np.random.get_state()  # noqa: NPY002 - CALVIN's generator
    theirs = chains._rules["get_sequences_for_state2"]((state, 2, seed))
    np.random.set_state(before)  # noqa: NPY002
    places = {
        place: number for number, (_, (one, place)) in enumerate(chains._order) if one == seed
    }
    assert [tuple(chain) for chain in theirs] == [chains[places[place]].tasks for place in range(2)]
    assert len(chains._order) == 1000
    assert len({seed for _, (seed, _) in chains._order}) == 192


def test_the_initial_states_are_upstreams(checkout: Path) -> None:
    tree = ast.parse((checkout / "calvin_models/calvin_agent/evaluation/utils.py").read_text())
    wanted = ("get_env_state_for_initial_condition", "temp_seed")
    tree.body = [
        node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name in wanted
    ]
    names: dict[str, Any] = {"np": np, "pi": math.pi, "contextlib": contextlib, "hasher": fnv1_32}
    exec(compile(tree, "utils.py", "exec"), names)  # noqa: S102
    chains = Chains(checkout)
    for number in (0, LED, 500):
        robot, scene = names["get_env_state_for_initial_condition"](chains._order[number][0])
        np.testing.assert_array_equal(chains[number].robot, robot)
        np.testing.assert_array_equal(chains[number].scene, scene)


@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize("renderer", ["tiny", "egl"])
def test_what_it_shows_is_upstreams_to_the_bit(checkout: Path, renderer: str) -> None:
    import hydra

    with Calvin("D", renderer=renderer) as ours:
        chain, seen = ours._chains[3], []
        obs, _ = ours.reset(seed=3)
        for _ in range(4):
            seen.append(obs)
            obs, *_ = ours.step(MOVE)
    with quietly():
        with hydra.initialize_config_dir(str(checkout / "calvin_env/conf"), version_base="1.1"):
            changed = ["cameras=static_and_gripper", "use_vr=false"]
            plain = [f"hydra/{log}=default" for log in ("job_logging", "hydra_logging")]
            settings = hydra.compose("config_data_collection", overrides=[*changed, *plain])
        theirs = hydra.utils.instantiate(
            settings.env, use_scene_info=True, use_egl=renderer == "egl"
        )
        raw = theirs.reset(robot_obs=chain.robot, scene_obs=chain.scene)
        for obs in seen:
            for camera in ("static", "gripper"):
                np.testing.assert_array_equal(obs.cameras[camera], raw["rgb_obs"][f"rgb_{camera}"])
            state = np.concatenate([obs.state[name] for name in obs.state])
            np.testing.assert_array_equal(state, raw["robot_obs"][:14].astype(np.float32))
            assert obs.gripper == (raw["robot_obs"][14] + 1) / 2
            raw, *_ = theirs.step(MOVE.action.astype(np.float64))
        theirs.close()
        theirs.ownsPhysicsClient = False


@pytest.mark.usefixtures("alone")
def test_it_keeps_the_promises_of_an_env() -> None:
    check_env(Calvin("A", task_steps=3, renderer="tiny"), steps=2)


class Still(Agent):
    """Keeps the arm still, with open fingers."""

    def act(self, obs: Obs) -> Act:
        return Act(STILL)


class PressesTheButton(Agent):
    """Presses the button of scene D with a closed gripper if the instruction says so, and otherwise
    stays still.
    """

    def __init__(self) -> None:
        self.told: list[str] = []

    def reset(self, obs: Obs, instruction: str | None = None, **_: Any) -> dict[str, Any]:
        self.told.append(str(instruction))
        self._goals = [np.array([-0.12, -0.12, 0.487 + above]) for above in (0.12, 0.03, -0.04)]
        return {}

    def act(self, obs: Obs) -> Act:
        if "button" not in self.told[-1]:
            return Act(STILL)
        way = self._goals[0] - obs.state["tcp_pos"]
        if np.linalg.norm(way) < 0.005 and len(self._goals) > 1:
            self._goals.pop(0)
        return Act(np.array([*np.clip(way / 0.02, -1, 1), 0, 0, 0, -1], np.float32))


def test_a_scripted_arm_solves_a_task_and_is_told_the_next_one(env: Calvin) -> None:
    agent, rewards = PressesTheButton(), []
    key = EpisodeKey("calvin/D", LED, LED, "0")
    result = run_episode(
        env,
        agent,
        key,
        images=False,
        executed=lambda _action, reward, _success: rewards.append(reward),
    )
    first, second = (
        "press the button to turn off the led light",
        "slide the block that it falls into the drawer",
    )
    assert agent.told == [first, second]
    assert result.instruction == f"{first}; {second}"
    assert (result.episode_return, result.success_once, result.ending) == (1.0, False, "terminated")
    assert result.steps == rewards.index(1.0) + 1 + STEPS
    assert rewards.index(1.0) < 60


def test_holding_still_solves_nothing(env: Calvin) -> None:
    for number in range(3):
        result = run_episode(
            env, Still(), EpisodeKey("calvin/D", number, number, "0"), images=False
        )
        assert (result.episode_return, result.steps, result.ending) == (0.0, STEPS, "terminated")


def test_an_episode_of_five_solved_tasks_is_a_success_and_shows_each_beginning(
    env: Calvin, monkeypatch: pytest.MonkeyPatch
) -> None:
    generous = SimpleNamespace(get_task_info_for_set=lambda _start, _now, wanted: wanted)
    monkeypatch.setattr(env, "_judge", generous)
    monkeypatch.setattr(env, "looked_at", False)
    _, info = env.reset(seed=0, options={"init_state": 2})
    told = [env.instruction]
    for number in range(1, 6):
        obs, reward, terminated, truncated, info = env.step(MOVE)
        told.append(env.instruction)
        assert (reward, terminated, truncated) == (1.0, number == 5, False)
        assert (info["solved"], info["success"]) == (number, number == 5)
        assert set(obs.cameras) == {"static", "gripper"}
    assert told[:5] == [env._words[task] for task in info["tasks"]]
    with pytest.raises(NotReset, match="step after the end of the chain"):
        env.step(MOVE)


@pytest.mark.usefixtures("alone")
def test_a_machine_without_egl_is_told_of_the_other_renderer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import pybullet

    monkeypatch.setattr(pybullet, "loadPlugin", lambda *_: -1)
    with pytest.raises(
        EnvFailed, match=r"cannot draw through EGL; install EGL: .*, or set renderer to tiny"
    ):
        Calvin("D")


def test_errors_and_the_description_say_what_a_reader_needs(env: Calvin) -> None:
    described = env.describe()
    assert described["protocol"]["deviations"] == ["renderer: tiny, upstream draws by OpenGL"]
    assert (described["task"], described["pybullet"]) == ("D", "3.2.7")
    with pytest.raises(ConfigError, match="expected one open env in a process, got calvin/D"):
        Calvin("A")
    assert env.init_states == 1000
