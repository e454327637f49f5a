"""The policy that does nothing, in an adjustable time."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from vlagents_ray import Obs
from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.noop import Noop
from vlagents_ray.testing import check_agent


def batch_seconds(agent: Noop, size: int) -> float:
    """The shortest of three batches: other work on the machine only ever adds."""
    times = []
    for _ in range(3):
        begin = time.perf_counter()
        agent.act_batch([Obs()] * size, [agent] * size)
        times.append(time.perf_counter() - begin)
    return min(times)


@pytest.mark.parametrize("config", [{}, {"action_dim": 4}, {"chunk": 5, "action_dim": 2}])
def test_keeps_the_contract(config: dict[str, Any]) -> None:
    check_agent(Noop.from_config(config))


def test_actions_are_zeros_of_the_configured_size() -> None:
    assert np.array_equal(Noop.from_config({"action_dim": 3}).act(Obs()).action, np.zeros(3, np.float32))
    assert np.array_equal(
        Noop.from_config({"action_dim": 3, "chunk": 2}).act(Obs()).action, np.zeros((2, 3), np.float32)
    )


def test_a_batch_takes_the_base_time_once_and_the_item_time_for_each() -> None:
    agent = Noop.from_config({"base_ms": 20, "per_item_ms": 5})
    four = batch_seconds(agent, 4)
    assert 0.040 <= four < 0.100  # far below four times (20 + 5) ms
    assert batch_seconds(agent, 1) >= 0.025


def test_without_latency_it_does_not_sleep(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "sleep", lambda seconds: pytest.fail(f"slept {seconds} s"))
    Noop().act(Obs())


@pytest.mark.parametrize("config", [{"action_dims": 3}, {"chunk": 0}, {"base_ms": -1}])
def test_a_wrong_setting_is_refused(config: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=next(iter(config))):
        Noop.from_config(config)
