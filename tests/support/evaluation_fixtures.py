"""Fixtures of tests of evaluations, for conftest.py of this package and of plug-ins."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from eval_fakes import LINE, PYTHONPATH
from in_process_evaluation import flat_config

from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.evaluate.results.store import Store

WORKER_PATH = {"env_vars": {"PYTHONPATH": PYTHONPATH}}


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
        }
        return flat_config(**settings | {"env_timeout_s": 5, "runtime_env": WORKER_PATH} | changes)

    return make


@pytest.fixture(scope="module", autouse=True)
def commits_reach_the_disk() -> Iterator[None]:
    """They do not, which takes 5 to 25 ms each; a module that is about it overrides this
    fixture.
    """
    opened = Store._open

    def without_waiting(store: Store) -> sqlite3.Connection:
        db = opened(store)
        db.execute("PRAGMA synchronous = OFF")
        return db

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Store, "_open", without_waiting)
        yield
