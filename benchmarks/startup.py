"""Measures the time from a command to its first episode or action, and to its end, with a cold
start; our commands and vla-eval's alternate.

- `eval --workers 0` and `eval --workers 1`: `vlagents-ray eval` of a policy that does nothing, in
  one process and with Ray and Serve;
- vla-eval: its model server with the same policy, and one `vla-eval run` of the same episodes of
  the same environment;
- `serve`: `vlagents-ray serve noop`, until a client on this machine has an action, and until Ctrl-C
  has ended it.

The first is the first reset of an environment, or the first action of the server.
"""

from __future__ import annotations

import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.console import Out, save, show_skipped
from benchmarks.evaluation import EvaluationPlan, alone, our_run, play, their_runs
from benchmarks.own_clients import observation
from benchmarks.peers import PYTHON, SCRIPTS, PeersPython, peer_clients
from vlagents_ray import RemoteAgent
from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.serve.ports import LOOPBACK, free_port

PEER, SERVE = "vla-eval", "serve noop"
_LONGEST_S = 120.0  # time limit for a server to start or end, s
_COMMAND = [sys.executable, "-c", "from vlagents_ray.cli import main; main()"]

Seconds = tuple[float, float]  # times to the first episode or action, and to the end, s


def measure_startup(
    plan: EvaluationPlan, peers_python: Path, progress: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Measure all commands, and return plain JSON values. vla-eval is in `skipped`, with the
    reason, if it cannot run here.
    """
    found, skipped, _ = peer_clients([PEER], peers_python)
    rounds: dict[str, list[Seconds]] = {}
    with tempfile.TemporaryDirectory() as top:
        runs = {f"eval --workers {n}": our_run(replace(plan, workers=n)) for n in (0, 1)}
        scripts = {way.peer: SCRIPTS / way.script for way in found}
        runs |= their_runs(replace(plan, workers=1), scripts, peers_python, alone(Path(top)))
        for number in range(plan.rounds):
            for name, run in runs.items():
                played = play(plan, run, Path(top) / f"{name} {number}")
                rounds.setdefault(name, []).append((played.first_s or 0.0, played.wall_s))
            rounds.setdefault(SERVE, []).append(serve_once())
            progress(
                f"round {number + 1}/{plan.rounds}: "
                f"{ ({name: each[-1] for name, each in rounds.items()}) }"
            )
    medians = {
        name: [statistics.median(column) for column in zip(*each, strict=True)]
        for name, each in rounds.items()
    }
    return {
        "plan": asdict(plan),
        "cores": os.cpu_count(),
        "skipped": skipped,
        "rounds": rounds,
        "medians": medians,
    }


def serve_once() -> Seconds:
    """Serve a policy that does nothing until it has acted once, then end it."""
    port, obs, begun = free_port(), observation(), time.monotonic()
    with subprocess.Popen(
        [*_COMMAND, "serve", "noop", "--port", str(port)], stdout=subprocess.DEVNULL
    ) as process:
        try:
            with RemoteAgent(f"http://{LOOPBACK}:{port}", connect_timeout_s=_LONGEST_S) as agent:
                agent.reset(obs, "measure")
                agent.act(obs)
            first_s = time.monotonic() - begun
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(_LONGEST_S)
    return first_s, time.monotonic() - begun


def show_startup(found: Mapping[str, Any]) -> None:
    """Print a row for each command."""
    rows = table("", "first s", "whole command s")
    rows.title = (
        f"{found['plan']['episodes']} episodes, {found['cores']} cores, medians of "
        f"{found['plan']['rounds']}"
    )
    for name, (first_s, whole_s) in found["medians"].items():
        rows.add_row(name, f"{first_s:.2f}", f"{whole_s:.2f}")
    out.print(rows)
    show_skipped(found)


def main(
    episodes: Annotated[int, typer.Option(min=1)] = 20,
    rounds: Annotated[int, typer.Option(min=1)] = 5,
    peers_python: PeersPython = PYTHON,
    out_file: Out = None,
) -> None:
    """Measure how long evaluations and a server take with a cold start, ours and vla-eval's."""
    with errors():
        found = measure_startup(EvaluationPlan(episodes, 0, rounds), peers_python, progress)
    show_startup(found)
    save(found, out_file)


if __name__ == "__main__":
    typer.run(main)
