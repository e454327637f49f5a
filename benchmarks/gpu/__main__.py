"""What only a GPU can show, in at most ten minutes: `make gpu`. It needs neither Ray nor a network.

Each step runs in a process of its own within a time limit, so that a crash costs one step. After
each step, the folder `--out` has what was found so far: gpu.json, gpu.md with tables, and gpu.log
with the output of all steps. The exit status is 0 if all criteria were met. `--dry` runs the same
steps in small sizes on a CPU, and judges no time.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.console import parse_counts
from benchmarks.gpu.lab import Plan
from benchmarks.gpu.runner import Runner
from benchmarks.gpu.steps import STEPS


def main(
    out: Annotated[Path, typer.Option(envvar="OUT", help="The folder of the report.")] = Path(
        "build/gpu"
    ),
    steps: Annotated[str, typer.Option(help=f"Some of {', '.join(STEPS)}; default: all.")] = "",
    seconds: Annotated[float, typer.Option(min=1, help="For all steps together.")] = 570.0,
    rows: Annotated[
        str, typer.Option(help="The batch sizes of the steps graphs and compiled.")
    ] = "1,4,16",
    dry: Annotated[bool, typer.Option("--dry", help="Small sizes, on a CPU.")] = False,
) -> None:
    """Measure and check everything that needs a GPU."""
    names = [name.strip() for name in steps.split(",") if name.strip()] or list(STEPS)
    if unknown := [name for name in names if name not in STEPS]:
        raise typer.BadParameter(f"--steps: got {unknown}, want some of {list(STEPS)}")
    out.mkdir(parents=True, exist_ok=True)
    (out / "gpu.log").unlink(missing_ok=True)
    memory = Path("/dev/shm")  # noqa: S108 - the checkpoints of 7 GB are read several times
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as scratch:
        # So that the first start compiles all.
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = f"{scratch}/programs"
        # Imports must not initialise CUDA before a fork.
        os.environ.setdefault("PYTORCH_NVML_BASED_CUDA_CHECK", "1")
        plan = Plan(
            out.absolute(), Path(scratch), dry, seconds, tuple(parse_counts(rows, "--rows"))
        )
        met = Runner(plan, {name: STEPS[name] for name in names}).run()
    raise typer.Exit(0 if met else 1)


if __name__ == "__main__":
    typer.run(main)
