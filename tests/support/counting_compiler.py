"""A backend of torch.compile that runs Dynamo's traced graph in eager mode. It counts the programs
that it makes, and can change their results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest
import torch

from vlagents_ray.policies.compilation import Compilation


class CountingCompiler:
    """Returns programs that run uncompiled, since the real compiler would take minutes."""

    def __init__(self) -> None:
        self.rows: list[int] = []  # number of rows of each program
        # Changes to the results of programs, by number of rows.
        self.change: dict[int, Callable[[Any], Any]] = {}
        self.calls = 0  # number of calls of programs

    def __call__(self, graph: Any, examples: Sequence[Any]) -> Callable[..., Any]:
        rows = next(
            len(one) for one in examples if not isinstance(one, torch.nn.Parameter) and one.ndim
        )
        self.rows.append(rows)

        def program(*inputs: Any) -> Any:
            self.calls += 1
            return [self.change.get(rows, lambda result: result)(one) for one in graph(*inputs)]

        return program


@contextmanager
def counting_compiler() -> Iterator[CountingCompiler]:
    """Let all policies compile with a new `CountingCompiler`."""
    with pytest.MonkeyPatch.context() as patch:
        compiler = CountingCompiler()
        patch.setattr(Compilation, "backend", compiler)
        yield compiler
    torch._dynamo.reset()
