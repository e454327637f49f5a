"""Recorded actions are executed again in their environment, and every number is compared to the
bit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from eval_fakes import LINE, Line
from in_process_evaluation import play

from vlagents_ray import Act
from vlagents_ray.errors import EnvFailed
from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.evaluate.artifacts.recorder import Trajectory
from vlagents_ray.evaluate.results.reader import CaseResults, Episode
from vlagents_ray_results.recorded_actions import replay_actions

Recorded = tuple[CaseResults, Episode, Trajectory]
STEPS = 10


@pytest.fixture
def recorded(config: Callable[..., EvalConfig]) -> Recorded:
    """Return the first episode of an evaluation, which has `STEPS` steps."""
    results = play(config(envs=[LINE], episodes=1, record="all"))
    [case] = results.cases
    [episode] = case.episodes
    return case, episode, Trajectory.load(results.file(str(episode.trajectory)))


def alter(monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    """Make the environment differ in this respect after two steps."""
    unaltered = Line.step

    def step(self: Line, act: Act) -> Any:
        obs, reward, terminated, truncated, info = unaltered(self, act)
        if self._steps != 2:
            return obs, reward, terminated, truncated, info
        if what == "raises":
            raise RuntimeError("this episode is over")
        if what == "ends":
            truncated = True
        if what == "state":
            position = np.nextafter(obs.state["position"], np.float32(100))
            obs = replace(obs, state={"position": position})
        if what == "gripper":
            obs = replace(obs, gripper=0.5)
        if what == "reward":
            reward = float(np.nextafter(reward, 0.0))
        if what == "success":
            info = {"success": not info["success"]}
        return obs, reward, terminated, truncated, info

    monkeypatch.setattr(Line, "step", step)


def test_the_same_environment_repeats_the_episode(recorded: Recorded) -> None:
    replayed = replay_actions(*recorded)
    result = recorded[1].result
    assert replayed.differences == {}
    assert len(replayed.success) == STEPS
    assert (replayed.ending, replayed.instruction) == (result.ending, result.instruction)
    assert any(replayed.success) == result.success_once


@pytest.mark.parametrize("what", ["state", "gripper", "reward", "success"])
def test_a_step_that_differs_in_one_bit_is_named(
    what: str, recorded: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    alter(monkeypatch, what)
    assert list(replay_actions(*recorded).differences) == [2]


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("raises", "this episode is over"),
        ("ends", f"the episode ended after 2 of {STEPS} actions"),
    ],
)
def test_an_episode_that_ends_before_its_last_action_is_not_compared(
    what: str, message: str, recorded: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    alter(monkeypatch, what)
    with pytest.raises(EnvFailed, match=message):
        replay_actions(*recorded)
