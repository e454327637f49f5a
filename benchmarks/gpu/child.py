"""π0 in a child process behind the replica, like policies that need another Python."""

from __future__ import annotations

import os
import sys
from typing import Any

from benchmarks.gpu.lab import Lab, view
from benchmarks.measured_policy import MeasuredPolicy
from vlagents_ray.interface import Agent
from vlagents_ray.policies.wrapper import build_agent
from vlagents_ray.serve.python_env.child_agent import ChildAgent
from vlagents_ray.serve.python_env.child_main import Settings
from vlagents_ray.serve.python_env.child_process import ChildProgram


def child(lab: Lab) -> None:
    """Full batches of π0 in this process and in a child process, with as many sessions as rows, and
    with twice as many, half of which are prepared while the others are computed.
    """
    size = lab.size(8, 2)
    sizes = [1, size]
    config = lab.settings(max_rows=size, compile=lab.size("graphs", False), batch_sizes=sizes)
    settings = Settings("pi0", config, size, "1")
    environment = {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    agents: dict[str, Agent] = {
        "this process": build_agent("pi0", config),
        "a child process": ChildAgent(ChildProgram(sys.executable, settings, environment)),
    }
    rows: list[dict[str, Any]] = []
    for place, agent in agents.items():
        with MeasuredPolicy(agent, view, max_size=size, patience=0.1) as measured:
            seconds = lab.size(2.0, 0.05)
            bare = measured.bare(size, seconds)
            for sessions in (size, 2 * size):
                turn = measured.queued(sessions, seconds, "robot")
                rows.append(
                    {
                        "policy in": place,
                        "rows": size,
                        "sessions": sessions,
                        "bare_ms": bare["batch_ms"],
                        "queued_ms": 1e3 * turn.mean_batch / max(turn.actions_per_s, 1e-9),
                        "actions_per_s": turn.actions_per_s,
                        "mean_batch": turn.mean_batch,
                        "gpu_ms": _pass_ms(measured),
                        **_memory(measured),
                    }
                )
                lab.show(processes=rows)
    here, there = (row["actions_per_s"] for row in rows if row["sessions"] == 2 * size)
    lab.check("actions a second of a child, of this process", there / here, least=0.95, speed=True)
    lab.check(
        "the child reports the memory of its GPU",
        bool(rows[-1].get("reserved_mib")),
        equal=not lab.dry,
    )
    lab.check(
        "the child reports the times of its forward passes",
        rows[-1]["gpu_ms"] is not None,
        equal=not lab.dry,
    )


def _pass_ms(measured: MeasuredPolicy) -> float | None:
    """Return the GPU's time of the last forward pass that the replica reports."""
    engine = measured.engine
    engine.collect_stats()
    return engine.stats.gpu_ms


def _memory(measured: MeasuredPolicy) -> dict[str, float]:
    """Return the memory that the replica reports."""
    memory = measured.engine.model.gpu_memory()
    return {f"{kind}_mib": size / 2**20 for kind, size in memory.items() if kind != "free"}
