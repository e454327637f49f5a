"""Measures what robots miss when a replica is killed, when weights are pushed, and when more robots
come.

Robots of `benchmarks.fleet` run for all of these events, one after the other, on two replicas of a
policy that takes the time of a real one. Ticks are open loop: they do not wait for the server. Ray
Serve replaces a killed replica, and the sessions of its robots begin again at another replica.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.autoscaling import sessions_of_replicas
from benchmarks.console import Out, save
from benchmarks.figures import measured_on
from benchmarks.fleet import CURVES
from benchmarks.fleet_robots import Robot
from benchmarks.fleet_runs import start_robots
from benchmarks.line_process import LineProcess
from benchmarks.processes import program, server_processes
from benchmarks.push import Trained, TrainedConfig, layers
from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server
from vlagents_ray_learn import Publisher

_PARAMETERS = 30_000_000  # number of parameters of the pushed model
_AHEAD_S = 1.0
_LATE_S = 60.0
_LOOK_S = 1.0  # time before the next event at which sessions are counted, s
_SETTLE_S = 10.0  # time before the first event, s
IN_TIME = 0.98  # minimum share of the ticks of a second with which a fleet counts as in time


class TimedConfig(TrainedConfig):
    """The size and speed of the model, and the rows of its answers."""

    per_item_ms: float
    chunk: int


class Timed(Trained):
    """Returns chunks of zeros after `base_ms` per batch and `per_item_ms` per observation."""

    Config = TimedConfig
    config: TimedConfig

    @property
    def contract(self) -> Contract:
        return Contract(action=ActionSpec(dim=7, delta=True), chunk=self.config.chunk)

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        time.sleep((self.config.base_ms + self.config.per_item_ms * len(obs)) / 1e3)
        return [Act(np.zeros((self.config.chunk, 7), np.float32)) for _ in obs]


@dataclass(frozen=True, slots=True)
class EventPlan:
    """The settings of `measure_events`."""

    robots: int = 48
    joining: int = 16  # number of robots that come at once
    hz: float = 10.0
    rows: int = 50  # number of rows in an answer
    base_ms: float = 29.3
    row_ms: float = 8.06
    replicas: int = 2
    batch: int = 16
    transport: str = "websocket"
    gap_s: float = 30.0  # time between two events, s


@dataclass(frozen=True, slots=True)
class Event:
    """An event, and its time."""

    name: str
    at_s: float  # time after the robots' beginning, s
    robots: int  # number of robots that run after the event


def measure_events(
    plan: EventPlan, progress: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Cause all events in a fleet, and return plain JSON values."""
    config = {
        "parameters": _PARAMETERS,
        "dtype": "float16",
        "base_ms": plan.base_ms,
        "per_item_ms": plan.row_ms,
        "chunk": plan.rows,
    }
    document = deployment(
        "benchmarks.fleet_events:Timed",
        config=config,
        batch={"max_size": plan.batch},
        replicas=plan.replicas,
        sessions={"limit": 2 * (plan.robots + plan.joining)},
    )
    with (
        running_server(document) as server,
        Publisher(f"serve://{document.applications[0].name}") as learner,
        contextlib.ExitStack() as stack,
    ):
        robot = Robot(server.url, plan.hz, plan.rows, way=plan.transport)
        running = start_robots(stack, [robot] * plan.robots)
        joining = start_robots(stack, [robot] * plan.joining)
        begin = time.monotonic() + _AHEAD_S
        app = document.applications[0].name
        # Numbers of sessions of the replicas at the end of each event.
        sessions: list[list[int]] = []
        moments = [_SETTLE_S + number * plan.gap_s for number in range(4)]
        end_s = moments[-1]
        _send(running, begin, begin + end_s)
        _send(joining, begin + moments[2], begin + end_s)

        def wait_until(moment_s: float) -> None:
            """Wait until shortly before this time, and then record the replicas' sessions."""
            time.sleep(max(0.0, begin + moment_s - _LOOK_S - time.monotonic()))
            sessions.append(sessions_of_replicas(app))
            progress(f"sessions of the replicas: {sessions[-1]}")
            time.sleep(max(0.0, begin + moment_s - time.monotonic()))

        wait_until(moments[0])
        replicas = [pid for pid in server_processes(os.getpid()) if program(pid) == "ServeReplica"]
        os.kill(replicas[0], signal.SIGKILL)
        progress(f"killed one of {len(replicas)} replicas")

        wait_until(moments[1])
        pushed = time.monotonic()
        learner.push(layers(_PARAMETERS, "float16", 1.0), mode="keep")
        push_s = time.monotonic() - pushed
        progress(f"pushed weights in {push_s:.2f} s")

        wait_until(moments[2])
        progress(f"{plan.joining} robots more")
        wait_until(end_s)

        late: list[float] = []
        failed: set[str] = set()
        for processes, begun_s in ((running, 0.0), (joining, moments[2])):
            for process in processes:
                for figures in process.read(end_s + _LATE_S):
                    late += [begun_s + moment_s for moment_s, _ in figures["late"]]
                    failed |= {figures["failed"]} - {""}

    everyone = plan.robots + plan.joining
    happened = [
        Event("steady", _SETTLE_S / 2, plan.robots),
        Event("a replica killed", moments[0], plan.robots),
        Event("weights pushed", moments[1], plan.robots),
        Event(f"{plan.joining} robots more", moments[2], everyone),
    ]
    ends = [*(event.at_s for event in happened[1:]), end_s]
    return {
        "plan": asdict(plan),
        "push_s": push_s,
        "failed": sorted(failed),
        "events": [
            summary(event, until_s, late, plan.hz) | {"sessions": held}
            for event, until_s, held in zip(happened, ends, sessions, strict=True)
        ],
    }


def summary(event: Event, until_s: float, late: Iterable[float], hz: float) -> dict[str, Any]:
    """Return what the robots missed from an event until `until_s`.

    Args:
        event: The event.
        until_s: The end of the event's period; all times are in s after the robots' beginning.
        late: The times of all robots' starved ticks.
        hz: Ticks of a robot per second.
    """
    missed = sorted(moment_s for moment_s in late if event.at_s <= moment_s < until_s)
    each_second = event.robots * hz
    seconds = [0] * (int(until_s - event.at_s) + 1)
    for moment_s in missed:
        seconds[int(moment_s - event.at_s)] += 1
    bad = [second for second, count in enumerate(seconds) if count > (1 - IN_TIME) * each_second]
    return {
        "event": event.name,
        "robots": event.robots,
        "share": 1 - len(missed) / (each_second * (until_s - event.at_s)),
        "starved": len(missed),
        "worst_second": 1 - max(seconds) / each_second,
        "in_time_again_s": bad[-1] + 1 if bad else 0,
    }


def _send(processes: Iterable[LineProcess], begin: float, end: float) -> None:
    for process in processes:
        process.send(json.dumps({"begin": begin, "counted": begin, "end": end}))


def show_events(measured: Mapping[str, Any]) -> None:
    """Print a row for each event."""
    rows = table(
        "event",
        "robots",
        "in time",
        "starved ticks",
        "worst second",
        "s until in time",
        "sessions of the replicas at its end",
    )
    for event in measured["events"]:
        rows.add_row(
            event["event"],
            str(event["robots"]),
            f"{event['share']:.2%}",
            str(event["starved"]),
            f"{event['worst_second']:.1%}",
            str(event["in_time_again_s"]),
            ", ".join(map(str, event["sessions"])),
        )
    out.print(rows)


def main(
    robots: Annotated[int, typer.Option(min=1)] = 48,
    joining: Annotated[int, typer.Option(min=1, help="Number of robots that come at once.")] = 16,
    rows: Annotated[int, typer.Option(min=2, help="Number of rows in an answer.")] = 50,
    curve: Annotated[str, typer.Option(help=f"One of {', '.join(CURVES)}.")] = "pi0",
    transport: Annotated[str, typer.Option(help="websocket or http.")] = "websocket",
    gap: Annotated[float, typer.Option(min=10, help="Seconds between two events.")] = 30.0,
    out_file: Out = None,
) -> None:
    """Measure what robots miss in each event."""
    with errors():
        base_ms, row_ms = CURVES[curve]
        plan = EventPlan(
            robots=robots,
            joining=joining,
            rows=rows,
            base_ms=base_ms,
            row_ms=row_ms,
            transport=transport,
            gap_s=gap,
        )
        measured = measure_events(plan, progress)
        show_events(measured)
        save({**measured_on("python -m benchmarks.fleet_events"), **measured}, out_file)


if __name__ == "__main__":
    typer.run(main)
