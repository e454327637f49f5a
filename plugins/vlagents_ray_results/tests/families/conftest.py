"""Tests of a model family run in the environment of that family, some with the source of its
authors.

`make families` runs them; in other environments they are left out.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from family_folders import not_here

collect_ignore = not_here(Path(__file__).parent)


def pytest_itemcollected(item: pytest.Item) -> None:
    """Each of them loads torch or JAX, some a simulator; of these folders alone."""
    item.add_marker("sim")
