"""The peers' Python environment."""

from __future__ import annotations

import subprocess
import sys
import venv
from collections.abc import Callable
from pathlib import Path

from vlagents_ray.bench.ways import REQUIREMENTS
from vlagents_ray.errors import ConfigError


def python_in(folder: Path) -> Path:
    """The Python of the environment in `folder`."""
    return folder / "bin" / "python"


def set_up(folder: Path, tell: Callable[[str], None] = lambda _: None) -> Path:
    """Make the environment, or bring it to the pinned versions; returns its Python.

    The peers need packages that ours conflict with, so nothing of ours is in it. Raises `ConfigError` with pip's
    last words if that fails.
    """
    python = python_in(folder)
    if not python.exists():
        if folder.exists() and any(folder.iterdir()):
            raise ConfigError(f"--dir {folder}: is there and holds no Python environment; name another folder")
        tell(f"making {folder} with Python {sys.version.split()[0]}")
        venv.create(folder, with_pip=True)
    tell(f"installing {REQUIREMENTS.name}")
    command = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "-r", str(REQUIREMENTS)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - pip of that environment
    if done.returncode != 0:
        raise ConfigError(f"pip could not install {REQUIREMENTS}:\n{done.stderr.strip()[-2000:]}")
    return python
