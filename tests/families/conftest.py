"""Tests of a model family run in the environment of that family, some with the source of its authors."""

from __future__ import annotations

import os

import pytest


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "source(variable): needs the checkout that this variable names")


def pytest_runtest_setup(item: pytest.Item) -> None:
    for marker in item.iter_markers("source"):
        [variable] = marker.args
        if not os.environ.get(variable):
            pytest.skip(f"{variable} names no checkout of this family's source")
