"""Tests that no module of the plug-in imports a package that the light install of a robot lacks."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import vlagents_ray_robot

PACKAGE = Path(vlagents_ray_robot.__file__).parent
MODULES = [
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")
    for path in sorted(PACKAGE.rglob("*.py"))
]
HEAVY = {
    "ray",
    "torch",
    "pydantic",
    "jinja2",
    "starlette",
    "gymnasium",
    "PIL",
    "yaml",
    "typer",
    "rich",
    "av",
    "mujoco",
}
HEAVY |= {"lerobot", "pyarrow", "pyspacemouse", "rclpy"}


@pytest.mark.slow
@pytest.mark.parametrize("module", MODULES)
def test_no_module_imports_anything_heavy(module: str) -> None:
    code = f"import sys, {module}; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=300
    )
    loaded = {name.partition(".")[0] for name in done.stdout.split()}
    assert "vlagents_ray_robot" in loaded
    assert loaded & HEAVY == set()
