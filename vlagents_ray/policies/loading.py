"""The report of a policy that is being loaded, and the batch sizes for which it is compiled.

A server opens a `loading_report` around `Agent.initialize`; without one, progress is only logged.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, Literal

from vlagents_ray.policies.row_limit import RowLimit

logger = logging.getLogger(__name__)

# Whether the bits of an action must not depend on its batch; "auto": if the policy supports it.
Invariant = bool | Literal["auto"]

COMPILED_SIZES = (1, 2, 4, 8, 16)  # used if no server sets its batch sizes


@dataclass(slots=True)
class LoadingReport:
    """The report of one policy."""

    on_progress: Callable[[str], None]  # called with each step, on the loading thread
    batch_sizes: Sequence[int]  # the batch sizes of the server, ascending
    # Whether the server requires that the bits of an action do not depend on its batch. Then
    # `batch_sizes` is the one size of all forward passes.
    invariant: bool = False
    # With `invariant`, why the bits of an action may depend on its batch; None if they do not.
    variation: str | None = None
    # Parts that run without compilation, although `compile` is set.
    uncompiled: list[str] = field(default_factory=list)
    # Descriptions of the models' devices, see `accelerator.torch_device`.
    devices: list[dict[str, Any]] = field(default_factory=list)
    # Rows of a forward pass that fit into memory.
    row_limit: RowLimit = field(default_factory=RowLimit)
    # Whether the policy pads batches to its sizes, so that the server does not pad them.
    pads: bool = False
    # The number of rows of a forward pass -> the shortest duration so far, s.
    pass_s: dict[int, float] = field(default_factory=dict)
    # Whether a batch is split into the passes with the shortest total time.
    splits_by_time: bool = False
    # Called whenever a forward pass does not fit into memory, also after loading.
    on_out_of_memory: Callable[[], None] = lambda: None
    # Called with the time of each forward pass on a GPU.
    on_gpu_ms: Callable[[float], None] = lambda _: None
    # A function that returns the context of a forward pass.
    timer: Callable[[], AbstractContextManager[None]] = nullcontext

    @property
    def accelerated(self) -> bool:
        """Whether a model runs on a device other than a CPU."""
        return any(device["kind"] != "cpu" for device in self.devices)


_report: ContextVar[LoadingReport | None] = ContextVar("_report", default=None)


@contextmanager
def loading_report(
    on_progress: Callable[[str], None],
    batch_sizes: Sequence[int] = COMPILED_SIZES,
    on_out_of_memory: Callable[[], None] = lambda: None,
    on_gpu_ms: Callable[[float], None] = lambda _: None,
    *,
    invariant: bool = False,
) -> Iterator[LoadingReport]:
    """Yield the report of the policy that is loaded in this context.

    The arguments are fields of `LoadingReport`.
    """
    report = LoadingReport(
        on_progress,
        batch_sizes,
        invariant,
        on_out_of_memory=on_out_of_memory,
        on_gpu_ms=on_gpu_ms,
    )
    token = _report.set(report)
    try:
        yield report
    finally:
        _report.reset(token)


@contextmanager
def current_report() -> Iterator[LoadingReport]:
    """Yield the report of this context, or a new one if no server has opened one."""
    report = _report.get()
    if report is not None:
        yield report
        return
    with loading_report(lambda _: None) as report:
        yield report


def report_progress(step: str) -> None:
    """Log and report a step of a long start, such as "compiling for 4 rows (3 of 5)"."""
    logger.info("%s", step)
    report = _report.get()
    if report is not None:
        report.on_progress(step)


def report_device(device: dict[str, Any]) -> None:
    """Log and report a device on which a policy computes."""
    logger.info("device: %s", device)
    report = _report.get()
    if report is not None and device not in report.devices:
        report.devices.append(device)


def report_variation(variation: str | None) -> None:
    """Report why the bits of an action may depend on its batch; None if they do not.

    Without `invariant`, this does nothing.
    """
    report = _report.get()
    if report is not None and report.invariant:
        report.pads, report.variation = True, variation


def report_uncompiled(part: str) -> None:
    """Log and report a part that runs uncompiled, although the settings require compilation."""
    logger.warning("not compiled: %s", part)
    report = _report.get()
    if report is not None:
        report.uncompiled.append(part)
