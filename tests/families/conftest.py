"""Tests of a model family run in the environment of that family, some with the source of its authors.

`make families` runs them; in other environments they are left out.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from vlagents_ray.registry import ENVS, POLICIES

# folder -> the packages without which its tests cannot be imported; the authors' source may come from a checkout
_NEEDS = {name: one.needs[bool(one.checkouts) :] for name, one in (POLICIES | ENVS).items()} | {
    "arro": ("transformers", "torch"),
    "ros": ("rclpy",),
    "torchrl": ("torchrl",),
}

_FOLDERS = {test.parent.name for test in Path(__file__).parent.glob("*/test_*.py")}
collect_ignore = [folder for folder in _FOLDERS if not all(map(importlib.util.find_spec, _NEEDS[folder]))]


def pytest_itemcollected(item: pytest.Item) -> None:
    """Each of them loads torch or JAX, some a simulator; of these folders alone."""
    item.add_marker("sim")
