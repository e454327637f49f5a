"""One tiny checkpoint of each kind for all tests."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import pytest

from tests.families.diffusion_policy import tiny


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The file of a kind, made when it is first asked for."""
    return lru_cache(lambda kind: tiny.save(tmp_path_factory.mktemp("diffusion_policy") / kind, kind))
