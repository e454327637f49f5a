"""Several items at once: same results, same errors, and only where it was found to be faster."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time

import pytest

from vlagents_ray.wire import cores, parallel

needs_two_cores = pytest.mark.skipif(cores.allowed() < 2, reason="one core does nothing in parallel")


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "_verdicts", {})


def wait_for_it(seconds: float) -> float:
    time.sleep(seconds)  # without Python's global lock, as coding runs
    return seconds


@needs_two_cores
def test_what_gains_is_done_in_parallel_and_what_does_not_is_not() -> None:
    for _ in range(2 * parallel._TRIALS):
        parallel.run(wait_for_it, [0.004, 0.004], "long")
        parallel.run(abs, [1, 2], "short")
    assert parallel.verdicts() == {("long", 2): True, ("short", 2): False}


@pytest.mark.parametrize("count", [0, 1, 2, 3, 16])
def test_results_come_in_the_order_of_the_items(count: int) -> None:
    items = list(range(count))
    for _ in range(40):  # either way, and after the choice
        assert parallel.run(lambda x: x * x, items, "squares") == [x * x for x in items]
    if items:
        assert parallel._run(lambda x: x * x, items, parallel=True) == [x * x for x in items]


@pytest.mark.parametrize("parallel_", [False, True])
def test_the_first_item_that_fails_gives_the_error(parallel_: bool) -> None:
    with pytest.raises(ZeroDivisionError):
        parallel._run(lambda x: wait_for_it(0.01) and 1 / x, [1, 0, 2], parallel=parallel_)
    with pytest.raises(ValueError, match="'b'"):
        parallel._run(int, ["1", "b", "c"], parallel=parallel_)


def test_many_callers_share_the_helpers() -> None:
    wrong: list[list[int]] = []

    def call(base: int) -> None:
        for _ in range(200):
            got = parallel._run(lambda x: x + base, [1, 2, 3], parallel=True)
            if got != [base + 1, base + 2, base + 3]:
                wrong.append(got)

    callers = [threading.Thread(target=call, args=(100 * n,)) for n in range(6)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert not wrong
    assert len(parallel._helpers._threads) <= parallel._HELPERS


def test_helpers_keep_off_the_callers_core_but_not_off_all_others() -> None:
    parallel._run(abs, [1, 2], parallel=True)
    allowed = os.sched_getaffinity(0)
    for thread in parallel._helpers._threads:
        assert os.sched_getaffinity(thread) <= allowed
        assert len(os.sched_getaffinity(thread)) >= len(allowed) - 1


def test_a_fork_and_the_end_of_the_process_are_no_trouble() -> None:
    code = """if True:
        import os, time
        from vlagents_ray.wire import parallel
        nap = lambda s: time.sleep(s) or s
        assert parallel._run(nap, [0.01, 0.01], parallel=True) == [0.01, 0.01]
        child = os.fork()
        assert parallel._run(nap, [0.01, 0.02], parallel=True) == [0.01, 0.02]
        if child:
            assert os.waitpid(child, 0)[1] == 0
        print("fine")
    """
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, timeout=30, check=True
    )
    assert done.stdout == "fine\nfine\n"
