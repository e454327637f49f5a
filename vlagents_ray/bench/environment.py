"""The peers' Python environment."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from vlagents_ray.bench.ways import REQUIREMENTS
from vlagents_ray.serve.environments.making import create, install


def set_up(folder: Path, tell: Callable[[str], None] = lambda _: None) -> Path:
    """Make the environment, or bring it to the pinned versions; returns its Python.

    The peers need packages that ours conflict with, so nothing of ours is in it. Raises `ConfigError` with uv's
    last words if that fails.
    """
    python = create(folder, tell=tell)
    tell(f"installing {REQUIREMENTS.name}")
    install(python, ["--requirement", str(REQUIREMENTS)])
    return python
