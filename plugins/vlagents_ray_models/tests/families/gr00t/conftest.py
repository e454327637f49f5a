"""GR00T's checkpoints: LeRobot's, made as its others are, or NVIDIA's own, by what is installed."""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

LEFT_OUT: dict[str, str] = {}  # why a file is not run here, for docs/policies/verification.md
if importlib.util.find_spec("lerobot") is not None:
    from plugins.vlagents_ray_models.tests.families.lerobot.conftest import loaded, made

    __all__ = ["loaded", "made"]
    LEFT_OUT |= dict.fromkeys(
        ("test_gr00t.py", "test_loading.py"),
        "it tests the policy `gr00t`, in an environment without LeRobot",
    )
else:
    LEFT_OUT |= {"test_groot.py": "it tests the policy `lerobot`, with LeRobot 0.6"}
collect_ignore = list(LEFT_OUT)

MARKS = [
    pytest.mark.source("GR00T_SRC"),
    # GR00T's transformer reads its settings as diffusers 0.35 deprecates.
    pytest.mark.filterwarnings("ignore:Accessing config attribute:FutureWarning"),
]
Checkpoint = Callable[[str], Path]
Policy = Callable[..., Any]


@pytest.fixture(scope="session")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the checkout with a small backbone. Its code is the one that is imported."""
    from plugins.vlagents_ray_models.tests.families.gr00t import tiny

    return tiny.checkout(tmp_path_factory.mktemp("gr00t") / "src")


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory: pytest.TempPathFactory, checkout: Path) -> Checkpoint:
    """The checkpoint of a kind, written once."""
    from plugins.vlagents_ray_models.tests.families.gr00t import tiny

    return functools.cache(
        lambda kind: tiny.save(tmp_path_factory.mktemp(kind) / "checkpoint", kind)
    )


@pytest.fixture(scope="session")
def policy_of(checkpoint: Checkpoint, checkout: Path) -> Policy:
    """A policy that has loaded a kind's checkpoint, once for all tests."""
    from vlagents_ray_models.gr00t import Gr00t

    @functools.cache
    def load(kind: str, **config: Any) -> Gr00t:
        policy = Gr00t.from_config(
            {"checkpoint": str(checkpoint(kind)), "source_dir": str(checkout), **config}
        )
        policy.initialize()
        return policy

    return load
