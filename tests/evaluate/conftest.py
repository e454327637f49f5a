from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).parent
sys.path.append(str(HERE))  # for `eval_fakes`, which workers find by PYTHONPATH

import ray  # noqa: E402
from eval_fakes import LINE  # noqa: E402

from vlagents_ray.evaluate import EvalConfig  # noqa: E402

WORKER_PATH = {"env_vars": {"PYTHONPATH": f"{HERE}:{HERE.parent.parent}"}}


@pytest.fixture
def config(tmp_path: Path) -> Callable[..., EvalConfig]:
    """Settings of a small evaluation of `Line` in a folder of this test's own."""

    def make(**changes: Any) -> EvalConfig:
        settings = {
            "envs": [LINE],
            "episodes": 6,
            "workers": 2,
            "out": tmp_path / "out",
            "video": "none",
            "env_timeout_s": 5,
            "runtime_env": WORKER_PATH,
        }
        return EvalConfig(**(settings | changes))

    return make


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
    """A local Ray cluster for the tests of one file."""
    ray.init(num_cpus=4, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    yield
    ray.shutdown()
