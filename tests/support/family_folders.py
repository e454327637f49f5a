"""The folders of tests that need the Python environment of a model family or a simulator."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from vlagents_ray.registry import entries

# The packages without which the tests of each folder cannot be imported. A checkout may provide the
# authors' source.
_NEEDS = {
    name: entry.needs[bool(entry.checkouts) :]
    for name, entry in (entries("policies") | entries("envs")).items()
}
_NEEDS |= {
    "arro": ("transformers", "torch"),
    "ros": ("rclpy",),
    "torchrl": ("torchrl",),
}


def not_here(families: Path) -> list[str]:
    """Return the names of the folders in `families` whose tests cannot be imported in this
    environment.
    """
    folders = {test.parent.name for test in families.glob("*/test_*.py")}
    return [folder for folder in folders if not all(map(importlib.util.find_spec, _NEEDS[folder]))]
