"""Polling in place of a sleep: it ends when another program needs the core."""

from __future__ import annotations

import os
import time

import pytest

from vlagents_ray.polling import _LONG_YIELD_S, _PAUSE_S, Polling

LIMIT_S = 150e-6


class Core:
    """A core whose yields take `yield_s`, and its clock, s."""

    def __init__(self, yield_s: float) -> None:
        self.now, self.yields, self.yield_s = 100.0, 0, yield_s
        self.message_at = float("inf")

    def sched_yield(self) -> None:
        self.yields += 1
        self.now += self.yield_s

    def poll(self, timeout: int) -> list[int]:
        assert timeout == 0
        return [1] if self.now >= self.message_at else []


@pytest.fixture
def core(monkeypatch: pytest.MonkeyPatch) -> Core:
    core = Core(1e-6)
    monkeypatch.setattr(os, "sched_yield", core.sched_yield)
    monkeypatch.setattr(time, "perf_counter", lambda: core.now)
    return core


def test_a_message_that_waits_needs_no_yield(core: Core) -> None:
    core.message_at = core.now
    assert Polling(LIMIT_S).receives(core.poll)
    assert core.yields == 0


def test_a_message_within_the_limit_is_received(core: Core) -> None:
    core.message_at = core.now + 40e-6
    assert Polling(LIMIT_S).receives(core.poll)
    assert core.now - core.message_at < 2e-6


def test_polling_ends_at_the_limit(core: Core) -> None:
    begun = core.now
    polling = Polling(LIMIT_S)
    for _ in range(3):
        assert not polling.receives(core.poll)
    assert 3 * LIMIT_S <= core.now - begun < 3 * (LIMIT_S + 2e-6)


@pytest.mark.parametrize("yield_s", [1.1 * _LONG_YIELD_S, 5e-3, 45e-3])
def test_a_long_yield_ends_the_polling_for_a_second(core: Core, yield_s: float) -> None:
    polling = Polling(LIMIT_S)
    core.yield_s = yield_s
    assert not polling.receives(core.poll)
    assert core.yields == 1
    paused = core.now
    while core.now < paused + _PAUSE_S - 1e-3:
        assert not polling.receives(core.poll)
        core.now += 1e-3
    assert core.yields == 1

    # The core is free again.
    core.now, core.yield_s = paused + _PAUSE_S, 1e-6
    core.message_at = core.now + 40e-6
    assert polling.receives(core.poll)
    assert core.yields > 1


def test_a_message_that_came_during_a_long_yield_is_received(core: Core) -> None:
    core.yield_s = 5e-3
    core.message_at = core.now + 1e-3
    assert Polling(LIMIT_S).receives(core.poll)


def test_beside_a_program_that_computes_few_acts_wait_for_a_yield(core: Core) -> None:
    """A thousand answers, each 100 us after its request; before the rule, each needed a yield."""
    core.yield_s = 5e-3
    polling = Polling(LIMIT_S)
    for _ in range(1000):
        core.message_at = core.now + 100e-6
        if not polling.receives(core.poll):
            core.now = max(core.now, core.message_at)  # the thread sleeps until the answer
    assert core.yields == 1
