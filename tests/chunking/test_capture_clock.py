"""The age of observations, whatever the wall clock does."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace

import pytest

from vlagents_ray import InvalidObservation, Obs
from vlagents_ray.chunking.buffer import CaptureClock


class Clocks(SimpleNamespace):
    """The machine's, set by the test."""

    wall_s = 1.8e9
    since_boot_s = 100.0

    def time(self) -> float:
        return self.wall_s

    def monotonic(self) -> float:
        return self.since_boot_s

    def go_on(self, seconds: float) -> None:
        self.wall_s += seconds
        self.since_boot_s += seconds


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> Clocks:
    clocks = Clocks()
    monkeypatch.setattr("vlagents_ray.chunking.buffer.time", clocks)
    return clocks


@pytest.fixture
def age(clocks: Clocks) -> Callable[[float | None], float]:
    capture = CaptureClock()
    return lambda stamp: clocks.monotonic() - capture(Obs(info={} if stamp is None else {"captured_at": stamp}))


Age = Callable[["float | None"], float]


def test_an_observation_is_as_old_as_it_says(age: Age, clocks: Clocks) -> None:
    assert age(clocks.wall_s - 0.3) == pytest.approx(0.3)
    assert age(None) == 0


@pytest.mark.parametrize("jump_s", [-3600.0, -0.05, 0.0, 3600.0])
def test_one_that_is_handed_in_again_grows_old_whatever_the_clock_does(age: Age, clocks: Clocks, jump_s: float) -> None:
    stamp = clocks.wall_s - 0.3
    age(stamp)
    clocks.wall_s += jump_s
    clocks.go_on(1.0)
    assert age(stamp) == pytest.approx(1.3)


@pytest.mark.parametrize("jump_s", [-3600.0, 3600.0])
def test_a_jump_costs_the_observation_that_it_fell_into_and_no_other(age: Age, clocks: Clocks, jump_s: float) -> None:
    before = clocks.wall_s
    clocks.go_on(0.01)
    clocks.wall_s += jump_s
    assert age(before) > 3000
    clocks.go_on(0.02)
    assert age(clocks.wall_s - 0.01) == pytest.approx(0.01)


def test_a_clock_that_is_a_little_ahead_is_borne_and_one_that_is_far_ahead_is_not(age: Age, clocks: Clocks) -> None:
    assert age(clocks.wall_s + 0.05) == 0
    assert age(clocks.wall_s + 5) == math.inf


@pytest.mark.parametrize("wrong", ["now", math.nan, math.inf])
def test_a_time_that_is_none_is_refused(wrong: object) -> None:
    with pytest.raises(InvalidObservation, match="captured_at"):
        CaptureClock()(Obs(info={"captured_at": wrong}))
