"""The option that records the traces."""

from __future__ import annotations

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--record",
        action="store_true",
        help="write the traces of tests/golden again, before all tests",
    )


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--record", False):
        from tests.golden.record import record

        record()
