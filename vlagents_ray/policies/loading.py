"""What a policy reports while it loads: the step that it is at, and what it could not compile.

A server opens a `loading_report` around `Agent.initialize`; without one, progress is only logged.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

logger = logging.getLogger(__name__)


@dataclass(slots=True)
class LoadingReport:
    """The report of one policy."""

    on_progress: Callable[[str], None]  # called with each step, on the thread that loads
    uncompiled: list[str] = field(default_factory=list)  # what runs without compilation, although `compile` is set


_report: ContextVar[LoadingReport | None] = ContextVar("_report", default=None)


@contextmanager
def loading_report(on_progress: Callable[[str], None]) -> Iterator[LoadingReport]:
    """Yield the report of the policy that is loaded in this context."""
    report = LoadingReport(on_progress)
    token = _report.set(report)
    try:
        yield report
    finally:
        _report.reset(token)


def report_progress(step: str) -> None:
    """Log the step of a long start, such as "compiling for 4 rows (3 of 5)", and report it."""
    logger.info("%s", step)
    if (report := _report.get()) is not None:
        report.on_progress(step)


def report_uncompiled(what: str) -> None:
    """Report a part that runs without compilation, although its policy's settings ask for it."""
    if (report := _report.get()) is not None:
        report.uncompiled.append(what)
