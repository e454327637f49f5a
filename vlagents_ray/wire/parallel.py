"""The same function on several items, on several cores where that was found to be faster.

JPEG and PNG coding run without Python's global lock, so threads help; but handing an item to one
costs tens of microseconds, and the cores may have other work. So each kind of work is timed both ways
on its first calls, and from then on goes the faster one.
"""

from __future__ import annotations

import contextlib
import os
import queue
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from typing import Any, Generic, TypeVar

from vlagents_ray.wire import cores

Item = TypeVar("Item")
Result = TypeVar("Result")

_TRIALS = 8  # calls each way before one is chosen; the first of each only warms up
_GAIN = 0.9  # of the serial time: what parallel work must stay under to be worth a second core
_HELPERS = 3  # threads beside the caller's, at most: robots have few cameras
_KINDS = 256  # of work that are remembered; more would be a caller that invents them


class _Batch(Generic[Item, Result]):
    """Items that the caller and its helpers take one by one, so that a late helper costs nothing."""

    def __init__(self, function: Callable[[Item], Result], items: Sequence[Item]) -> None:
        self._function = function
        self._items = items
        self._todo = deque(range(len(items)))
        self._lock = threading.Lock()
        self._left = len(items)
        self._results: dict[int, Result] = {}
        self._errors: dict[int, BaseException] = {}
        self._done = threading.Event()

    def work(self) -> None:
        """Take items until none is left."""
        while True:
            try:
                index = self._todo.popleft()
            except IndexError:
                return
            try:
                self._results[index] = self._function(self._items[index])
            except BaseException as error:  # noqa: BLE001 - raised in the caller's thread
                self._errors[index] = error
            with self._lock:
                self._left -= 1
                if self._left == 0:
                    self._done.set()

    def wait(self) -> list[Result]:
        """The results in the order of the items; the first error, if there was one."""
        self._done.wait()
        if self._errors:
            raise self._errors[min(self._errors)]
        return [self._results[index] for index in range(len(self._items))]


class _Helpers:
    """Daemon threads, begun when first needed: they keep no process alive, and a fork begins its own."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._queue: queue.SimpleQueue[_Batch[Any, Any]] = queue.SimpleQueue()
        self._threads: list[int] = []  # their native ids
        self._elsewhere: set[int] = set()  # the cores they may run on

    def summon(self, batch: _Batch[Any, Any], count: int) -> None:
        """Have up to `count` threads work on `batch`."""
        count = min(count, _HELPERS)
        with self._lock:
            while len(self._threads) < count:
                name = f"vlagents-ray-codec-{len(self._threads)}"
                thread = threading.Thread(target=self._serve, args=(self._queue,), name=name, daemon=True)
                thread.start()
                self._threads.append(thread.native_id or 0)
                self._elsewhere = set()
            self._keep_off_this_core()
        for _ in range(count):
            self._queue.put(batch)

    def _keep_off_this_core(self) -> None:
        """A kernel that packs threads that wake each other wakes them where the caller runs: after it."""
        if (here := cores.here()) < 0:
            return
        elsewhere = os.sched_getaffinity(0) - {here}
        if elsewhere and elsewhere != self._elsewhere:
            with contextlib.suppress(OSError):  # forbidden here: they run where the kernel likes
                for thread in self._threads:
                    os.sched_setaffinity(thread, elsewhere)
            self._elsewhere = elsewhere

    @staticmethod
    def _serve(batches: queue.SimpleQueue[_Batch[Any, Any]]) -> None:
        while True:
            batches.get().work()


class _Verdict:
    """How long a kind of work took either way, until it is known which is faster."""

    def __init__(self) -> None:
        self.parallel: bool | None = None
        self._taken: tuple[list[float], list[float]] = ([], [])  # s: serial, parallel
        self._calls = 0

    def next(self) -> bool:
        """Which way to try now."""
        self._calls += 1
        return self._calls % 2 == 0

    def note(self, parallel: bool, seconds: float) -> None:
        self._taken[parallel].append(seconds)
        if min(map(len, self._taken)) >= _TRIALS and self.parallel is None:
            serial_s, parallel_s = (statistics.median(taken[1:]) for taken in self._taken)
            self.parallel = parallel_s < _GAIN * serial_s


_helpers = _Helpers()
_verdicts: dict[Hashable, _Verdict] = {}


def run(function: Callable[[Item], Result], items: Sequence[Item], kind: Hashable) -> list[Result]:
    """`[function(item) for item in items]`, on several cores if work of this `kind` is faster so.

    `function` must be safe to call from other threads. An error is that of the first item that has one.
    """
    if len(items) < 2 or cores.allowed() < 2:
        return [function(item) for item in items]
    kind = (kind, len(items))
    verdict = _verdicts.get(kind)
    if verdict is None:
        if len(_verdicts) >= _KINDS:
            return [function(item) for item in items]
        verdict = _verdicts.setdefault(kind, _Verdict())
    if verdict.parallel is not None:
        return _run(function, items, verdict.parallel)
    parallel = verdict.next()
    begun = time.perf_counter()
    results = _run(function, items, parallel)
    verdict.note(parallel, time.perf_counter() - begun)
    return results


def scale(size: int) -> int:
    """A class of sizes: those within a factor of two."""
    return size.bit_length()


def verdicts() -> dict[Hashable, bool]:
    """The kinds of work decided so far: are they done in parallel?"""
    return {kind: verdict.parallel for kind, verdict in list(_verdicts.items()) if verdict.parallel is not None}


def _run(function: Callable[[Item], Result], items: Sequence[Item], parallel: bool) -> list[Result]:
    if not parallel:
        return [function(item) for item in items]
    batch = _Batch(function, items)
    _helpers.summon(batch, min(len(items), cores.allowed()) - 1)
    batch.work()
    return batch.wait()


def _forget() -> None:
    global _helpers  # noqa: PLW0603 - threads do not survive a fork, and their lock may be held
    _helpers = _Helpers()


os.register_at_fork(after_in_child=_forget)
