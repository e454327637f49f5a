"""Collects everything that `benchmarks.gpu` needs on a machine without a network in one folder:

`make gpu-pack`. The machine must have Linux on x86-64, Python 3.12, pip, and torch with torchvision
and numpy, which are not in the folder.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.gpu.runner import commit

ROOT = Path(__file__).resolve().parents[2]
PYTHON = "3.12"
# Packages of the repository that `benchmarks.gpu` imports; `run.sh` installs their wheels.
PLUGINS = ("cluster", "learn", "models")
PROJECTS = [str(ROOT), *(str(ROOT / f"plugins/vlagents_ray_{name}") for name in PLUGINS)]
# With the repository's own files, a folder of this size still fits into an upload of 64 MiB.
MOST_MIB = 55.0
PACKAGES = (
    "transformers==5.23.*",
    "torchao",
    "pydantic",
    "simplejpeg",
    "websockets",
    "starlette",
    "uvicorn",
    "python-multipart",
    "msgpack",
    "typer",
    "pytest",
    "pytest-timeout",
    "hypothesis",
)
# Packages that come with torch, and hf_xet, which only serves downloads.
THERE = ("numpy", "torch", "hf_xet")
PLATFORMS = (
    "manylinux_2_28",
    "manylinux_2_27",
    "manylinux_2_24",
    "manylinux_2_17",
    "manylinux2014",
    "manylinux1",
)
FOLDERS = (
    "vlagents_ray",
    "benchmarks",
    "pyproject.toml",
    "conftest.py",
    "tests/__init__.py",
    "tests/support",
    "tests/policies/compilation",
    "plugins/vlagents_ray_learn/tests",
)
RUN = """#!/bin/bash
# Measures all that needs a GPU: bash run.sh [OPTIONS of python -m benchmarks.gpu]. The report is in
# $OUT or build/gpu.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
site=$(mktemp -d)
trap 'rm -rf "$site"' EXIT
python=${PYTHON:-python3}
# A folder, and not an environment: torch may itself be in one, which another environment would not
# see.
options=(--quiet --no-index --no-deps --no-compile --target "$site")
"$python" -m pip install "${options[@]}" "$here"/wheels/*.whl
export OUT=${OUT:-$PWD/build/gpu} PYTHONPATH=$here/repository:$site${PYTHONPATH:+:$PYTHONPATH}
cd "$here/repository"
"$python" -m benchmarks.gpu "$@"
"""


def main(
    out: Annotated[Path, typer.Option(help="The folder, which is replaced.")] = Path(
        "build/gpu-pack"
    ),
) -> None:
    """Collect the files of the repository, the wheels, and run.sh."""
    out = out.absolute()
    shutil.rmtree(out, ignore_errors=True)
    wheels = out / "wheels"
    wheels.mkdir(parents=True)
    platforms = [word for name in PLATFORMS for word in ("--platform", f"{name}_x86_64")]
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    target = [
        "--python-version",
        PYTHON,
        "--implementation",
        "cp",
        *platforms,
        "--only-binary=:all:",
    ]
    subprocess.run(
        [*pip, "download", "--quiet", *target, "--dest", str(wheels), *PACKAGES], check=True
    )
    subprocess.run(
        [*pip, "wheel", "--quiet", "--no-deps", "--wheel-dir", str(wheels), *PROJECTS], check=True
    )
    for wheel in wheels.iterdir():
        if wheel.name.startswith(tuple(f"{name}-" for name in THERE)):
            wheel.unlink()
    for name in FOLDERS:
        source, copy = ROOT / name, out / "repository" / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, copy, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, copy)
    (out / "run.sh").write_text(RUN)
    (out / "repository" / "COMMIT").write_text(commit() + "\n")
    mib = sum(file.stat().st_size for file in out.rglob("*") if file.is_file()) / 2**20
    typer.echo(
        f"{out}: {mib:.1f} MiB, {len(list(wheels.iterdir()))} wheels; there: bash {out.name}/run.sh"
    )
    if mib > MOST_MIB:
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
