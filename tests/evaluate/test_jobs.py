from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest

from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.evaluate.jobs import EpisodeKey, Job, JobQueue, plan


def keys_of(env: str, count: int) -> list[EpisodeKey]:
    return [EpisodeKey(env, i, i, "0") for i in range(count)]


def test_a_plan_numbers_and_seeds_every_episode_of_every_env(config: Callable[..., EvalConfig]) -> None:
    keys = plan(config(envs=["a", "b"], episodes=3, seed=7))
    assert [(key.env, key.episode, key.seed) for key in keys] == [
        ("a", 0, 7),
        ("a", 1, 8),
        ("a", 2, 9),
        ("b", 0, 7),
        ("b", 1, 8),
        ("b", 2, 9),
    ]
    assert len(set(map(str, keys))) == 6


@pytest.mark.parametrize(
    "change",
    [
        {"policy": "other"},
        {"policy_config": {"speed": 2}},
        {"policy_options": {"checkpoint_step": 2}},
        {"checkpoint": "step-100"},
        {"env_options": {"width": 128}},
        {"reset_options": {"layout": 1}},
        {"execute": 4},
        {"codec": "jpeg"},
    ],
)
def test_what_changes_the_outcome_changes_the_key(config: Callable[..., EvalConfig], change: dict[str, Any]) -> None:
    assert not set(map(str, plan(config()))) & set(map(str, plan(config(**change))))


@pytest.mark.parametrize(
    "change",
    [
        {"workers": 9},
        {"video": "all"},
        {"policy_url": "http://there:1"},
        {"retries": 0},
        {"threads": 4},
        {"resume": True},
        {"codec": "raw"},
        {"codec": "lossless"},
    ],
)
def test_what_does_not_change_the_outcome_keeps_the_key(
    config: Callable[..., EvalConfig], change: dict[str, Any]
) -> None:
    assert plan(config()) == plan(config(**change))


def test_options_of_one_env_leave_the_keys_of_another_alone(config: Callable[..., EvalConfig]) -> None:
    plain = plan(config(envs=["a", "b"]))
    changed = plan(config(envs=["a", "b"], env_options={"b": {"width": 8}}))
    assert [key.env for key in plain if key in changed] == ["a"] * 6


def test_a_worker_stays_with_the_env_it_has_made() -> None:
    queue = JobQueue(keys_of("a", 2) + keys_of("b", 5))
    taken = [queue.take("a", Counter()) for _ in range(3)]
    assert [job.key.env for job in taken if job] == ["a", "a", "b"]


def test_workers_without_an_env_spread_over_the_envs() -> None:
    queue = JobQueue(keys_of("a", 4) + keys_of("b", 4))
    working: Counter[str] = Counter()
    for _ in range(4):
        job = queue.take(None, working)
        assert job is not None
        working[job.key.env] += 1
    assert working == {"a": 2, "b": 2}


def test_no_worker_idles_while_any_episode_waits() -> None:
    queue = JobQueue(keys_of("a", 1))
    job = queue.take("b", Counter({"a": 5}))
    assert job == Job(keys_of("a", 1)[0])
    assert queue.take("b", Counter()) is None
    assert len(queue) == 0


def test_a_further_attempt_comes_before_new_episodes() -> None:
    queue = JobQueue(keys_of("a", 3))
    first = queue.take("a", Counter())
    assert first is not None
    queue.put_back(first.again())
    assert queue.take("a", Counter()) == Job(first.key, attempt=2)
