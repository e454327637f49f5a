"""Older versions of the peers' packages, beside those in their environment."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from peers import FOLDER, peers_python


def package(requirement: str) -> Path:
    """A folder for PYTHONPATH with that version of a package, alone: what it needs is the environment's."""
    folder = FOLDER / requirement.replace("==", "-")
    done = folder / ".installed"
    if not done.exists():
        command = [str(peers_python()), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
        subprocess.run([*command, "--upgrade", "--target", str(folder), requirement], check=True, stdout=sys.stderr)
        done.touch()
    return folder
