"""Random actions that are a pure function of the config's seed and the episode's."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vlagents_ray import Obs
from vlagents_ray.errors import ConfigError, NotReset
from vlagents_ray.policies.random import Random, RandomConfig
from vlagents_ray.testing import check_agent


def episode(config: dict[str, Any], seed: int | None, steps: int = 4) -> np.ndarray:
    agent = Random.from_config(config)
    agent.reset(Obs(), None, **({} if seed is None else {"seed": seed}))
    return np.stack([agent.act(Obs()).action for _ in range(steps)])


@pytest.mark.parametrize("config", [{}, {"action_dim": 2, "low": 0.0, "high": 512.0}, {"chunk": 5}])
def test_keeps_the_contract(config: dict[str, Any]) -> None:
    check_agent(Random.from_config(config))


def test_an_episode_is_determined_by_both_seeds() -> None:
    assert np.array_equal(episode({"seed": 1}, 5), episode({"seed": 1}, 5))
    assert not np.array_equal(episode({"seed": 1}, 5), episode({"seed": 1}, 6))
    assert not np.array_equal(episode({"seed": 1}, 5), episode({"seed": 2}, 5))
    assert np.array_equal(episode({}, None), episode({}, 0))
    assert not np.array_equal(episode({}, -1), episode({}, 1))


def test_actions_fill_the_bounds_and_stay_inside() -> None:
    drawn = episode({"low": -0.5, "high": 2.0, "action_dim": 3, "chunk": 4}, 0, steps=200)
    assert drawn.shape == (200, 4, 3)
    assert drawn.min() >= -0.5
    assert drawn.max() <= 2.0
    assert drawn.min() < -0.4
    assert drawn.max() > 1.9


def test_act_before_reset_is_refused() -> None:
    with pytest.raises(NotReset, match="reset"):
        Random().act(Obs())


@pytest.mark.parametrize("config", [{"low": 2.0, "high": 1.0}, {"low": float("nan")}, {"seed": -1}, {"high_": 1}])
def test_a_wrong_setting_is_refused(config: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        Random.from_config(config)


def test_samples_of_the_distribution_change_no_action() -> None:
    plain, asked = Random(RandomConfig(chunk=2, low=-2, high=4)), Random(RandomConfig(chunk=2, low=-2, high=4))
    for agent in (plain, asked):
        agent.reset(Obs(), None, seed=5)
    for _ in range(3):
        act = asked.act(Obs(info={"samples": 4000}))
        assert act.action.tolist() == plain.act(Obs()).action.tolist()
        told = act.info["distribution"]
        assert told["samples"].shape == (4000, 2, 7)
        assert told["mean"].shape == told["std"].shape == (2, 7)
        assert np.abs(told["samples"].mean(0) - told["mean"]).max() < 0.15
        assert np.abs(told["samples"].std(0) - told["std"]).max() < 0.15
