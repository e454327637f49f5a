"""An experiment with graphs that are replayed while other graphs are captured.

Inference calls wait for the captures of another checkpoint (`CaptureLock`), since waiting for a
whole device ends a capture on that device. An inference call that only replays graphs does not wait
in this way. This step tests whether such calls and captures disturb each other without the lock.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

from benchmarks.gpu.lab import Acting, Lab
from vlagents_ray.errors import PolicyFailed
from vlagents_ray.policies.act_stream import ActStream
from vlagents_ray.policies.base.accelerator import fetch
from vlagents_ray.policies.compilation import CudaGraph
from vlagents_ray.registry import require

_ROWS = 512  # rows of a square matrix; the kernel of a sum takes some microseconds
_OPERATIONS = 2000  # operations of each graph, about a fifth of those of π0
_CAPTURES = 5


def beside_captures(lab: Lab) -> None:
    """Replay a graph on one thread while another thread captures graphs."""
    if lab.dry:  # a CPU has no graphs
        lab.show(acts="not measured: a dry run")
        return
    torch = require("torch")
    inputs = [torch.ones(_ROWS, _ROWS, device=lab.device) for _ in range(2)]
    rows, errors = replays_beside_captures(*inputs, operations=_OPERATIONS, seconds=1.0)
    lab.show(acts=rows, errors="; ".join(errors) or "none")


def replays_beside_captures(
    acting_input: Any, captured_input: Any, *, operations: int, seconds: float
) -> tuple[list[dict[str, Any]], list[str]]:
    """Replay a graph again and again, alone and while graphs are captured.

    Args:
        acting_input: The tensor from which the replayed graph reads.
        captured_input: The input tensor of the captured graphs.
        operations: The number of operations of each graph.
        seconds: The time of the replays alone, s.

    Returns:
        The figures of the replays, alone and beside captures, and the errors of captures.
    """

    def small_kernels(values: Any) -> Any:
        for _ in range(operations):
            values = values + 1
        return values

    graph = CudaGraph(small_kernels, [acting_input])
    stream = ActStream(acting_input.device)
    sent = acting_input.clone()
    errors: list[str] = []

    def act() -> None:
        """Act like a policy whose core is a graph."""
        try:
            stream.run(lambda: fetch(graph(sent)))
        except RuntimeError as error:
            raise PolicyFailed(str(error)) from error

    def capture() -> None:
        for _ in range(_CAPTURES):
            try:
                CudaGraph(small_kernels, [captured_input])
            except RuntimeError as error:
                errors.append(str(error))

    with Acting([act]) as acting:
        alone = acting.during(partial(time.sleep, seconds))
        beside = acting.during(capture)
    rows = [
        {"while": "alone", **alone},
        {
            "while": "graphs are captured",
            **beside,
            "captures": _CAPTURES,
            "failed_captures": len(errors),
        },
    ]
    return rows, errors
