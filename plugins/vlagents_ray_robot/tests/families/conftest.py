"""Tests of robots that need LeRobot's environment or a ROS 2.

`make families` runs them; in other environments they are left out.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from family_folders import not_here

collect_ignore = not_here(Path(__file__).parent)


def pytest_itemcollected(item: pytest.Item) -> None:
    """Each of them loads torch or a ROS 2; of these folders alone."""
    item.add_marker("sim")
