"""Runs of examples/learn/train.py, each in a Ray of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from subprocess import PIPE

from ray_processes import processes
from readme_blocks import EXAMPLES

from vlagents_ray.evaluate import Results
from vlagents_ray.evaluate.results.summary import pushed_of


def start_run(folder: Path, out: Path, *options: str, before: str = "") -> subprocess.Popen[str]:
    """Start the example with the plan of `folder`, where its Ray is, in a process that runs
    `before` first.
    """
    script = str(EXAMPLES / "learn" / "train.py")
    code = (
        f"import sys; sys.argv[0] = {script!r}; sys.path.insert(0, "
        f"{str(EXAMPLES / 'learn')!r})\nimport train\n"
    )
    command = [sys.executable, "-c", f"{code}{before}\ntrain.typer.run(train.main)"]
    command += [str(folder / "plan.yaml"), "--out", str(out), *options]
    return subprocess.Popen(
        command,
        env=os.environ | {"RAY_TMPDIR": str(folder)},
        stdout=PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def ended(run: subprocess.Popen[str], folder: Path) -> str:
    """What the command has printed at its end, after which nothing runs."""
    printed, _ = run.communicate(timeout=500)
    assert run.returncode == 0, printed
    assert not processes(folder), "left running"
    return printed


def table(out: Path) -> dict[str, tuple[str | None, list[tuple[int, float]]]]:
    """The weights, and seed and return of each episode, by policy_id."""
    results, found = Results.load(out), {}
    for case in results.cases:
        episodes = sorted((one.result.key.seed, one.result.episode_return) for one in case.episodes)
        found[case.policy_id] = pushed_of(case), episodes
    return {name: found[name] for name in results.policy_ids}
