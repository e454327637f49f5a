"""Python environments with clients of other systems from PyPI. Some of their requirements conflict
with this package's.

The environments are `.venv-peers` and `.venv-peers-torch` of this checkout, which the benchmark
also uses, and `.venv-peers-NAME` for single programs. Each is created at its first use.
"""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.peers import REQUIREMENTS, TORCH, TORCH_REQUIREMENTS, set_up
from vlagents_ray.serve.python_env.create import create, find_python, install, python_in

FOLDER = Path(os.environ.get("VLAGENTS_PEERS", Path(__file__).parents[2] / ".venv-peers"))
CLIENTS = Path(__file__).with_name("peer_clients.py")


def peers_python(environment: str = "") -> Path:
    """Return the Python of `.venv-peers`, or of `.venv-peers-torch` if `environment` is `TORCH`,
    with the pinned packages.
    """
    requirements = TORCH_REQUIREMENTS if environment == TORCH else REQUIREMENTS
    return _made(environment, requirements.read_text(), lambda folder: set_up(folder, requirements))


def environment(name: str, wanted: Sequence[str], python: str) -> Path:
    """Return the Python of an environment for one program. `wanted` are arguments of `uv pip
    install`.
    """

    def make(folder: Path) -> None:
        install(create(folder, find_python(python)), wanted)

    return _made(f"-{name}", "\n".join(wanted), make)


def _made(end: str, wanted: str, make: Callable[[Path], object]) -> Path:
    folder = FOLDER.with_name(FOLDER.name + end)
    stamp = folder / "installed.txt"
    if not stamp.is_file() or stamp.read_text() != wanted:
        make(folder)
        stamp.write_text(wanted)
    return python_in(folder)


def drive(
    python: Path, client: str, *words: object, script: Path = CLIENTS, timeout_s: float = 120
) -> Any:
    """Run a client of `peer_clients.py` or of another script, and return the JSON in its last line.
    A failure of the client raises an error here.
    """
    command = [str(python), str(script), client, *map(str, words)]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=timeout_s)
    assert done.returncode == 0, (
        f"{client} ended with {done.returncode}:\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
    )
    return json.loads(done.stdout.splitlines()[-1])


def package(requirement: str) -> Path:
    """Return a folder for PYTHONPATH with that version of a package, without its requirements,
    which the environment provides.
    """
    folder = FOLDER / requirement.replace("==", "-")
    done = folder / ".installed"
    if not done.exists():
        install(peers_python(), ["--no-deps", "--target", str(folder), requirement])
        done.touch()
    return folder
