"""Robots in separate processes that send photographs, each as soon as the last answer has
arrived.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

from benchmarks.gpu.http_server import http_server
from benchmarks.gpu.lab import INSTRUCTION, PUBLISHED, Acting, Lab, view
from benchmarks.gpu.piped_processes import piped_processes
from vlagents_ray.contract import Contract
from vlagents_ray.serve.python_env.child_start import die_with_parent


def served(lab: Lab) -> None:
    """Measure robots, each in a separate process, with three cameras as JPEG over a WebSocket."""
    counts = lab.size([1, 4, 8], [1, 2])
    config = lab.settings(max_rows=counts[-1], compile=lab.graphs, batch_sizes=counts)
    with lab.measured(config=config, largest=counts[-1]) as measured:
        network_ms = {
            count: measured.bare(count, lab.size(0.5, 0.02))["network_ms"] for count in counts
        }
        contract = measured.engine.contract
        with (
            http_server(measured.engine) as url,
            robots(url, contract, counts[-1]) as pipes,
        ):
            rows = []
            for count in counts:
                figures = act_together(pipes[:count], lab.size(3.0, 0.1))
                share = figures["acts_per_s"] * network_ms[count] / 1e3 / count
                row = {"robots": count, "network_ms": network_ms[count], **figures}
                rows.append({**row, "of_network": share})
                lab.show(robots=rows)
    lab.show(published=PUBLISHED)
    lab.check("failed acts", sum(row["failed"] for row in rows), equal=0)
    lab.check(
        f"share of the network alone, {counts[-1]} robots",
        rows[-1]["of_network"],
        least=0.9,
        speed=True,
    )


@contextlib.contextmanager
def robots(url: str, contract: Contract | None, count: int) -> Iterator[list[Any]]:
    """Run robots within a context, and yield the pipes to their processes, which are connected."""
    with piped_processes(_drive, [(url, contract, seed) for seed in range(count)]) as pipes:
        yield pipes


def act_together(pipes: Sequence[Any], seconds: float) -> dict[str, Any]:
    """Let robots act at the same time; return their combined figures, with the times of the slowest
    robot.
    """
    for pipe in pipes:
        pipe.send(seconds)
    figures = [pipe.recv() for pipe in pipes]
    return {
        "acts": sum(one["acts"] for one in figures),
        "failed": sum(one["failed"] for one in figures),
        "acts_per_s": sum(one["acts_per_s"] for one in figures),
        "median_ms": max(one["median_ms"] for one in figures),
        "p99_ms": max(one["p99_ms"] for one in figures),
        "worst_ms": max(one["worst_ms"] for one in figures),
        "errors": "; ".join(sorted({one["errors"] for one in figures if one["errors"]})),
    }


def _drive(pipe: Any, url: str, contract: Contract | None, seed: int) -> None:
    """Call the policy repeatedly for each duration, s, that arrives on the pipe, and send the
    figures back, until the pipe is closed.

    This function runs in a separate process.
    """
    die_with_parent()
    from vlagents_ray.client import RemoteAgent

    agent = RemoteAgent(url, transport="websocket", codec="jpeg", connect_timeout_s=60)
    obs = view(contract, seed)
    agent.reset(obs, INSTRUCTION, seed=seed)
    agent.act(obs)
    pipe.send("connected")
    with contextlib.suppress(EOFError), Acting([partial(agent.act, obs)]) as acting:
        while True:
            acting.pause()
            seconds = pipe.recv()
            acting.resume()
            pipe.send(acting.during(partial(time.sleep, seconds), 2))
    agent.close()
