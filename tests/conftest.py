"""What holds for every test."""

from __future__ import annotations

from fail_on_skip import pytest_make_collect_report, pytest_runtest_makereport

__all__ = ["pytest_make_collect_report", "pytest_runtest_makereport"]
