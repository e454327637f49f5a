"""Virtual environments for tests, created in seconds: after their own packages, they use the
packages of this environment.
"""

from __future__ import annotations

import site
from pathlib import Path

import vlagents_ray
from vlagents_ray.serve.python_env.create import create, install

ROOT = Path(vlagents_ray.__file__).parents[1]
NEEDS_NUMPY_2 = "pyarrow"  # Ray imports pyarrow if it is installed; a server does not need it


def ended(pid: int) -> bool:
    """Return whether the process has ended, even if its parent has not yet read the exit status."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return True
    return state in "ZX"


def layered(folder: Path, *requirements: str) -> Path:
    """Create an environment in `folder` with `requirements`, but without their dependencies, on top
    of this environment; return its Python.
    """
    python = create(folder)
    install(python, ["--no-deps", *requirements])
    below = folder / "below"
    below.mkdir()
    for packages in site.getsitepackages():
        for entry in Path(packages).iterdir():
            if not entry.name.startswith(NEEDS_NUMPY_2):
                (below / entry.name).symlink_to(entry)
    [own] = folder.glob("lib/python*/site-packages")
    (own / "below.pth").write_text(f"{ROOT}\n{below}\n")
    return python
