from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import ray
from eval_fakes import LINE, PYTHONPATH
from flat_config import flat_config

from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.ray_tools.session import start_ray

WORKER_PATH = {"env_vars": {"PYTHONPATH": PYTHONPATH}}


def pytest_itemcollected(item: pytest.Item) -> None:
    """Mark whatever uses the cluster."""
    if "cluster" in getattr(item, "fixturenames", ()):
        item.add_marker("ray")


@pytest.fixture
def config(tmp_path: Path) -> Callable[..., EvalConfig]:
    """Settings of a small evaluation of `Line` in a folder of this test's own."""

    def make(**changes: Any) -> EvalConfig:
        settings = {"envs": [LINE], "episodes": 6, "workers": 2, "out": tmp_path / "out", "video": "none"}
        return flat_config(**settings | {"env_timeout_s": 5, "runtime_env": WORKER_PATH} | changes)

    return make


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
    """A local Ray cluster for the tests of one file."""
    start_ray(num_cpus=4, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    yield
    ray.shutdown()
