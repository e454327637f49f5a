"""Tiny checkpoints, made once, and openpi's own policy on them."""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

Made = Callable[..., Any]
MARKS = [
    pytest.mark.source("OPENPI_SRC"),
    # ml_collections 1.0.0 has a pattern that is no raw string.
    pytest.mark.filterwarnings("ignore:invalid escape sequence:DeprecationWarning"),
    # flax 0.10.2 calls JAX in ways that 0.5.3 deprecates.
    pytest.mark.filterwarnings(
        "ignore:linear_util.wrap_init is missing a DebugInfo object:DeprecationWarning"
    ),
    pytest.mark.filterwarnings(
        "ignore:shape requires ndarray or scalar arguments:DeprecationWarning:flax.core.scope"
    ),
]


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> ModuleType:
    """The module that makes checkpoints, with its tokenizer where openpi looks for one."""
    from plugins.vlagents_ray_models.tests.families.openpi import tiny

    cache = tmp_path_factory.mktemp("cache")
    tiny.save_tokenizer(cache)
    os.environ["OPENPI_DATA_HOME"] = str(cache)
    return tiny


@pytest.fixture(scope="session")
def checkpoint(tiny: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return a function that writes the checkpoint of a kind once. Tests must not change it."""
    folders: dict[str, Path] = {}

    def get(kind: str) -> Path:
        if kind not in folders:
            folders[kind] = tiny.save(tmp_path_factory.mktemp(kind), kind)
        return folders[kind]

    return get


@pytest.fixture(scope="session")
def loaded(checkpoint: Callable[[str], Path]) -> Made:
    """Return a function that loads the policy of a kind once, in float32."""
    from vlagents_ray_models.openpi import OpenPi

    policies: dict[str, OpenPi] = {}

    def get(kind: str) -> OpenPi:
        if kind not in policies:
            settings = {
                "checkpoint": str(checkpoint(kind)),
                "config": f"plugins.vlagents_ray_models.tests.families.openpi.tiny:{kind.upper()}",
                "batch_sizes": [1] if kind == "aloha" else [1, 4],
                "steps": 4,
            }
            policy = OpenPi.from_config(settings)
            policy.initialize()
            policies[kind] = policy
        return policies[kind]

    return get


@pytest.fixture
def upstream(tiny: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Made:
    """Return a function that makes openpi's own policy of a checkpoint in float32, with
    `create_trained_policy`.
    """
    # openpi imports a LeRobot of a certain commit to read data, which only its training does.
    monkeypatch.setitem(sys.modules, "openpi.training.data_loader", ModuleType("data_loader"))
    sys.modules["openpi.training.data_loader"].DataLoader = object  # type: ignore[attr-defined]
    from openpi.policies import policy_config

    models = policy_config._model
    restore = models.restore_params
    monkeypatch.setattr(
        models,
        "restore_params",
        lambda path, **kwargs: restore(path, **kwargs | {"dtype": "float32"}),
    )

    def make(kind: str, folder: Path) -> Any:
        config = tiny.CONFIGS[kind]
        model = dataclasses.replace(config.model, dtype="float32")
        config = dataclasses.replace(config, model=model)
        settings = {} if kind == "fast" else {"num_steps": 4}
        return policy_config.create_trained_policy(config, folder, sample_kwargs=settings)

    return make
