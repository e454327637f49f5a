"""A long evaluation in small: what is read off it, and that kills lose nothing."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from benchmarks.environments import EpisodeTimes
from benchmarks.soak import SoakPlan, gaps, growth, is_worker, measure_soak, resident, soak_outcomes

MIB = 2**20
GAP = "between two episodes of a worker, "


def test_a_gap_lies_between_two_episodes_of_one_worker() -> None:
    one = [EpisodeTimes(0, 10, 5, 0), EpisodeTimes(11, 20, 5, 1), EpisodeTimes(24, 30, 5, 2)]
    other = [EpisodeTimes(1, 12, 5, 3), EpisodeTimes(14, 21, 5, 4)]
    assert gaps([one, other]) == [1, 2, 4]


def test_growth_is_what_settled_memory_gains_in_a_thousand_episodes() -> None:
    filling = [(done, done * MIB) for done in range(0, 2000, 100)]
    settled = [(done, 50 * MIB + done * MIB // 500) for done in range(2000, 9_501, 100)]
    found = growth([*filling, *settled, (10_000, 900 * MIB)], 10_000)  # all results are read at the end
    assert found is not None
    assert found["mib_per_1000"] == pytest.approx(2)
    assert (found["begin_mib"], found["end_mib"]) == (54, 69)
    assert growth(filling, 10_000) is None


def test_only_a_worker_of_ray_is_killed() -> None:
    assert not is_worker(os.getpid())
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    assert not is_worker(ended.pid)
    assert resident(ended.pid) is None
    assert (resident(os.getpid()) or 0) > MIB


def measured(**changes: object) -> dict[str, object]:
    steady = {"median": 2.0, "p95": 4.0}
    flat = {"begin_mib": 100.0, "end_mib": 101.0, "mib_per_1000": 0.1}
    return {
        "plan": {"episodes": 10_000}, "keys_once": True, "done": 10_000, "gap_ms": {"first": steady, "last": steady},
        "driver_cpu_ms": {"first": 1.0, "last": 1.0}, "memory": {"driver": flat, "worker": flat},
    } | changes  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "missed"),
    [
        ({}, []),
        ({"done": 9_999}, ["every episode"]),
        ({"keys_once": False}, ["every episode"]),
        ({"gap_ms": {"first": {"median": 2.0}, "last": {"median": 4.0}}}, ["the same, last over first"]),
        ({"gap_ms": {"first": {"median": 6.0}, "last": {"median": 4.0}}}, [GAP + "at first"]),
        ({"memory": {"driver": {"begin_mib": 1, "end_mib": 9, "mib_per_1000": 1.0}}}, ["memory of the driver"]),
    ],
)  # fmt: skip
def test_the_verdict_names_what_is_missed(changes: dict[str, object], missed: list[str]) -> None:
    assert [one.what for one in soak_outcomes(measured(**changes)) if not one.met] == missed


@pytest.mark.slow
@pytest.mark.integration
@pytest.mark.ray
def test_killed_workers_lose_no_episode_and_repeat_none() -> None:
    for _ in range(4):  # on a busy machine one worker may play all of them while the other one starts
        found = measure_soak(SoakPlan(episodes=300, kill_every_s=0.1, max_steps=40))
        assert found["keys_once"]
        assert found["done"] == 300
        if found["killed"] and found["retries"]:
            break
    else:
        pytest.fail("no worker was killed in the middle of an episode")
    assert found["memory"]["driver"]["begin_mib"] > 0
    assert found["gap_ms"]["first"]["median"] > 0
    [every, *_] = soak_outcomes(found)
    assert every.met
