"""CPU time of a group of processes while something else goes on."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")
_EVERY_S = 0.2
_LOOK_EVERY = 5  # samples, before the processes are looked for anew


def cpu_seconds(pid: int) -> float:
    """User and system CPU time of a process so far, all its threads, s. `OSError` if it has ended."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) * _TICK_S  # utime and stime of proc_pid_stat(5)


class CpuSampler:
    """Samples what this process and those that `processes` names have used, until it is left.

    A process that has ended keeps what it was last seen with. Its own sampling is not counted.
    """

    def __init__(self, processes: Callable[[], Iterable[int]]) -> None:
        self._processes = processes
        self._seen: dict[int, float] = {}
        self._moments: list[tuple[float, float]] = []  # s of time.time(), CPU s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._sample, name="cpu", daemon=True)

    def __enter__(self) -> CpuSampler:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop.set()
        self._thread.join()

    def between(self, first: float, last: float) -> float:
        """CPU time used between two moments, s of `time.time()`; between samples it is taken as even."""
        moments, totals = zip(*self._moments, strict=True)
        return float(np.interp(last, moments, totals) - np.interp(first, moments, totals))

    def _sample(self) -> None:
        pids: set[int] = set()
        number = 0
        while True:
            if number % _LOOK_EVERY == 0:
                pids = {*self._processes(), os.getpid()}
            number += 1
            for pid in pids:
                try:
                    self._seen[pid] = cpu_seconds(pid)
                except OSError:
                    continue
            self._moments.append((time.time(), sum(self._seen.values()) - time.thread_time()))
            if self._stop.is_set():
                return
            self._stop.wait(_EVERY_S)
