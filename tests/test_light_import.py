"""A robot's control computer installs three light packages, and the package's imports must need no
more.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import vlagents_ray

PACKAGE = Path(vlagents_ray.__file__).parent
FILES = (
    *(
        "cli/robot",
        "contract",
        "dataset_contract",
        "errors",
        "interface",
        "naming",
        "registry",
        "settings",
        "success",
        "validation",
    ),
    *("ray_tools/session", "ray_tools/private", "ray_tools/reaper"),
)
FOLDERS = ("chunking", "client", "datasets", "images", "protocol", "robot", "weights")
LIGHT = [*(f"{name}.py" for name in FILES), *(f"{name}/**/*.py" for name in FOLDERS)]
HEAVY = {
    *(
        "ray",
        "torch",
        "pydantic",
        "jinja2",
        "starlette",
        "fastapi",
        "gymnasium",
        "PIL",
        "yaml",
        "typer",
        "rich",
        "av",
    ),
    "pyarrow",
}
ROUNDS = 5
TIMES_NUMPY = 4  # how much longer than numpy, which it imports, the package may take to import


def loaded_by(statement: str) -> set[str]:
    """Return the top-level packages in a fresh interpreter's `sys.modules` after `statement`."""
    names = python(f"import sys\n{statement}\nprint(*sys.modules)").split()
    return {name.partition(".")[0] for name in names}


def import_seconds(module: str) -> float:
    """Return the shortest import time in several fresh interpreters, so that a busy machine does
    not matter.
    """
    code = (
        f"import time; begin = time.perf_counter(); import {module}; print(time.perf_counter() "
        "- begin)"
    )
    return min(float(python(code)) for _ in range(ROUNDS))


def python(code: str, *words: str) -> str:
    command = [sys.executable, "-c", code, *words]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def light_modules() -> list[str]:
    found = {pattern: sorted(PACKAGE.glob(pattern)) for pattern in LIGHT}
    assert all(found.values()), found
    paths = [path.relative_to(PACKAGE.parent) for files in found.values() for path in files]
    return [".".join(path.with_suffix("").parts).removesuffix(".__init__") for path in paths]


def test_the_public_names_import_nothing_heavy() -> None:
    assert loaded_by("from vlagents_ray import Act, Agent, Obs, RemoteAgent") & HEAVY == set()


def test_the_help_of_the_commands_needs_neither_arrays_nor_connections() -> None:
    """A shell waits for this help, and the other commands load the same modules first."""
    unneeded = {"asyncio", "numpy", "simplejpeg", "websockets", "yaml"} | HEAVY
    assert loaded_by("import vlagents_ray.cli.main") & unneeded == {"pydantic", "rich", "typer"}


def test_what_an_evaluation_asks_of_a_job_is_computed_without_ray() -> None:
    statement = "from vlagents_ray.evaluate import EvalConfig, most_cpus, most_gpus"
    assert loaded_by(statement) & {"ray", "torch"} == set()


def test_a_heavy_import_would_be_seen() -> None:
    assert "pydantic" in loaded_by("import vlagents_ray, pydantic") & HEAVY


# Imports each module separately, in a fork of an interpreter that has already imported the common
# parts: the package, and the light packages of a robot.
EACH_IN_A_FORK = """
import os, sys, numpy, simplejpeg, vlagents_ray, websockets.sync.client
for module in sys.argv[1:]:
    if os.fork() == 0:
        __import__(module)
        print(module, *sys.modules, flush=True)
        os._exit(0)
    assert os.wait()[1] == 0, module
"""


@pytest.mark.slow
def test_no_module_of_a_robots_imports_anything_heavy() -> None:
    lines = [line.split() for line in python(EACH_IN_A_FORK, *light_modules()).splitlines()]
    assert [module for module, *_ in lines] == light_modules()
    loaded = {
        module: {name.partition(".")[0] for name in names} & HEAVY for module, *names in lines
    }
    assert {module: heavy for module, heavy in loaded.items() if heavy} == {}


@pytest.mark.alone
def test_importing_the_package_takes_little_longer_than_importing_numpy() -> None:
    ours, numpys = import_seconds("vlagents_ray"), import_seconds("numpy")
    assert ours < TIMES_NUMPY * numpys, (
        f"import vlagents_ray: {ours:.3f} s, import numpy: {numpys:.3f} s"
    )
