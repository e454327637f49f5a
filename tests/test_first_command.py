"""`make demo` and `make setup` on machines with and without a GPU, and without PyTorch's own
package index.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CUDA_BUILD, CPU_BUILD = ("torch", "nvidia-cublas", "nvidia-cudnn-cu13"), ("torch", "sympy")
NEWER_CUDA_BUILD = ("torch", "cuda-toolkit")

pytestmark = [
    pytest.mark.skipif(shutil.which("make") is None, reason="no make"),
    pytest.mark.skipif(Path("/dev/nvidia0").exists(), reason="the machine has an NVIDIA GPU"),
]

# Programs of an environment: pip resolves the packages that a test sets, and all programs record
# their calls.
PROGRAMS = {
    "python": """
        case "$*" in
          *--dry-run*) cat "$PLAN" ;;
          *" freeze"*) echo torch==2.13.0 ;;
        esac
        """,
    "uv": """
        if [ -z "$REACHABLE" ]; then echo "error: Failed to fetch the index" >&2; exit 2; fi
        """,
    "vlagents-ray": "",
}


class Machine:
    """A machine on which pip resolves torch to given packages."""

    def __init__(
        self, folder: Path, packages: Sequence[str], *, gpu: bool = False, reachable: bool = True
    ) -> None:
        self.venv = folder / "venv"
        self._calls = folder / "calls"
        commands = folder / "commands"
        for name, lines in PROGRAMS.items():
            self._write(self.venv / "bin" / name, lines)
        self._write(commands / "nvidia-smi", "" if gpu else "exit 9")
        plan = {"install": [{"metadata": {"name": name}} for name in packages]}
        (folder / "plan").write_text(json.dumps(plan, indent=1))
        self._environment = {
            **{
                name: value
                for name, value in os.environ.items()
                if not name.startswith(("MAKE", "TORCH", "PIP_"))
            },
            "PATH": f"{commands}:{os.environ['PATH']}",
            "CALLS": str(self._calls),
            "PLAN": str(folder / "plan"),
            "REACHABLE": "1" if reachable else "",
        }

    @staticmethod
    def _write(file: Path, lines: str) -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f'#!/bin/bash\nprintf "%s %s\\n" "${{0##*/}}" "$*" >>"$CALLS"\n{lines}\n')
        file.chmod(0o755)

    def make(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run `make`."""
        command = ["make", "--no-print-directory", f"VENV={self.venv}", *words]
        return subprocess.run(
            command,
            cwd=ROOT,
            env=self._environment,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )

    def installs_of_torch(self) -> list[str]:
        """Return the calls that install torch."""
        calls = self._calls.read_text().splitlines()
        return [
            call
            for call in calls
            if " install " in call and "torch==2.13.0" in call and "--dry-run" not in call
        ]

    def ran(self, program: str) -> bool:
        """Return whether a program was called."""
        return any(call.startswith(f"{program} ") for call in self._calls.read_text().splitlines())


PIP = "python -m pip --disable-pip-version-check install torch==2.13.0"


@pytest.mark.parametrize("goal", [["demo"], ["setup"], []])
@pytest.mark.parametrize("packages", [CUDA_BUILD, NEWER_CUDA_BUILD], ids=["nvidia", "cuda"])
def test_without_a_gpu_the_cpu_build_is_taken_by_itself(
    tmp_path: Path, goal: list[str], packages: list[str]
) -> None:
    machine = Machine(tmp_path, packages)
    made = machine.make(*goal)
    assert made.returncode == 0, made.stderr
    [install] = machine.installs_of_torch()
    assert install.startswith("uv pip install ")
    assert f"--python {machine.venv}/bin/python --torch-backend cpu" in install
    assert "without an NVIDIA GPU: the CPU build from PyTorch's own index" in made.stdout
    assert machine.ran("vlagents-ray") == (goal == ["demo"])


@pytest.mark.parametrize(
    ("packages", "gpu", "words"),
    [
        (CUDA_BUILD, True, []),
        (CPU_BUILD, False, []),
        (CPU_BUILD, True, []),
        (CUDA_BUILD, False, ["TORCH_CUDA=1"]),
    ],
    ids=["a GPU", "a CPU build", "a CPU build on a GPU", "the CUDA build after all"],
)
@pytest.mark.parametrize("reachable", [True, False])
def test_otherwise_the_build_that_pip_resolves_is_used_as_it_is(
    tmp_path: Path, packages: Sequence[str], gpu: bool, words: list[str], reachable: bool
) -> None:
    machine = Machine(tmp_path, packages, gpu=gpu, reachable=reachable)
    made = machine.make("demo", *words)
    assert made.returncode == 0, made.stderr
    assert machine.installs_of_torch() == [PIP]
    assert not machine.ran("uv")


@pytest.mark.parametrize("goal", ["demo", "setup", "test"])
def test_without_the_index_it_stops_with_a_cure_for_the_command_that_was_typed(
    tmp_path: Path, goal: str
) -> None:
    machine = Machine(tmp_path, CUDA_BUILD, reachable=False)
    made = machine.make(goal)
    assert made.returncode != 0
    assert PIP not in machine.installs_of_torch(), "the command would download several GB"
    assert not machine.ran("vlagents-ray")
    assert "Failed to fetch the index" in made.stderr
    assert f"{goal}: stopped before downloading several GB" in made.stderr
    for cure in (
        f"make {goal} TORCH_INDEX_URL=URL",
        f"PIP_FIND_LINKS=FOLDER make {goal}",
        f"make {goal} TORCH_CUDA=1",
    ):
        assert cure in made.stderr
    assert "://" not in made.stderr


def test_an_index_that_is_named_is_the_one_of_torch_alone(tmp_path: Path) -> None:
    machine = Machine(tmp_path, CPU_BUILD)
    assert machine.make("demo", "TORCH_INDEX_URL=https://index.invalid/cpu").returncode == 0
    [install] = machine.installs_of_torch()
    assert install == PIP.replace("install", "install --index-url https://index.invalid/cpu")


def test_the_demo_installs_what_it_needs_and_shows_progress(tmp_path: Path) -> None:
    machine = Machine(tmp_path, CPU_BUILD)
    assert machine.make("demo").returncode == 0
    calls = machine._calls.read_text().splitlines()
    [install] = [call for call in calls if "--editable" in call]
    assert install.endswith("--editable .[sim]")
    assert "--quiet" not in install
    assert "--quiet" not in machine.installs_of_torch()[0]
