"""Runs of the robots of `benchmarks.fleet_robots`, in separate processes, and their figures."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from benchmarks.fleet_robots import CONNECT_S, Robot
from benchmarks.line_process import LineProcess, our_environment
from benchmarks.processes import cpu_seconds, server_processes

SERVED = 0.98  # minimum share of ticks in time of a robot that counts as served
_AHEAD_S = 0.5
_LATE_S = 90.0
_ROBOTS_A_PROCESS = 16


@dataclass(frozen=True, slots=True)
class RobotsRun:
    """The figures of robots, and the CPU time of robots and servers, s."""

    figures: Sequence[Mapping[str, Any]]  # figures of each robot
    client_cpu_s: float
    server_cpu_s: float


def run_robots(
    fleet: Sequence[Robot], warm: float, seconds: float, prefix: Sequence[str] = ()
) -> RobotsRun:
    """Run robots in separate processes, which all begin at the same time.

    Args:
        fleet: The robots.
        warm: The time before the measurement, s.
        seconds: The length of the measurement, s.
        prefix: The words before the command of each process, such as those that enter a network
            namespace.
    """
    with contextlib.ExitStack() as stack:
        processes = start_robots(stack, fleet, prefix)
        client_pids = [process.pid for process in processes]
        server_pids = server_processes(os.getpid(), client_pids)
        begin = time.monotonic() + _AHEAD_S
        counted = begin + warm
        times = {"begin": begin, "counted": counted, "end": counted + seconds}
        for process in processes:
            process.send(json.dumps(times))
        time.sleep(max(0.0, counted - time.monotonic()))
        clients_before, server_before = _cpu_s(client_pids), _cpu_s(server_pids)
        figures: list[dict[str, Any]] = []
        for process in processes:
            figures += process.read(seconds + _LATE_S)
        return RobotsRun(
            figures, _cpu_s(client_pids) - clients_before, _cpu_s(server_pids) - server_before
        )


def start_robots(
    stack: contextlib.ExitStack, fleet: Sequence[Robot], prefix: Sequence[str] = ()
) -> list[LineProcess]:
    """Start the processes of robots, which `stack` ends, and return them connected.

    Args:
        stack: Ends the processes.
        fleet: The robots.
        prefix: The words before the command of each process.
    """
    processes = []
    for first in range(0, len(fleet), _ROBOTS_A_PROCESS):
        robots_of_process = fleet[first : first + _ROBOTS_A_PROCESS]
        arguments = json.dumps([asdict(robot) for robot in robots_of_process])
        command = [*prefix, sys.executable, "-m", "benchmarks.fleet_robots", arguments]
        processes.append(stack.enter_context(LineProcess("robots", command, our_environment())))
    for process in processes:
        process.read(CONNECT_S)
    return processes


def _cpu_s(pids: Sequence[int]) -> float:
    seconds = 0.0
    for pid in pids:
        with contextlib.suppress(OSError):  # the process has ended
            seconds += cpu_seconds(pid)
    return seconds


def summary(robots: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the figures of some robots: the share of ticks in time, and the ages of actions,
    ms.
    """
    shares = [1 - robot["starved"] / max(1, robot["ticks"]) for robot in robots]
    ticks = sum(robot["ticks"] for robot in robots)
    starved = sum(robot["starved"] for robot in robots)
    ages = np.concatenate([robot["ages"] for robot in robots])
    if not len(ages):
        ages = np.array([np.nan])
    p50, p95, p99 = (float(age) for age in np.quantile(ages, (0.5, 0.95, 0.99)))
    return {
        "served": sum(share >= SERVED for share in shares),
        "share": 1 - starved / max(1, ticks),
        "least_share": min(shares),
        "missed": sum(robot.get("missed", 0) for robot in robots),
        "age_p50_ms": p50,
        "age_p95_ms": p95,
        "age_p99_ms": p99,
    }
