"""Several images at once: the same results and errors as one by one, with few threads, and without
threads for little work.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from unittest.mock import Mock

import numpy as np
import pytest

from vlagents_ray.images import thread_map
from vlagents_ray.images.codecs import JPEG, LOSSLESS, ImageCodec, decode_files, encode_files
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Budget

LITTLE, MUCH = 0.0, 1.0  # s of work
WAIT_S = 30


@pytest.fixture(autouse=True)
def four_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thread_map, "allowed", lambda: 4)


@pytest.fixture
def no_helpers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        thread_map, "_helpers", Mock(side_effect=AssertionError("asked for helpers"))
    )


def helpers() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if "vlagents-ray-images" in thread.name]


@pytest.mark.parametrize("work_s", [LITTLE, MUCH])
@pytest.mark.parametrize("count", [0, 1, 2, 3, 16])
def test_results_come_in_the_order_of_the_items(count: int, work_s: float) -> None:
    items = list(range(count))
    for _ in range(20):
        assert thread_map.thread_map(lambda x: x * x, items, work_s) == [x * x for x in items]


def test_much_work_is_done_by_several_threads() -> None:
    together = threading.Barrier(4)  # four threads must meet here at the same time
    thread_map.thread_map(lambda _: together.wait(WAIT_S), [0] * 4, MUCH)


@pytest.mark.usefixtures("no_helpers")
def test_little_work_one_item_and_one_core_need_no_helper(monkeypatch: pytest.MonkeyPatch) -> None:
    assert thread_map.thread_map(abs, [-1, -2, -3], LITTLE) == [1, 2, 3]
    assert thread_map.thread_map(abs, [-1], MUCH) == [1]
    monkeypatch.setattr(thread_map, "allowed", lambda: 1)
    assert thread_map.thread_map(abs, [-1, -2], MUCH) == [1, 2]


@pytest.mark.parametrize("codec", [JPEG, LOSSLESS])
def test_large_images_are_shared_with_helpers_and_small_ones_are_not(
    codec: ImageCodec, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = Mock(side_effect=thread_map._helpers)
    monkeypatch.setattr(thread_map, "_helpers", asked)
    for side, shared in ((48, False), (640, True)):
        files = encode_files([np.full((side, side, 3), n, np.uint8) for n in range(2)], codec)
        assert asked.called == shared
        asked.reset_mock()
        if not (shared or codec is JPEG):  # a PNG of any size may take half a millisecond
            continue
        assert [int(image[0, 0, 0]) for image in decode_files(files, Budget(DEFAULT_LIMITS))] == [
            0,
            1,
        ]
        assert asked.called == shared
        asked.reset_mock()


@pytest.mark.parametrize("work_s", [LITTLE, MUCH])
def test_the_first_item_that_fails_gives_the_error(work_s: float) -> None:
    with pytest.raises(ValueError, match="'b'"):
        thread_map.thread_map(int, ["1", "b", "c"], work_s)


def test_an_error_is_raised_once_no_thread_uses_the_items() -> None:
    together, ended = threading.Barrier(2), []

    def call(fails: bool) -> None:
        together.wait(WAIT_S)
        if fails:
            raise ZeroDivisionError
        time.sleep(0.05)
        ended.append(1)

    with pytest.raises(ZeroDivisionError):
        thread_map.thread_map(call, [True, False], MUCH)
    assert ended


def test_many_callers_share_a_few_helpers() -> None:
    wrong: list[list[int]] = []

    def call(base: int) -> None:
        for _ in range(200):
            got = thread_map.thread_map(lambda x: x + base, [1, 2, 3], MUCH)
            if got != [base + 1, base + 2, base + 3]:
                wrong.append(got)

    callers = [threading.Thread(target=call, args=(100 * n,)) for n in range(6)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert not wrong
    assert 1 <= len(helpers()) <= thread_map._MOST_HELPERS


def test_a_caller_does_not_wait_for_busy_helpers() -> None:
    at_work, go_on = threading.Semaphore(0), threading.Event()

    def call(_: int) -> None:
        at_work.release()
        go_on.wait(WAIT_S)

    callers = [
        threading.Thread(target=thread_map.thread_map, args=(call, [0] * 4, MUCH)) for _ in range(2)
    ]
    for caller in callers:
        caller.start()
    for _ in range(len(callers) + thread_map._MOST_HELPERS):
        at_work.acquire()
    threads = thread_map.thread_map(lambda _: threading.current_thread(), [0] * 4, MUCH)
    assert all(caller.is_alive() for caller in callers)
    go_on.set()
    for caller in callers:
        caller.join()
    assert set(threads) == {threading.current_thread()}


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="there is one core")
def test_helpers_keep_off_the_callers_core_but_not_off_all_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    together = threading.Barrier(1 + thread_map._MOST_HELPERS)
    # This call starts all helpers.
    thread_map.thread_map(lambda _: together.wait(WAIT_S), [0] * together.parties, MUCH)
    may = os.sched_getaffinity(0)
    for core in may:
        monkeypatch.setattr(thread_map, "current_core", lambda core=core: core)
        thread_map.thread_map(abs, [1, 2], MUCH)
        affinities = [os.sched_getaffinity(helper.native_id or 0) for helper in helpers()]
        assert affinities == [may - {core}] * thread_map._MOST_HELPERS


def test_a_fork_and_the_end_of_the_process_are_no_trouble() -> None:
    code = """if True:
        import atexit, os, threading
        from vlagents_ray.images import thread_map
        from vlagents_ray.images.thread_map import thread_map
        thread_map.allowed = lambda: 2
        together = threading.Barrier(2)
        assert sorted(thread_map(lambda _: together.wait(20), [0, 0], 1)) == [0, 1]
        child = os.fork()
        assert sorted(thread_map(lambda _: together.wait(20), [0, 0], 1)) == [0, 1]
        if child:
            assert os.waitpid(child, 0)[1] == 0
        atexit.register(lambda: print(thread_map(abs, [-1, -2], 1)))  # when no thread is started any more
    """
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert done.stdout == "[1, 2]\n[1, 2]\n"
    assert not done.stderr
