"""Traces autoscaling by the objective on a real server while a burst of robots comes and leaves.

One robot executes chunks all the time. After a while the other robots come at once, and later they
leave. The policy takes the time of a real one without computing, so that several replicas run on
few cores. The replicas are sampled throughout, and each robot counts its ticks without an action.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from typing import Annotated, Any

import typer

from benchmarks.autoscaling import ScaleSample, ScaleWatcher
from benchmarks.console import Out, save
from benchmarks.figures import measured_on
from benchmarks.fleet_robots import CONNECT_S, Robot
from benchmarks.line_process import LineProcess, our_environment
from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.serve.launch.deployment_file import Deployment, deployment
from vlagents_ray.serve.launch.server import running_server

_AHEAD_S = 0.5
_LATE_S = 60.0
_ROBOTS_A_PROCESS = 8
_SETTLED_S = 5.0  # time without a missed tick after which a burst counts as in time again, s


@dataclass(frozen=True, slots=True)
class TracePlan:
    """The robots, and the application that serves them."""

    robots: int = 16
    hz: float = 5.0
    chunk: int = 8  # number of rows in an answer
    base_ms: float = 100.0  # duration of a batch, ms; a replica serves ten such robots
    row_ms: float = 60.0
    batch: int = 8
    alone_s: float = 20.0  # time of the first robot alone before the burst, s
    burst_s: float = 60.0
    after_s: float = 40.0  # time of the first robot alone after the burst, s
    transport: str = "websocket"
    autoscaling: Mapping[str, float] = field(
        default_factory=lambda: {"max_replicas": 2, "downscale_delay_s": 10}
    )

    def served(self) -> Deployment:
        """Return the deployment file."""
        return deployment(
            "noop",
            config={
                "base_ms": self.base_ms,
                "per_item_ms": self.row_ms,
                "chunk": self.chunk,
                "delta": True,
            },
            batch={"max_size": self.batch},
            autoscaling=dict(self.autoscaling),
        )


def trace(url: str, plan: TracePlan, progress: Callable[[str], None] = lambda _: None) -> Any:
    """Run the robots against a server that runs the plan's deployment in this process's Ray.

    Returns:
        Plain JSON values, with times in s since the burst.
    """
    robot = asdict(Robot(url, plan.hz, plan.chunk, way=plan.transport))
    with contextlib.ExitStack() as stack:
        first = stack.enter_context(_robots([robot]))
        come = stack.enter_context(contextlib.ExitStack())
        others = []
        for begun in range(1, plan.robots, _ROBOTS_A_PROCESS):
            number = min(_ROBOTS_A_PROCESS, plan.robots - begun)
            others.append(come.enter_context(_robots([robot] * number)))
        for process in (first, *others):
            process.read(CONNECT_S)
        watcher = stack.enter_context(ScaleWatcher())

        begin = time.monotonic() + _AHEAD_S
        burst = begin + plan.alone_s
        left = burst + plan.burst_s
        end = left + plan.after_s
        first.send(json.dumps({"begin": begin, "counted": begin, "end": end}))
        for process in others:
            process.send(json.dumps({"begin": burst, "counted": burst, "end": left}))
        progress(f"{plan.robots} robots come in {plan.alone_s:g} s …")
        burst_figures = []
        for process in others:
            burst_figures += process.read(plan.alone_s + plan.burst_s + _LATE_S)
        come.close()  # ends the sessions of these robots
        progress("one robot is left …")
        first_figures = first.read(plan.burst_s + plan.after_s + _LATE_S)
        zero = time.time() - (time.monotonic() - burst)
        samples = [sample._replace(at=sample.at - zero) for sample in watcher.samples]

    for figures, offset in ((first_figures, -plan.alone_s), (burst_figures, 0.0)):
        for robot_figures in figures:
            robot_figures["late"] = [at + offset for at, _ in robot_figures["late"]]
    return report(plan, samples, first_figures, burst_figures)


@contextlib.contextmanager
def _robots(robots: Sequence[Mapping[str, Any]]) -> Iterator[LineProcess]:
    command = [sys.executable, "-m", "benchmarks.fleet_robots", json.dumps(list(robots))]
    with LineProcess("robots", command, our_environment()) as process:
        yield process


def report(
    plan: TracePlan,
    samples: Sequence[ScaleSample],
    first: Sequence[Mapping[str, Any]],
    burst: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Return the figures of a trace as plain JSON values.

    Args:
        plan: The plan of the trace.
        samples: The replicas, with times in s since the burst.
        first: The figures of the robot that was connected all the time, see `fleet_robots`.
        burst: The figures of the other robots.
    """
    robots = [*first, *burst]
    late: list[float] = []
    for robot in robots:
        late += robot["late"]
    late.sort()
    in_burst = [at for at in late if 0 <= at < plan.burst_s]
    ticks = sum(robot["ticks"] for robot in robots)
    return {
        "plan": asdict(plan),
        "samples": [sample._asdict() for sample in samples],
        "replicas": [[sample.at, sample.requested, sample.running] for sample in _changes(samples)],
        "requested_s": _first(samples, lambda sample: sample.requested > 1),
        "running_s": _first(samples, lambda sample: sample.running > 1),
        "in_time_s": _settled(in_burst),
        "late": late,
        "ticks": ticks,
        "starved": sum(robot["starved"] for robot in robots) - _missed(robots),
        "missed": _missed(robots),  # ticks that were late because the robots' own process was late
        "starved_by_first": first[0]["starved"] - first[0]["missed"],
        "resumed": sum(robot["resumed"] for robot in robots),
        "failed": sorted({robot["failed"] for robot in robots if robot["failed"]}),
    }


def _missed(robots: Sequence[Mapping[str, Any]]) -> int:
    return sum(robot["missed"] for robot in robots)


def _changes(samples: Sequence[ScaleSample]) -> Iterator[ScaleSample]:
    """Yield the samples at which the number of replicas has changed."""
    yield from samples[:1]
    for before, sample in pairwise(samples):
        if (before.requested, before.running) != (sample.requested, sample.running):
            yield sample


def _first(
    samples: Sequence[ScaleSample], condition: Callable[[ScaleSample], bool]
) -> float | None:
    """Return the time of the first sample since the burst for which a condition holds, s."""
    since_burst = [sample for sample in samples if sample.at >= 0]
    return next((sample.at for sample in since_burst if condition(sample)), None)


def _settled(late: Sequence[float]) -> float:
    """Return the time of the last late tick before the first five seconds without one, s."""
    settled = 0.0
    for at in late:
        if at - settled > _SETTLED_S:
            break
        settled = at
    return settled


def show_trace(traced: Mapping[str, Any]) -> None:
    """Print the replicas over time, and the ticks without an action."""
    rows = table("s since the burst", "replicas requested", "running")
    for at, requested, running in traced["replicas"]:
        rows.add_row(f"{at:.1f}", str(requested), str(running))
    out.print(rows)
    out.print(
        f"{traced['starved']} of {traced['ticks']} ticks without an action, the last of the burst "
        f"after {traced['in_time_s']:.1f} s; {traced['starved_by_first']} of the robot that was "
        f"there before; {traced['resumed']} sessions begun again; failed: {traced['failed']}"
    )


def main(
    robots: Annotated[
        int, typer.Option(min=2, help="Number of robots, including the first one.")
    ] = 16,
    replicas: Annotated[int, typer.Option(min=1, help="Maximum number of replicas.")] = 2,
    seconds: Annotated[
        float, typer.Option(min=10, help="Duration of the burst, in seconds.")
    ] = 60.0,
    transport: Annotated[str, typer.Option(help="websocket, http or shm.")] = "websocket",
    out_file: Out = None,
) -> None:
    """Trace the replicas and the ticks in time while a burst of robots comes and goes."""
    with errors():
        origin = measured_on("python -m benchmarks.scaling_trace")
        plan = TracePlan(
            robots=robots,
            burst_s=seconds,
            transport=transport,
            autoscaling={"max_replicas": replicas, "downscale_delay_s": 10},
        )
        with running_server(plan.served()) as server:
            traced = trace(server.url, plan, progress)
        show_trace(traced)
        save({**origin, **traced}, out_file)


if __name__ == "__main__":
    typer.run(main)
