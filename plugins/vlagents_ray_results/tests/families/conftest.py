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
    """Mark the tests in these folders as `sim`: each loads torch or JAX, and some load a
    simulator.
    """
    item.add_marker("sim")
