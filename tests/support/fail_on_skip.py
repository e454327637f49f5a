"""On CI a test that skips itself has failed: `VLAGENTS_FAIL_ON_SKIP=1` makes it so.

CI installs all that tests need but a GPU, sources and assets that are on no package index, a browser where apt has
none, and libraries that others load wherever they are installed: only tests marked `gpu`, `source`, `assets`, `browser`
and `library` may be skipped there.
tests/conftest.py takes the two hooks from here.
"""

from __future__ import annotations

import os
from collections.abc import Generator
from typing import TypeVar

import pytest

_MAY_BE_MISSING = ("gpu", "source", "assets", "browser", "library")
Report = TypeVar("Report", pytest.CollectReport, pytest.TestReport)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    return report if any(item.get_closest_marker(marker) for marker in _MAY_BE_MISSING) else _failed_if_skipped(report)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    return _failed_if_skipped((yield))


def _failed_if_skipped(report: Report) -> Report:
    expected_failure = hasattr(report, "wasxfail")  # pytest counts it as skipped, too
    if report.skipped and not expected_failure and os.environ.get("VLAGENTS_FAIL_ON_SKIP") == "1":
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome = "failed"
        report.longrepr = f"unexpected skip (VLAGENTS_FAIL_ON_SKIP=1): {reason}"
    return report
