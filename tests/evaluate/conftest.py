from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from eval_fakes import LINE, PYTHONPATH
from in_process_evaluation import flat_config

from vlagents_ray.evaluate import EvalConfig

WORKER_PATH = {"env_vars": {"PYTHONPATH": PYTHONPATH}}


@pytest.fixture
def config(tmp_path: Path) -> Callable[..., EvalConfig]:
    """Settings of a small evaluation of `Line` in a folder of this test's own."""

    def make(**changes: Any) -> EvalConfig:
        settings = {"envs": [LINE], "episodes": 6, "workers": 2, "out": tmp_path / "out", "video": "none"}
        return flat_config(**settings | {"env_timeout_s": 5, "runtime_env": WORKER_PATH} | changes)

    return make
