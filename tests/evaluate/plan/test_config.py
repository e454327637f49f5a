from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from pydantic import ValidationError

from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.evaluate.plan.config import ClockConfig, SuiteConfig, canonical, fingerprint


def test_a_range_of_steps_includes_the_last(config: Callable[..., EvalConfig]) -> None:
    [policy] = config(steps={"first": 1000, "last": 3000, "every": 1000}).policies
    assert policy.steps == [1000, 2000, 3000]


def test_seeds_that_would_play_an_episode_twice_are_refused(config: Callable[..., EvalConfig]) -> None:
    assert config(episodes=5, seeds=[10, 0, 5]).suites[0].seeds == [10, 0, 5]
    with pytest.raises(ValidationError, match="would play some twice; want them 5 or more apart"):
        config(episodes=5, seeds=[0, 4])


def test_a_fingerprint_ignores_order_and_nothing_else() -> None:
    assert fingerprint({"a": 1, "b": [1, 2]}) == fingerprint({"b": [1, 2], "a": 1})
    assert fingerprint({"a": 1, "b": [1, 2]}) != fingerprint({"a": 1, "b": [2, 1]})


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_numbers_that_json_lacks_are_refused(value: Any) -> None:
    with pytest.raises(ValueError, match="Out of range"):
        canonical({"a": value})


def test_a_batch_has_no_latency_to_measure() -> None:
    assert SuiteConfig(envs=["line"], num_envs=2, clock=ClockConfig(latency=0.1)).clock is not None
    with pytest.raises(ValidationError, match="of the whole batch; want 1, or a latency in seconds"):
        SuiteConfig(envs=["line"], num_envs=2, clock=ClockConfig())


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"wokers": 3}, "wokers"),
        ({"envs": ["a", "b", "a"]}, "named twice"),
        ({"policies": [{"name": "a", "url": "http://x"}, {"name": "a", "url": "http://y"}]}, "two policies are named"),
        ({"policy_options": {"seed": 3, "checkpoint_step": 20}}, r"\['seed'\] are set episode by episode"),
    ],
)
def test_settings_that_cannot_be_are_refused(
    config: Callable[..., EvalConfig], wrong: dict[str, Any], said: str
) -> None:
    with pytest.raises(ValidationError, match=said):
        config(**wrong)
