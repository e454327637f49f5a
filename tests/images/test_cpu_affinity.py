"""The core that a thread runs on."""

from __future__ import annotations

import os

from vlagents_ray.images import thread_map


def test_a_thread_leaves_the_core_it_runs_on_and_may_come_back() -> None:
    may = os.sched_getaffinity(0)
    core = thread_map.here()
    assert core in may
    thread_map.leave(core)
    assert len(may) == 1 or thread_map.here() != core
    assert os.sched_getaffinity(0) == may


def test_a_thread_that_may_run_on_one_core_alone_stays_there() -> None:
    may = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core := min(may)})
    try:
        thread_map.leave(core)
        assert thread_map.here() == core
        assert os.sched_getaffinity(0) == {core}
    finally:
        os.sched_setaffinity(0, may)


def test_another_core_or_none_is_no_reason_to_move() -> None:
    may = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core := max(may)})
    try:
        thread_map.leave(-1)
        thread_map.leave(core + 1)
        assert thread_map.here() == core
    finally:
        os.sched_setaffinity(0, may)
