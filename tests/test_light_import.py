"""A robot's control computer installs three light packages; what it imports must need no more."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import vlagents_ray

PACKAGE = Path(vlagents_ray.__file__).parent
FILES = ("contract", "errors", "images", "interface", "mp4", "png", "registry")
LIGHT = [*(f"{name}.py" for name in FILES), "client/*.py", "robot/*.py", "wire/*.py"]
HEAVY = {
    "ray",
    "torch",
    "pydantic",
    "starlette",
    "fastapi",
    "gymnasium",
    "PIL",
    "yaml",
    "typer",
    "rich",
    "av",
    "pyarrow",
}
ROUNDS = 5
TIMES_NUMPY = 4  # how much longer than numpy, which it imports, the package may take to import


def loaded_by(statement: str) -> set[str]:
    """Top-level packages in a fresh interpreter's `sys.modules` after `statement`."""
    names = python(f"import sys\n{statement}\nprint(*sys.modules)").split()
    return {name.partition(".")[0] for name in names}


def import_seconds(module: str) -> float:
    """The best of some fresh interpreters, so that a busy machine does not decide."""
    code = f"import time; begin = time.perf_counter(); import {module}; print(time.perf_counter() - begin)"
    return min(float(python(code)) for _ in range(ROUNDS))


def python(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=120).stdout


def light_modules() -> list[str]:
    paths = [path.relative_to(PACKAGE.parent) for pattern in LIGHT for path in sorted(PACKAGE.glob(pattern))]
    return [".".join(path.with_suffix("").parts).removesuffix(".__init__") for path in paths]


def test_the_public_names_import_nothing_heavy() -> None:
    assert loaded_by("from vlagents_ray import Act, Agent, Obs, RemoteAgent") & HEAVY == set()


def test_a_heavy_import_would_be_seen() -> None:
    assert "pydantic" in loaded_by("import vlagents_ray, pydantic") & HEAVY


@pytest.mark.parametrize("module", light_modules())
def test_no_module_of_a_robots_imports_anything_heavy(module: str) -> None:
    assert loaded_by(f"import {module}") & HEAVY == set()


def test_importing_the_package_takes_little_longer_than_importing_numpy() -> None:
    ours, numpys = import_seconds("vlagents_ray"), import_seconds("numpy")
    assert ours < TIMES_NUMPY * numpys, f"import vlagents_ray: {ours:.3f} s, import numpy: {numpys:.3f} s"
