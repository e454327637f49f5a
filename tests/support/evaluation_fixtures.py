"""Fixtures for tests of evaluations, which conftest.py of this package and of plug-ins imports."""

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
    """Return the settings of a small evaluation of `Line`, with results in the test's own
    folder.
    """

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
    """Replace the sync of each commit to the disk, which takes 5 to 25 ms, by nothing. A module
    that tests the sync overrides this fixture.
    """
    opened = Store._open

    def without_waiting(store: Store) -> sqlite3.Connection:
        db = opened(store)
        db.execute("PRAGMA synchronous = OFF")
        return db

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Store, "_open", without_waiting)
        yield
