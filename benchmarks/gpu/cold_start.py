"""Measures the time from the start of a process to the first action of its policy: `python -m
benchmarks.gpu.cold_start JSON`, with the settings of π0 and the number of rows.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer

from benchmarks.gpu.lab import Lab, view

_ROOT = Path(__file__).resolve().parents[2]


def cold_start(name: str, config: Mapping[str, Any]) -> dict[str, Any]:
    """Start a process that loads π0 and computes one action; return the seconds of each part."""
    command = [sys.executable, "-m", "benchmarks.gpu.cold_start", json.dumps(config)]
    begun = time.perf_counter()
    done = subprocess.run(command, cwd=_ROOT, capture_output=True, text=True, check=False)
    took_s = time.perf_counter() - begun
    sys.stdout.write(done.stderr)
    if done.returncode != 0:
        raise RuntimeError(f"cold start of {name}: {done.stderr.strip()[-300:]}")
    parts = json.loads(done.stdout.splitlines()[-1])
    return {"mode": name, "seconds": took_s, **parts}


def cold_starts(lab: Lab) -> None:
    """Start π0 in eager mode, and with graphs of one and of five batch sizes."""
    sizes = lab.size([1, 2, 4, 8, 16], [1, 2])
    modes: dict[str, dict[str, Any]] = {
        "eager": {"compile": False, "max_rows": 1},
        "graphs, 1 size": {"compile": lab.graphs, "max_rows": 1, "batch_sizes": [1]},
        f"graphs, {len(sizes)} sizes": {
            "compile": lab.graphs,
            "max_rows": sizes[-1],
            "batch_sizes": sizes,
        },
    }
    if lab.dry:  # the processes would use the compiler themselves
        modes = {"eager": modes["eager"]}
    rows = []
    for name, changed in modes.items():
        rows.append(cold_start(name, lab.settings(**changed)))
        lab.show(starts=rows)
    lab.check("starts that were measured", len(rows), equal=len(modes))


def _act_once(config: Mapping[str, Any]) -> dict[str, float]:
    """Load π0 and compute one action; return the seconds of each part, without the start of the
    interpreter.
    """
    begun = time.perf_counter()
    from benchmarks.measured_policy import MeasuredPolicy
    from vlagents_ray.policies.wrapper import build_agent

    agent = build_agent("pi0", config)
    built = time.perf_counter()
    with MeasuredPolicy(agent, view, max_size=config["max_rows"]) as measured:
        loaded = time.perf_counter()
        measured.batch([0])()
        acted = time.perf_counter()
    return {"import_s": built - begun, "load_s": loaded - built, "first_act_s": acted - loaded}


if __name__ == "__main__":
    typer.echo(json.dumps(_act_once(json.loads(sys.argv[1]))))
