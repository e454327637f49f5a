"""Virtual environments for tests, made in seconds: after their own packages, they see those of
this environment.
"""

from __future__ import annotations

import site
from pathlib import Path

import vlagents_ray
from vlagents_ray.serve.python_env.create import create, install

ROOT = Path(vlagents_ray.__file__).parents[1]
NEEDS_NUMPY_2 = "pyarrow"  # which Ray imports where it is installed; a server does without


def ended(pid: int) -> bool:
    """Has the process ended, be it that nobody has asked yet how?"""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return True
    return state in "ZX"


def layered(folder: Path, *requirements: str) -> Path:
    """The Python of an environment in `folder` with `requirements`, without what those need,
    over this one's.
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
