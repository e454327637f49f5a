"""Runs TorchRL's own VLA recipe, GRPO on its toy environment, with TorchRL's inference server and
with our server, interleaved.

The recipe is `sota-implementations/vla_grpo` of a checkout of TorchRL (github.com/pytorch/rl),
copied to a temporary folder; for our server, its `utils.py` has one more line. Success is the rate
of the recipe's last greedy evaluation. The intervals use Student's t over the seeds, as the
episodes of a seed share the same weights.
"""

from __future__ import annotations

import math
import os
import re
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.console import Out, save
from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.errors import ConfigError

RECIPE = Path("sota-implementations/vla_grpo")
# The last import of the recipe's utils.py.
IMPORT = "from torchrl.weight_update import WeightStrategy\n"
LINE = (
    "from vlagents_ray_learn.torchrl import PolicyServer as ProcessInferenceServer, "
    "ServerAddress as MPTransport\n"
)
SERVERS = {"TorchRL's server": "", "this server": LINE}
# Python of the environment that `make environments FAMILIES=torchrl` makes.
PYTHON = Path(".venv-torchrl/bin/python")
_FINAL = re.compile(r"Final greedy success rate: (\d\.\d+)")
# Student's quantiles for 2 to 10 seeds.
_T_95 = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262)


def prepare(source: Path, folder: Path, line: str) -> Path:
    """Copy the recipe to a new folder and add a line to its imports; return the path of its
    program.
    """
    if not (source / RECIPE / "vla-grpo.py").is_file():
        raise ConfigError(f"--source: expected a checkout of TorchRL, with {RECIPE}, got {source}")
    shutil.copytree(source / RECIPE, folder)
    text = (folder / "utils.py").read_text()
    if IMPORT not in text:
        raise ConfigError(
            f"{source / RECIPE / 'utils.py'}: got no {IMPORT.strip()!r}; want the recipe of "
            "TorchRL 0.14"
        )
    (folder / "utils.py").write_text(text.replace(IMPORT, IMPORT + line))
    return folder / "vla-grpo.py"


def play(program: Path, python: Path, seed: int, words: Sequence[str] = ()) -> dict[str, float]:
    """Run the recipe without a logger and without checkpoints.

    Args:
        program: The recipe's `vla-grpo.py`.
        python: An interpreter with TorchRL and this package.
        seed: The seed of environments and initial weights.
        words: Further settings, `NAME=VALUE` of Hydra.

    Returns:
        `success`, the rate of the last evaluation, and `seconds`, the duration of the whole
        program.
    """
    settings = [
        f"env.seed={seed}",
        "logger.backend=",
        "checkpoint.save_iter=0",
        f"hydra.run.dir={program.parent}/run",
    ]
    # The same settings as in TorchRL's own test of the recipe.
    environment = os.environ | {"COMPOSITE_LP_AGGREGATE": "0"}
    begun = time.perf_counter()
    done = subprocess.run(
        [str(python), program.name, *settings, *words],
        cwd=program.parent,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    seconds = time.perf_counter() - begun
    found = _FINAL.search(done.stdout)
    if done.returncode or found is None:
        raise ConfigError(f"the recipe ended with {done.returncode}:\n{done.stdout[-4000:]}")
    return {"seed": seed, "success": float(found[1]), "seconds": seconds}


def compare(
    source: Path,
    python: Path,
    seeds: int,
    words: Sequence[str],
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Run the recipe with each server, seed by seed, and return plain JSON values."""
    runs: dict[str, list[dict[str, float]]] = {name: [] for name in SERVERS}
    with tempfile.TemporaryDirectory() as scratch:
        programs = {
            name: prepare(source, Path(scratch) / str(i), SERVERS[name])
            for i, name in enumerate(SERVERS)
        }
        for seed in range(seeds):
            # The order alternates, so that each server is first equally often.
            for name in list(SERVERS)[:: 1 if seed % 2 == 0 else -1]:
                runs[name].append(play(programs[name], python, seed, words))
                progress(f"seed {seed}, {name}: {runs[name][-1]}")
    return {"seeds": seeds, "cores": os.cpu_count(), "words": list(words), "runs": runs}


def interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the mean of 2 to 10 values and the bounds of its 95 % interval with Student's t."""
    mean, half = (
        statistics.fmean(values),
        _T_95[len(values) - 2] * statistics.stdev(values) / math.sqrt(len(values)),
    )
    return mean, mean - half, mean + half


def show(found: Mapping[str, Any]) -> None:
    """Print success and time of each server, and the differences of the same seeds."""
    rows = table("server", "success, %", "95 %", "s a run", "95 %")
    rows.title = f"TorchRL's vla_grpo, {found['seeds']} seeds, {found['cores']} cores"
    columns = {
        name: {
            key: [scale * run[key] for run in runs]
            for key, scale in (("success", 100), ("seconds", 1))
        }
        for name, runs in found["runs"].items()
    }
    theirs, ours = columns.values()
    columns["difference"] = {
        key: [b - a for a, b in zip(theirs[key], ours[key], strict=True)]
        for key in ("success", "seconds")
    }
    for name, column in columns.items():
        cells = [interval(column[key]) for key in ("success", "seconds")]
        rows.add_row(
            name,
            *(
                text
                for mean, low, high in cells
                for text in (f"{mean:.1f}", f"{low:.1f} to {high:.1f}")
            ),
        )
    out.print(rows)


def main(
    source: Annotated[Path, typer.Option(help="A checkout of TorchRL.", envvar="TORCHRL_SRC")],
    words: Annotated[
        list[str], typer.Argument(help="Settings of the recipe, such as collector.total_iters=50.")
    ] = [],  # noqa: B006
    seeds: Annotated[int, typer.Option(min=2, max=10)] = 5,
    python: Annotated[
        Path, typer.Option(help="Python interpreter with TorchRL and this package.")
    ] = PYTHON,
    out_file: Out = None,
) -> None:
    """Compare success and time of TorchRL's recipe with its own inference server and with our
    server.
    """
    with errors():
        found = compare(source, python.absolute(), seeds, words, progress)
    show(found)
    save(found, out_file)


if __name__ == "__main__":
    typer.run(main)
