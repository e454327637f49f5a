"""Tests of a model family run in the environment of that family, some with the source of its authors.

`make families` runs them; in other environments they are left out.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
from verified import VerifyingTests

# folder -> the package without which its tests cannot be imported
_NEEDS = {
    "arro": "transformers",
    "calvin": "pybullet",
    "diffusion_policy": "diffusers",
    "gr00t": "diffusers",
    "lerobot": "lerobot",
    "libero": "libero",
    "octo": "jax",
    "openpi": "jax",
    "openvla": "transformers",
    "pi0": "transformers",
    "rcs": "rcs",
    "robocasa": "robocasa",
    "robosuite": "robosuite",
    "ros": "rclpy",
    "vjepa2_ac": "transformers",
}

_FOLDERS = {test.parent.name for test in Path(__file__).parent.glob("*/test_*.py")}
collect_ignore = [folder for folder in _FOLDERS if importlib.util.find_spec(_NEEDS[folder]) is None]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--verified", action="store_true", help="note what tests marked `verifies` verified, in verified.json"
    )


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--verified", False):
        config.pluginmanager.register(VerifyingTests())


def pytest_itemcollected(item: pytest.Item) -> None:
    """Each of them loads torch or JAX, some a simulator; of these folders alone."""
    item.add_marker("sim")
