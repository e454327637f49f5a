"""The pytest option that records the traces."""

from __future__ import annotations

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--record",
        action="append",
        metavar="FILE",
        help="write this file of tests/golden again before all tests, such as endpoints/own_port; "
        "'all' stands for all files; may be repeated",
    )


def pytest_configure(config: pytest.Config) -> None:
    files = config.getoption("--record", None)
    if files is None:
        return

    from tests.golden.record import record

    try:
        record(files)
    except ValueError as error:
        raise pytest.UsageError(str(error)) from error
