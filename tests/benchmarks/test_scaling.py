"""Scaling and endurance, with constructed numbers and at a small size: linearity, the driver's
cost, and losses.
"""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from benchmarks.environments import SLEEPING_ENV, EpisodeTimes, SleepingEnv
from benchmarks.saturation import Load, parts
from benchmarks.scaling import CHUNKS, OWN, SHARED, ScalingPlan, fit, row, saturation
from benchmarks.scaling_driver import DAEMONS, PlayedEpisodes, ScalingRound, daemons_s
from benchmarks.soak import SoakPlan, gaps, growth, is_worker, measure_soak, resident, soak_outcomes
from vlagents_ray.envs import make_env
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Act
from vlagents_ray.testing import check_env

PLAN = ScalingPlan(workers=(1, 4), rounds=3)


def played(rate: float, **changes: object) -> PlayedEpisodes:
    """Return a round in which only the rate matters."""
    usual = PlayedEpisodes(
        rate, 30.0, ["shm"], 0, 100, 20.0, 20.0, 0.4, dict.fromkeys(DAEMONS, 0.2)
    )
    return usual._replace(**changes)  # type: ignore[arg-type]


def test_the_environment_that_sleeps_is_an_environment() -> None:
    with make_env(SLEEPING_ENV, max_steps=2, step_ms=0.0, size=32) as env:
        check_env(env)
        assert isinstance(env, SleepingEnv)
        env.reset(seed=0)
        assert [env.step(Act(np.zeros(4, np.float32)))[3] for _ in range(2)] == [False, True]


def test_linear_is_so_many_times_the_single_worker_of_the_same_round() -> None:
    found = row(PLAN, OWN, 4, [played(36), played(40), played(44)], [10, 10, 20])
    assert found["of_linear"] == pytest.approx(0.9)
    assert found["episodes_per_minute"] == 40
    assert found["driver_share"] == pytest.approx(0.02)
    assert found["daemon_shares"] == pytest.approx(dict.fromkeys(DAEMONS, 0.01))
    assert (found["near"], found["sent_bytes_per_act"]) == (1, None)


def test_bytes_between_hosts_are_those_of_an_act() -> None:
    rounds = [
        played(10, sent_bytes=sent, acts=100, near=near)
        for sent, near in ((1000, 1), (3000, 0.5), (9000, 1))
    ]
    found = row(PLAN, OWN, 4, rounds, [10] * 3)
    assert (found["near"], found["sent_bytes_per_act"]) == (0.5, 30)


def test_the_ideal_is_what_sleeping_alone_allows() -> None:
    """50 steps of 20 ms, and 50 acts of 50 ms, or 7 acts with chunks of 8 rows."""
    assert PLAN.ideal(4, OWN) == PLAN.ideal(4, SHARED) == pytest.approx(4 * 60 / 3.5)
    assert PLAN.ideal(4, CHUNKS) == pytest.approx(4 * 60 / 1.35)
    assert row(PLAN, CHUNKS, 4, [played(PLAN.ideal(4, CHUNKS) / 2)], [1.0])[
        "of_linear"
    ] == pytest.approx(0.5)


def test_a_driver_costs_what_its_rounds_say() -> None:
    true = {"episode": 1.5, "step": 0.002, "worker_second": 0.4, "second": 5.0}
    rounds, found = [], []
    for busy_s, steps, episodes, span_s in (
        (80, 10, 800, 20.0),
        (70, 100, 800, 20.0),
        (80, 10, 40, 20),
        (99, 10, 90, 9),
    ):
        used = true["episode"] * episodes + true["step"] * episodes * steps
        used += true["worker_second"] * busy_s + true["second"] * span_s
        rounds.append(ScalingRound(4, episodes // 4, steps, 1.0))
        found.append(
            played(1.0, episodes=episodes, span_s=span_s, busy_s=busy_s, driver_s=used / 1e3)
        )
    assert fit(rounds, found) == pytest.approx(true)


def test_no_cost_is_below_zero() -> None:
    rounds = [ScalingRound(1, 100, steps, 1.0) for steps in (10, 100, 1000)]
    found = [played(1.0, episodes=100, driver_s=used) for used in (0.2, 0.199, 0.19)]
    costs = fit(rounds, found)
    assert min(costs.values()) >= 0
    assert costs["step"] == 0


def test_a_driver_is_saturated_when_its_second_is_full() -> None:
    costs = {"episode": 2.0, "step": 0.01, "worker_second": 0.5, "second": 100.0}
    assert saturation(costs, 2.0, 100) == pytest.approx(900 / (3.0 / 2 + 0.5))
    assert saturation(costs, 1e9, 0) == pytest.approx(1800)


def of_workers(workers: int, gcs: float) -> dict[str, object]:
    shares = {"gcs_server": gcs, "raylet": 0.1, "ServeController": 0.04}
    return {"app": OWN, "workers": workers, "daemon_shares": shares, "sent_bytes_per_act": 1000.0}


SCALING = {
    "clusters": [{"nodes": 2, "rows": [of_workers(1, 0.02), of_workers(11, 0.03)]}],
    "driver": {
        "costs_ms": {"episode": 2.9, "step": 0.001, "worker_second": 1.0, "second": 10.0},
        "flooded": {"episodes_per_s": 200.0},
    },
}


def test_the_part_with_the_least_room_saturates_first() -> None:
    load = Load(
        workers=1000,
        steps=100,
        episode_s=30.0,
        chunk=10,
        act_ms=60.0,
        batch=10,
        replicas=2,
        mbit=100.0,
    )
    rows = parts(SCALING, load)
    found = {row["name"]: row["saturates"] for row in rows}
    assert next(iter(found)) == "learner's link"
    # 250 of the workers are queried each second, which takes 10 + 250 ms; an episode takes 3 ms
    # every 30 s.
    assert found["driver"] == pytest.approx(740 / 0.1)
    assert found["database"] == pytest.approx(200 * 30)
    assert found["replicas"] == pytest.approx(20 / 0.06 * 3)  # one act every 3 s
    assert found["gcs_server"] == pytest.approx(1 + 0.98 / 0.001)
    assert found["ServeController"] is None or found["ServeController"] > 1e9
    assert found["head's link"] == pytest.approx(100e6 / 8 / 1000 * 3)
    limits = [row["saturates"] or float("inf") for row in rows]
    assert limits == sorted(limits)


def test_figures_of_one_number_of_workers_make_no_line() -> None:
    one = {**SCALING, "clusters": [{"nodes": 1, "rows": [of_workers(1, 0.02)]}]}
    with pytest.raises(ConfigError, match="--workers 1,16"):
        parts(one, Load())


def test_daemons_of_this_machine_are_found_by_their_names() -> None:
    assert set(daemons_s()) == set(DAEMONS)


MIB = 2**20
GAP = "between two episodes of a worker, "


def test_a_gap_lies_between_two_episodes_of_one_worker() -> None:
    one = [EpisodeTimes(0, 10, 5, 0), EpisodeTimes(11, 20, 5, 1), EpisodeTimes(24, 30, 5, 2)]
    other = [EpisodeTimes(1, 12, 5, 3), EpisodeTimes(14, 21, 5, 4)]
    assert gaps([one, other]) == [1, 2, 4]


def test_growth_is_what_settled_memory_gains_in_a_thousand_episodes() -> None:
    filling = [(done, done * MIB) for done in range(0, 2000, 100)]
    settled = [(done, 50 * MIB + done * MIB // 500) for done in range(2000, 9_501, 100)]
    # All results are read at the end.
    found = growth([*filling, *settled, (10_000, 900 * MIB)], 10_000)
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
        "plan": {"episodes": 10_000},
        "keys_once": True,
        "done": 10_000,
        "gap_ms": {"first": steady, "last": steady},
        "driver_cpu_ms": {"first": 1.0, "last": 1.0},
        "memory": {"driver": flat, "worker": flat},
    } | changes


@pytest.mark.parametrize(
    ("changes", "missed"),
    [
        ({}, []),
        ({"done": 9_999}, ["every episode"]),
        ({"keys_once": False}, ["every episode"]),
        (
            {"gap_ms": {"first": {"median": 2.0}, "last": {"median": 4.0}}},
            ["the same, last over first"],
        ),
        ({"gap_ms": {"first": {"median": 6.0}, "last": {"median": 4.0}}}, [GAP + "at first"]),
        (
            {"memory": {"driver": {"begin_mib": 1, "end_mib": 9, "mib_per_1000": 1.0}}},
            ["memory of the driver"],
        ),
    ],
)
def test_the_verdict_names_what_is_missed(changes: dict[str, object], missed: list[str]) -> None:
    assert [one.what for one in soak_outcomes(measured(**changes)) if not one.met] == missed


@pytest.mark.slow
@pytest.mark.integration
@pytest.mark.ray
def test_killed_workers_lose_no_episode_and_repeat_none() -> None:
    # On a busy machine one worker may run all episodes while the other one starts.
    for _ in range(4):
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
