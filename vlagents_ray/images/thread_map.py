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
"""Return the core on which the calling thread runs; -1 if the core is unknown."""
if hasattr(os, "sched_setaffinity"):
    current_core = getattr(ctypes.CDLL(None), "sched_getcpu", _unknown_core)


def allowed() -> int:
    """Return the number of cores that this thread may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


Item = TypeVar("Item")
Result = TypeVar("Result")

# Shortest work that is divided among threads, s; with two cameras of 224 x 224 in JPEG, this saves
# a fifth of a round trip.
_LEAST_WORK_S = 0.4e-3
# Largest number of threads in addition to the caller's thread; robots have few cameras.
_MOST_HELPERS = 3
MOST_THREADS = 1 + _MOST_HELPERS


def thread_map(
    function: Callable[[Item], Result], items: Sequence[Item], work_s: float
) -> list[Result]:
    """Compute `[function(item) for item in items]`, in several threads if the time on one core,
    `work_s`, is long.

    The function must not wait for other calls of itself. If calls raise exceptions, the exception
    of the first such item is raised.
    """
    threads = min(len(items), allowed(), MOST_THREADS)
    if threads < 2 or work_s < _LEAST_WORK_S:
        return [function(item) for item in items]

    # Shared by all threads, so that a helper that starts late delays nothing.
    todo = iter(range(len(items)))
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
    with contextlib.suppress(RuntimeError):  # While the interpreter exits, the caller works alone.
        for _ in range(threads - 1):
            helping.append(helpers.submit(work))
    work()

    for helper in helping:
        if not helper.cancel():  # The helper has begun, and uses `items` until it ends.
            helper.result()
    if errors:
        # The error is popped, so that no reference cycle keeps the items.
        raise errors.pop(min(errors))
    return [results[index] for index in range(len(items))]


class _Helpers(ThreadPoolExecutor):
    """Threads that avoid the core of their caller.

    Wake-affine scheduling would often place the threads on that core, where they wait for the
    caller. On two cores, two to four cameras then took 20 to 50 % longer.
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
            # The call is not permitted, so the kernel chooses the cores.
            with contextlib.suppress(OSError):
                for thread in self._ids:
                    os.sched_setaffinity(thread, cores)


@cache
def _helpers(_process: int) -> _Helpers:
    """Return the helpers of this process.

    A forked process creates new ones, since threads do not survive a fork.
    """
    return _Helpers()
