"""Scaling, on numbers made up for it: what is linear, what a driver costs, and when it is saturated."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.environments import SLEEPING_ENV, SleepingEnv
from benchmarks.scaling import CHUNKS, OWN, SHARED, ScalingPlan, fit, row, saturation
from benchmarks.scaling_driver import DAEMONS, PlayedEpisodes, ScalingRound, daemons_s
from vlagents_ray.envs import make_env
from vlagents_ray.interface import Act
from vlagents_ray.testing import check_env

PLAN = ScalingPlan(workers=(1, 4), rounds=3)


def played(rate: float, **changes: object) -> PlayedEpisodes:
    """A round in which nothing but its rate matters."""
    usual = PlayedEpisodes(rate, 30.0, ["shm"], 0, 100, 20.0, 20.0, 0.4, dict.fromkeys(DAEMONS, 0.2))
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


def test_the_ideal_is_what_sleeping_alone_allows() -> None:
    """50 steps of 20 ms, and 50 acts of 50 ms, or 7 of chunks of 8 rows."""
    assert PLAN.ideal(4, OWN) == PLAN.ideal(4, SHARED) == pytest.approx(4 * 60 / 3.5)
    assert PLAN.ideal(4, CHUNKS) == pytest.approx(4 * 60 / 1.35)
    assert row(PLAN, CHUNKS, 4, [played(PLAN.ideal(4, CHUNKS) / 2)], [1.0])["of_linear"] == pytest.approx(0.5)


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
        found.append(played(1.0, episodes=episodes, span_s=span_s, busy_s=busy_s, driver_s=used / 1e3))
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


def test_daemons_of_this_machine_are_found_by_their_names() -> None:
    assert set(daemons_s()) == set(DAEMONS)
