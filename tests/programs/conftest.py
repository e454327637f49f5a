"""These tests use the current versions on package indexes. Only `make programs` and `make rays` run
them, each night.
"""

from __future__ import annotations

from pathlib import Path

import pytest


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    return None if config.getoption("--verified") else True


def pytest_itemcollected(item: pytest.Item) -> None:
    item.add_marker("integration")
