"""One tiny checkpoint of each kind for all tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from plugins.vlagents_ray_models.tests.families.octo import tiny

MARKS = [
    pytest.mark.source("OCTO_SRC"),
    # JAX 0.4.20, flax 0.7.5, tensorflow-probability 0.23 and Octo itself use what was deprecated
    # since.
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]


@pytest.fixture(scope="session")
def pretrained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny.save(tmp_path_factory.mktemp("octo") / "pretrained")


@pytest.fixture(scope="session")
def finetuned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny.save(tmp_path_factory.mktemp("octo") / "finetuned", "finetuned", "L1ActionHead")
