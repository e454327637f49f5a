"""When an evaluation goes on with fewer workers than it wants, and when it gives up."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from eval_fakes import Clock

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig, WorkerConfig
from vlagents_ray.evaluate.workers.cluster import CapacityMonitor

pytestmark = pytest.mark.usefixtures("shared_ray")

WANTED = WorkerConfig(cpus=64)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def capacity(config: Callable[..., EvalConfig], clock: Clock) -> CapacityMonitor:
    return CapacityMonitor(config(workers=3, place_timeout_s=100), clock)


def test_a_worker_may_wait_for_as_long_as_the_settings_say(capacity: CapacityMonitor, clock: Clock) -> None:
    clock.now = 110.0
    assert not capacity.timed_out(since=10.0)
    assert capacity.timed_out(since=9.0)


def test_that_it_goes_on_with_fewer_is_said_once_until_another_comes_up(
    capacity: CapacityMonitor, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    clock.now = 1000.0
    capacity.note_playing()
    for _ in range(3):
        capacity.report_shortage(WANTED, running=2)
    assert caplog.text.count("going on with 2 of 3 workers: the cluster found no room") == 1
    capacity.note_started()
    capacity.report_shortage(WANTED, running=2)
    assert caplog.text.count("going on with") == 2


def test_between_two_episodes_nobody_gives_up_but_where_nothing_is_played_for_as_long(
    capacity: CapacityMonitor, clock: Clock
) -> None:
    clock.now = 1000.0
    capacity.note_playing()
    clock.now = 1100.0
    capacity.report_shortage(WANTED, running=1)
    clock.now = 1101.0
    with pytest.raises(ConfigError, match=r"no room for a worker in 100 s: each needs .*64.* lower `workers`"):
        capacity.report_shortage(WANTED, running=1)
