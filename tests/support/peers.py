"""The environment of other systems' packages, which conflict with ours; made when a test first wants it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from vlagents_ray.bench.environment import python_in, set_up
from vlagents_ray.bench.ways import REQUIREMENTS

FOLDER = Path(os.environ.get("VLAGENTS_RAY_PEERS", Path(__file__).parent.parent.parent / ".venv-peers"))


def peers_python() -> Path:
    """Its Python, with every package at the version that the benchmark pins."""
    stamp = FOLDER / ".requirements"
    wanted = REQUIREMENTS.read_text()
    if not stamp.is_file() or stamp.read_text() != wanted:
        set_up(FOLDER)
        stamp.write_text(wanted)
    return python_in(FOLDER)


def package(requirement: str) -> Path:
    """A folder for PYTHONPATH with another version of a package, alone: what it needs is the environment's."""
    folder = FOLDER / requirement.replace("==", "-")
    done = folder / ".installed"
    if not done.exists():
        command = [str(peers_python()), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
        subprocess.run([*command, "--upgrade", "--target", str(folder), requirement], check=True, stdout=sys.stderr)
        done.touch()
    return folder
