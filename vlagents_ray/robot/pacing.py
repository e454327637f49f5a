"""Ticks at a fixed rate, how punctual they were, and what this process can do for that."""

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
"""A sleeping thread is woken late by some tens of microseconds, on a busy machine by more: the end is not slept."""
ON_TIME_S = 0.002
KEPT_TICKS = 200_000
"""Of which the lateness is kept: a loop may run for days."""
_SWITCH_S = 0.0005  # how long another thread may keep the interpreter when the loop's is due; Python's is 5 ms
_NICE = -10
_FIFO = 10


class Pacer:
    """The ticks of a schedule that is fixed when it begins: tick k is due at begin + k * period, so nothing drifts.

    A tick that is over before it could begin is left out, and counted as missed.
    """

    def __init__(self, hz: float, spin_s: float = SPIN_S) -> None:
        if not (math.isfinite(hz) and hz > 0):
            raise ConfigError(f"hz: got {hz}, want a rate above 0")
        self.period_s = 1.0 / hz
        self.missed = 0
        self.ticks = 0  # that began
        self.late_s: deque[float] = deque(maxlen=KEPT_TICKS)  # of the last ones that began
        self._spin_s = spin_s
        self._begin = time.perf_counter()
        self._tick = -1

    def wait(self) -> int:
        """Return at the next tick, with its number."""
        self._tick += 1
        now = time.perf_counter()
        behind = math.floor((now - self._begin) / self.period_s) - self._tick
        if behind > 0:
            self._tick += behind
            self.missed += behind
        due = self._begin + self._tick * self.period_s
        if due - now > self._spin_s:
            time.sleep(due - now - self._spin_s)
        while (now := time.perf_counter()) < due:
            time.sleep(0)  # gives the interpreter and the core to whoever wants them
        self.late_s.append(now - due)
        self.ticks += 1
        return self._tick

    def forget(self, end: int) -> None:
        """Leave the tick that just began, and those missed from `end` on, out of what is counted."""
        self.late_s.pop()
        self.ticks -= 1
        self.missed -= self._tick - end

    def since_tick_s(self) -> float:
        """Time since this tick was due."""
        return time.perf_counter() - self._begin - self._tick * self.period_s

    def ticks_in(self, seconds: float) -> int:
        """How many are due in that time."""
        return max(1, round(seconds / self.period_s))


def jitter(late_s: Sequence[float], missed: int, ticks: int | None = None) -> dict[str, float]:
    """Of ticks: how many, how many were missed, which share began within 2 ms of when they were due, how late in ms.

    `late_s` may be that of the last of `ticks` only, for which they stand then.
    """
    late_ms = np.array(late_s or [math.nan]) * 1e3
    ticks = len(late_s) if ticks is None else ticks
    return {
        "ticks": ticks,
        "missed": missed,
        "on_time": float((late_ms <= ON_TIME_S * 1e3).mean()) * ticks / max(1, ticks + missed),
        "p50_ms": float(np.median(late_ms)),
        "p99_ms": float(np.quantile(late_ms, 0.99)),
        "max_ms": float(late_ms.max()),
    }


def empty_loop(hz: float, seconds: float, *, real_time: bool = False) -> dict[str, float]:
    """The jitter of a loop that does nothing: what this machine can do."""
    with undisturbed(real_time=real_time):
        pacer = Pacer(hz)
        ticks = pacer.ticks_in(seconds)
        while pacer.wait() < ticks - 1:
            pass
    return jitter(pacer.late_s, pacer.missed, pacer.ticks)


@contextlib.contextmanager
def undisturbed(*, real_time: bool = False) -> Iterator[list[str]]:
    """Keep this process's own disturbances from the calling thread; yields what was done, in words.

    The garbage collector is put off until the end, or until it is called: a collection of a large heap takes tens of
    milliseconds; what is there already is left out, what is not in cycles is freed as ever. Other threads give the
    interpreter back within 0.5 ms, and where the user may (root, or `ulimit -e`), the thread goes before others of
    this machine. `real_time` asks for SCHED_FIFO instead, before everything that is not real-time (`ulimit -r`).

    Measured on 2 cores at 50 Hz, p99 of lateness: beside two busy processes 2.8 ms as it is, 0.6 ms with the
    priority, 0.02 ms with SCHED_FIFO; beside a busy Python thread of the same process 5.3 ms as it is, 1.3 ms so.
    """
    collects, switch_s = gc.isenabled(), sys.getswitchinterval()
    gc.collect()
    gc.freeze()
    gc.disable()
    sys.setswitchinterval(_SWITCH_S)
    done = ["garbage collection off", "switch interval 0.5 ms"]
    with contextlib.ExitStack() as undo:
        undo.callback(gc.unfreeze)
        if collects:
            undo.callback(gc.enable)
        undo.callback(sys.setswitchinterval, switch_s)
        done.append(_prioritise(real_time, undo))
        yield done


def _prioritise(real_time: bool, undo: contextlib.ExitStack) -> str:
    if not sys.platform.startswith("linux"):  # where both calls are about a thread
        return "no priority (only on Linux)"
    thread = threading.get_native_id()
    try:
        if real_time:
            before, param = os.sched_getscheduler(thread), os.sched_getparam(thread)
            os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(_FIFO))
            undo.callback(os.sched_setscheduler, thread, before, param)
            return f"SCHED_FIFO {_FIFO}"
        nice = os.getpriority(os.PRIO_PROCESS, thread)
        os.setpriority(os.PRIO_PROCESS, thread, _NICE)
        undo.callback(os.setpriority, os.PRIO_PROCESS, thread, nice)
    except PermissionError:
        return "no priority (may not: see ulimit -e and -r)"
    return f"nice {_NICE}"
