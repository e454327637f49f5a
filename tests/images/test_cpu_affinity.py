"""The core that a thread runs on."""

from __future__ import annotations

import os

from vlagents_ray.images import cpu_affinity


def test_a_thread_leaves_the_core_it_runs_on_and_may_come_back() -> None:
    may = os.sched_getaffinity(0)
    core = cpu_affinity.here()
    assert core in may
    cpu_affinity.leave(core)
    assert len(may) == 1 or cpu_affinity.here() != core
    assert os.sched_getaffinity(0) == may


def test_a_thread_that_may_run_on_one_core_alone_stays_there() -> None:
    may = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core := min(may)})
    try:
        cpu_affinity.leave(core)
        assert cpu_affinity.here() == core
        assert os.sched_getaffinity(0) == {core}
    finally:
        os.sched_setaffinity(0, may)


def test_another_core_or_none_is_no_reason_to_move() -> None:
    may = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core := max(may)})
    try:
        cpu_affinity.leave(-1)
        cpu_affinity.leave(core + 1)
        assert cpu_affinity.here() == core
    finally:
        os.sched_setaffinity(0, may)
