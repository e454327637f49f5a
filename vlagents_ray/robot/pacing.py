"""Ticks at a fixed rate, statistics of their lateness, and measures that reduce the lateness."""

from __future__ import annotations

import contextlib
import gc
import math
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence

import numpy as np

from vlagents_ray.errors import ConfigError

SPIN_S = 0.001
"""The last part of a wait, s, during which the thread spins, since a sleeping thread wakes up tens
of microseconds late or more.
"""
# The number of last ticks whose lateness is stored, as a loop may run for days.
KEPT_TICKS = 200_000
# Longest time, s, for which another thread keeps the interpreter lock; Python's default is 5 ms.
_SWITCH_S = 0.0005
_NICE = -10
_FIFO = 10


class Pacer:
    """A schedule of ticks without drift: tick k is due at begin + k * period.

    A tick whose time has passed before it could begin is skipped and counted as missed.

    Args:
        hz: The rate, Hz.

    Raises:
        ConfigError: The rate is not above 0.
    """

    def __init__(self, hz: float) -> None:
        if not (math.isfinite(hz) and hz > 0):
            raise ConfigError(f"hz: expected a rate above 0, got {hz}")
        self.period_s = 1.0 / hz
        self.missed = 0
        self.ticks = 0  # the number of ticks that began
        # The lateness of the last ticks that began, s.
        self.late_s: deque[float] = deque(maxlen=KEPT_TICKS)
        self._begin = time.perf_counter()
        self._tick = -1

    def wait(self) -> int:
        """Wait for the next tick, and return its number."""
        self._tick += 1
        now = time.perf_counter()
        behind = math.floor((now - self._begin) / self.period_s) - self._tick
        if behind > 0:
            self._tick += behind
            self.missed += behind

        due = self._begin + self._tick * self.period_s
        if due - now > SPIN_S:
            time.sleep(due - now - SPIN_S)
        now = time.perf_counter()
        while now < due:
            time.sleep(0)  # other threads can use the interpreter and the core
            now = time.perf_counter()

        self.late_s.append(now - due)
        self.ticks += 1
        return self._tick

    def forget(self, end: int) -> None:
        """Exclude the tick that has just begun from the statistics, and all missed ticks since tick
        number `end`.
        """
        self.late_s.pop()
        self.ticks -= 1
        self.missed -= self._tick - end

    def since_tick_s(self) -> float:
        """Return the time since this tick was due, s."""
        return time.perf_counter() - self._begin - self._tick * self.period_s


def jitter(late_s: Sequence[float], missed: int, ticks: int | None = None) -> dict[str, float]:
    """Compute statistics of the lateness of a loop.

    Args:
        late_s: The lateness of the last ticks, s.
        missed: The number of missed ticks.
        ticks: The number of ticks that began; default: the length of `late_s`.

    Returns:
        `ticks`, `missed`, the share `on_time` that began within 2 ms, and the lateness `p50_ms`,
        `p99_ms` and `max_ms`.
    """
    late_ms = np.array(late_s or [math.nan]) * 1e3
    ticks = len(late_s) if ticks is None else ticks
    return {
        "ticks": ticks,
        "missed": missed,
        "on_time": float((late_ms <= 2).mean()) * ticks / max(1, ticks + missed),
        "p50_ms": float(np.median(late_ms)),
        "p99_ms": float(np.quantile(late_ms, 0.99)),
        "max_ms": float(late_ms.max()),
    }


@contextlib.contextmanager
def undisturbed(*, real_time: bool = False) -> Iterator[list[str]]:
    """Reduce, within the context, the delays of the calling thread that its own process causes.

    Automatic garbage collection is off within the context, as a collection of a large heap takes
    tens of milliseconds; existing objects are excluded from explicit collections. Other threads
    yield the interpreter lock within 0.5 ms. If the user is permitted (root, or `ulimit -e`), the
    thread gets a higher priority than other threads on the machine. With `real_time` it gets the
    scheduling policy SCHED_FIFO instead, which precedes all threads that are not real-time (`ulimit
    -r`).

    The p99 of the lateness was measured on 2 cores at 50 Hz. Next to two busy processes, it is 2.8
    ms without these measures, 0.6 ms with the priority, and 0.02 ms with SCHED_FIFO. Next to a busy
    Python thread of the same process, it is 5.3 ms without and 1.3 ms with the measures.

    Args:
        real_time: Whether to use SCHED_FIFO.

    Yields:
        Descriptions of the measures that were taken.
    """
    was_collecting = gc.isenabled()
    had_frozen_objects = gc.get_freeze_count() > 0
    switch_interval_s = sys.getswitchinterval()

    gc.collect()
    gc.freeze()
    gc.disable()
    sys.setswitchinterval(_SWITCH_S)
    measures = ["garbage collection off", "switch interval 0.5 ms"]

    with contextlib.ExitStack() as undo:
        # `unfreeze` would also unfreeze objects that the program itself has frozen.
        if not had_frozen_objects:
            undo.callback(gc.unfreeze)
        if was_collecting:
            undo.callback(gc.enable)
        undo.callback(sys.setswitchinterval, switch_interval_s)
        measures.append(_prioritise(real_time, undo))
        yield measures


def _prioritise(real_time: bool, undo: contextlib.ExitStack) -> str:
    """Raise the priority of the calling thread, and return the measure in words."""
    if not sys.platform.startswith("linux"):  # other systems have no priorities of threads
        return "no priority (only on Linux)"
    thread = threading.get_native_id()
    try:
        if real_time:
            policy = os.sched_getscheduler(thread)
            parameters = os.sched_getparam(thread)
            os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(_FIFO))
            undo.callback(os.sched_setscheduler, thread, policy, parameters)
            return f"SCHED_FIFO {_FIFO}"

        nice = os.getpriority(os.PRIO_PROCESS, thread)
        os.setpriority(os.PRIO_PROCESS, thread, _NICE)
        undo.callback(os.setpriority, os.PRIO_PROCESS, thread, nice)
    except PermissionError:
        return "no priority (not permitted: see ulimit -e and -r)"
    return f"nice {_NICE}"
