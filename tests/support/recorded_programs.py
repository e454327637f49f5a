"""Records the functions that programs of `torch.compile` call, without compiling them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch

from vlagents_ray.policies.compilation import Compilation


@contextmanager
def recorded_programs(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[list[str]]]:
    """Run the graphs that torch traces without compilation, during the context.

    Returns:
        For each program, the list of the functions that it calls.
    """
    programs: list[list[str]] = []

    def compile_graph(graph: Any, _: Any) -> Any:
        programs.append([str(node.target) for node in graph.graph.nodes])
        return graph.forward

    monkeypatch.setattr(Compilation, "backend", staticmethod(compile_graph))
    try:
        yield programs
    finally:
        torch._dynamo.reset()
