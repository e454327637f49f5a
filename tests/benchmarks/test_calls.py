"""Counts of calls: which calls are counted, and which are excluded as waiting."""

from __future__ import annotations

import sys
import threading

from benchmarks.calls import CallCounter


def act() -> int:
    return len("act")


def poll() -> int:
    return len("poll")


def test_calls_of_python_and_c_are_counted_and_those_that_wait_are_not() -> None:
    counter = CallCounter()
    sys.setprofile(counter.count)
    act()
    poll()
    sys.setprofile(None)
    found = counter.read()
    assert (found["Python"], found["C"]) == (1, 2)  # `len`, and the last `setprofile`


def test_each_change_of_threads_is_a_hand_over() -> None:
    counter = CallCounter()

    def work() -> None:
        sys.setprofile(counter.count)
        act()
        sys.setprofile(None)

    work()
    other = threading.Thread(target=work)
    other.start()
    other.join()
    work()
    work()
    assert counter.read()["hand-overs"] == 3
