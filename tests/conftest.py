"""What holds for every test."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from assets import assets
from browser import CHROMIUM
from cluster_hosts import no_hosts
from fail_on_skip import pytest_make_collect_report, pytest_runtest_makereport

from vlagents_ray.envs.headless import prepare_rendering

__all__ = ["pytest_make_collect_report", "pytest_runtest_makereport"]

# No test talks to the world; set before anything that reads them is imported.
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("WANDB_MODE", "offline")
prepare_rendering()
if (simpler := assets("simpler")) is not None:
    os.environ.setdefault("MS_ASSET_DIR", str(simpler))  # ManiSkill reads it once a process


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip what this machine cannot run; the Vulkan device is looked for when the first test wants it."""
    if item.get_closest_marker("gpu") and not any(Path("/dev").glob("nvidia[0-9]*")):
        pytest.skip("no NVIDIA GPU")
    for marker in item.iter_markers("source"):
        [variable] = marker.args
        if not os.environ.get(variable):
            pytest.skip(f"{variable} names no checkout of this family's source")
    for marker in item.iter_markers("assets"):
        [simulator] = marker.args
        if assets(simulator) is None:
            pytest.skip(f"no assets of {simulator}: VLAGENTS_RAY_ASSETS names their folder")
    if item.get_closest_marker("hosts") and (reason := no_hosts()):
        pytest.skip(reason)
    if item.get_closest_marker("browser") and CHROMIUM is None:
        pytest.skip("no Chromium")
    if item.get_closest_marker("vulkan"):
        from vlagents_ray.envs.maniskill import ManiSkill

        missing = ManiSkill.missing()
        if missing:
            pytest.skip(missing)
