"""Processes of a step, each with a pipe to this one."""

from __future__ import annotations

import contextlib
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from benchmarks.gpu.lab import LATE_S


@contextlib.contextmanager
def piped_processes(
    run: Callable[..., None], arguments: Sequence[tuple[Any, ...]]
) -> Iterator[list[Any]]:
    """Run processes within a context, and yield the pipes to them once each process has reported
    that it is ready.

    Args:
        run: The function of a process, which is called with its end of the pipe and the further
            arguments.
        arguments: The further arguments of each process.
    """
    context = multiprocessing.get_context("spawn")
    pipes, processes = [], []
    try:
        for further in arguments:
            ours, theirs = context.Pipe()
            process = context.Process(target=run, args=(theirs, *further), daemon=True)
            process.start()
            theirs.close()
            pipes.append(ours)
            processes.append(process)
        for pipe in pipes:
            pipe.recv()
        yield pipes
    finally:
        for pipe in pipes:
            pipe.close()
        for process in processes:
            process.join(LATE_S)
