"""A map over the images of a message, in several threads if there is enough work for them.

JPEG and PNG coding release Python's global lock, so threads help.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import TypeVar


def _unknown_core() -> int:
    return -1


current_core: Callable[[], int] = _unknown_core
"""Return the core on which the calling thread runs; -1 if it is not known."""
if hasattr(os, "sched_setaffinity"):
    current_core = getattr(ctypes.CDLL(None), "sched_getcpu", _unknown_core)


def allowed() -> int:
    """Return the number of cores that this thread may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


Item = TypeVar("Item")
Result = TypeVar("Result")

_LEAST_WORK_S = 0.4e-3  # s; two cameras of 224 x 224 in JPEG gain a fifth of a round trip
_MOST_HELPERS = 3  # largest number of threads in addition to the caller's; robots have few cameras
MOST_THREADS = 1 + _MOST_HELPERS


def thread_map(
    function: Callable[[Item], Result], items: Sequence[Item], work_s: float
) -> list[Result]:
    """Compute `[function(item) for item in items]`, in several threads if the time on one core,
    `work_s`, is long.

    The function does not wait for other calls of itself. An exception is that of the first item
    that raised one.
    """
    threads = min(len(items), allowed(), MOST_THREADS)
    if threads < 2 or work_s < _LEAST_WORK_S:
        return [function(item) for item in items]

    todo = iter(range(len(items)))  # shared by all threads, so that a late helper delays nothing
    results: dict[int, Result] = {}
    errors: dict[int, BaseException] = {}

    def work() -> None:
        """Compute the next items until none is left."""
        for index in todo:
            try:
                results[index] = function(items[index])
            except BaseException as error:  # noqa: BLE001 - raised in the caller's thread
                errors[index] = error

    helpers = _helpers(os.getpid())
    helpers.keep_off(current_core())
    helping: list[Future[None]] = []
    with contextlib.suppress(RuntimeError):  # while the interpreter exits, the caller works alone
        for _ in range(threads - 1):
            helping.append(helpers.submit(work))
    work()

    for helper in helping:
        if not helper.cancel():  # it has begun: `items` are in use until it ends
            helper.result()
    if errors:
        raise errors.pop(min(errors))  # popped, so that no reference cycle keeps the items
    return [results[index] for index in range(len(items))]


class _Helpers(ThreadPoolExecutor):
    """Threads that avoid the core of their caller.

    Wake-affine scheduling would often place them there, where they wait for the caller: on two
    cores, two to four cameras took 20 to 50 % longer.
    """

    def __init__(self) -> None:
        super().__init__(_MOST_HELPERS, "vlagents-ray-images", initializer=self._started)
        self._ids: list[int] = []
        self._cores: set[int] = set()  # the cores on which the threads may run

    def _started(self) -> None:
        self._ids.append(threading.get_native_id())
        self._cores = set()

    def keep_off(self, core: int) -> None:
        """Exclude a core from the affinity of the threads; -1 excludes none."""
        if core < 0:
            return
        cores = os.sched_getaffinity(0) - {core}
        if cores and cores != self._cores:
            self._cores = cores
            with contextlib.suppress(OSError):  # not permitted: the kernel chooses the cores
                for thread in self._ids:
                    os.sched_setaffinity(thread, cores)


@cache
def _helpers(_process: int) -> _Helpers:
    """Return the helpers of this process; a forked process has its own, since threads do not
    survive a fork.
    """
    return _Helpers()
