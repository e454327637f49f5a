"""Older versions of the peers' packages, beside those in their environment."""

from __future__ import annotations

from pathlib import Path

from peer_environment import FOLDER, peers_python

from vlagents_ray.serve.python_env.create import install


def package(requirement: str) -> Path:
    """A folder for PYTHONPATH with that version of a package, alone: what it needs is the environment's."""
    folder = FOLDER / requirement.replace("==", "-")
    done = folder / ".installed"
    if not done.exists():
        install(peers_python(), ["--no-deps", "--target", str(folder), requirement])
        done.touch()
    return folder
