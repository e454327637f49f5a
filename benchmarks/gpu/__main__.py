"""Measurements and checks that need a GPU: `make gpu`, in two runs of at most seven minutes each.
It needs neither Ray nor a network.

Each step runs in a separate process within a time limit, so that a crash costs one step. The time
limits of the steps fit into the time of a run, and the plan of a run is printed first; further
steps run while time is left. After each step, the folder `--out` has the results so far: gpu.json,
gpu.md with tables, and gpu.log with the output of all steps. The exit status is 0 if all criteria
were met. `--dry` runs the same steps in small sizes on a CPU, and judges no times.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.console import parse_counts
from benchmarks.gpu.lab import SECONDS, Plan
from benchmarks.gpu.runner import Runner, planned_seconds, show_plan
from benchmarks.gpu.steps import RUNS, STEPS

# Limits of a dry run on a CPU that may be busy: the total time, s, and the factor for the limits of
# steps.
_DRY_S, _DRY_PATIENCE = 3600.0, 5.0


def main(
    run: Annotated[
        str, typer.Option(help=f"One of {', '.join(RUNS)}; default: one after the other.")
    ] = "",
    out: Annotated[Path, typer.Option(envvar="OUT", help="The folder of the report.")] = Path(
        "build/gpu"
    ),
    steps: Annotated[str, typer.Option(help=f"Some of {', '.join(STEPS)}, instead of a run.")] = "",
    seconds: Annotated[
        float, typer.Option(min=1, help="Time for all steps of a run together.")
    ] = SECONDS,
    rows: Annotated[str, typer.Option(help="The batch sizes of the step compiled.")] = "1,8",
    dry: Annotated[bool, typer.Option("--dry", help="Small sizes, on a CPU.")] = False,
    plan_only: Annotated[bool, typer.Option("--plan", help="Print only the plan.")] = False,
    commit: Annotated[
        str, typer.Option(help="The commit of the code, in a copy without a git folder.")
    ] = "",
) -> None:
    """Measure and check what needs a GPU."""
    if run and run not in RUNS:
        raise typer.BadParameter(f"--run: expected one of {list(RUNS)}, got {run!r}")
    named = [name.strip() for name in steps.split(",") if name.strip()]
    unknown = [name for name in named if name not in STEPS]
    if unknown:
        raise typer.BadParameter(f"--steps: expected only {list(STEPS)}, got {unknown}")

    chosen = [run] if run else list(RUNS)
    extras: list[str] = []
    if not named:
        for name in chosen:
            named += [step for step in RUNS[name].steps if step not in named]
            extras += RUNS[name].extras
        seconds *= len(chosen)
    needed_s = planned_seconds([STEPS[name] for name in named])
    show_plan({name: STEPS[name] for name in named}, extras, seconds)
    if dry:
        seconds = _DRY_S
    if needed_s > seconds:
        raise typer.BadParameter(
            f"--seconds: expected at least {needed_s:.0f}, the limits of the steps, got "
            f"{seconds:.0f}; name fewer steps"
        )
    if plan_only:
        return

    out.mkdir(parents=True, exist_ok=True)
    (out / "gpu.log").unlink(missing_ok=True)
    memory = Path("/dev/shm")  # noqa: S108 - the checkpoints of 7 GB are read several times
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as scratch:
        # With an empty cache, the first start compiles everything.
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = f"{scratch}/programs"
        # Imports must not initialise CUDA before a fork.
        os.environ.setdefault("PYTORCH_NVML_BASED_CUDA_CHECK", "1")
        compiled_rows = tuple(parse_counts(rows, "--rows"))
        plan = Plan(
            out.absolute(),
            Path(scratch),
            dry,
            seconds,
            compiled_rows,
            commit,
            patience=_DRY_PATIENCE if dry else 1.0,
        )
        all_steps = {name: STEPS[name] for name in (*named, *extras)}
        met = Runner(plan, all_steps, extras).run()
    raise typer.Exit(0 if met else 1)


if __name__ == "__main__":
    typer.run(main)
