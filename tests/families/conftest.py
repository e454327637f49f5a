"""Tests of a model family run in the environment of that family, some with the source of its authors.

`make families` runs them; in other environments they are left out.
"""

from __future__ import annotations

import importlib.util
import os

import pytest

# folder -> the package without which its tests cannot be imported
_NEEDS = {
    "arro": "transformers",
    "diffusion_policy": "diffusers",
    "lerobot": "lerobot",
    "octo": "jax",
    "openpi": "jax",
    "openvla": "transformers",
    "pi0": "transformers",
    "vjepa2_ac": "transformers",
}

collect_ignore = [folder for folder, package in _NEEDS.items() if importlib.util.find_spec(package) is None]


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip what wants a checkout that is not there."""
    for marker in item.iter_markers("source"):
        [variable] = marker.args
        if not os.environ.get(variable):
            pytest.skip(f"{variable} names no checkout of this family's source")
