"""The policies that do nothing for an adjustable time, or return random actions from their
seeds.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from vlagents_ray import Obs
from vlagents_ray.errors import ConfigError, NotReset
from vlagents_ray.policies.noop import Noop
from vlagents_ray.policies.random import Random, RandomConfig
from vlagents_ray.testing import check_agent


def batch_seconds(agent: Noop, size: int) -> float:
    """Return the shortest duration of three batches, since other work on the machine only adds
    time.
    """
    times = []
    for _ in range(3):
        begin = time.perf_counter()
        agent.act_batch([Obs()] * size, [agent] * size)
        times.append(time.perf_counter() - begin)
    return min(times)


@pytest.mark.parametrize(
    "agent",
    [
        *(
            Noop.from_config(config)
            for config in ({}, {"action_dim": 4}, {"chunk": 5, "action_dim": 2})
        ),
        *(
            Random.from_config(config)
            for config in ({}, {"action_dim": 2, "low": 0.0, "high": 512.0}, {"chunk": 5})
        ),
    ],
    ids=lambda agent: type(agent).__name__,
)
def test_keeps_the_contract(agent: Noop | Random) -> None:
    check_agent(agent)


def test_actions_are_zeros_of_the_configured_size() -> None:
    assert np.array_equal(
        Noop.from_config({"action_dim": 3}).act(Obs()).action, np.zeros(3, np.float32)
    )
    assert np.array_equal(
        Noop.from_config({"action_dim": 3, "chunk": 2}).act(Obs()).action,
        np.zeros((2, 3), np.float32),
    )


def test_a_batch_takes_the_base_time_once_and_the_item_time_for_each() -> None:
    agent = Noop.from_config({"base_ms": 20, "per_item_ms": 5})
    four = batch_seconds(agent, 4)
    assert 0.040 <= four < 0.100  # far below four times (20 + 5) ms
    assert batch_seconds(agent, 1) >= 0.025


def test_without_latency_it_does_not_sleep(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "sleep", lambda seconds: pytest.fail(f"slept {seconds} s"))
    Noop().act(Obs())


@pytest.mark.parametrize(
    ("kind", "config"),
    [
        (Noop, {"action_dims": 3}),
        (Noop, {"chunk": 0}),
        (Noop, {"base_ms": -1}),
        (Random, {"low": 2.0, "high": 1.0}),
        (Random, {"low": float("nan")}),
        (Random, {"seed": -1}),
        (Random, {"high_": 1}),
    ],
)
def test_a_wrong_setting_is_refused(kind: Any, config: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=next(iter(config))):
        kind.from_config(config)


def episode(config: dict[str, Any], seed: int | None, steps: int = 4) -> np.ndarray:
    agent = Random.from_config(config)
    agent.reset(Obs(), None, **({} if seed is None else {"seed": seed}))
    return np.stack([agent.act(Obs()).action for _ in range(steps)])


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


def test_samples_of_the_distribution_change_no_action() -> None:
    plain, asked = (
        Random(RandomConfig(chunk=2, low=-2, high=4)),
        Random(RandomConfig(chunk=2, low=-2, high=4)),
    )
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
