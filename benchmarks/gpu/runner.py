"""The processes of the steps, and the report."""

from __future__ import annotations

import contextlib
import faulthandler
import json
import math
import multiprocessing
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import typer

from benchmarks.checkpoints import pi0
from benchmarks.figures import measured_on
from benchmarks.gpu.lab import Lab, Plan, Step
from benchmarks.gpu.samples import GpuSamples, card
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.registry import require
from vlagents_ray.serve.python_env.child_start import die_with_parent

_ROOT = Path(__file__).resolve().parents[2]
_SPARE_S = 15.0  # minimum remaining time, s, with which a step is started
# Time before the limit of a step, s, at which the stacks of all its threads are logged; Python may
# crash while it does this.
_STACKS_S = 1.0


def _child(plan: Plan, name: str, run: Callable[[Lab], None], until: float) -> None:
    """Run a step, as a process in a separate group, which is killed at `until`, s of
    `time.monotonic`.
    """
    die_with_parent()
    os.setsid()
    log = os.open(plan.out / "gpu.log", os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.dup2(log, 1), os.dup2(log, 2)
    typer.echo(f"\n== {name}")
    left_s = until - time.monotonic()
    faulthandler.dump_traceback_later(max(0.1, left_s - _STACKS_S), file=log)
    lab = Lab(plan, name)
    try:
        if plan.dry:
            Compilation.backend = "eager"
            pi0.SMALL = pi0.Pi0Size(width=64, expert_width=32, layers=2, vision_layers=1, patch=56)
            # With a model of this size, more threads would only wait for each other.
            require("torch").set_num_threads(1)
        run_sampled(lab, run)
    except BaseException as error:  # noqa: BLE001 - a step may raise any error, which is its result
        traceback.print_exc()
        lab.check(
            "runs to its end",
            " ".join(f"{type(error).__name__}: {error}".split())[:400],
            equal="its end",
        )
        sys.stdout.flush()
        os._exit(1)  # ends without waiting for the threads of a broken step


def run_sampled(lab: Lab, run: Callable[[Lab], None]) -> None:
    """Run a step, and show the power and the clock of the GPU during the step."""
    with GpuSamples() as samples:
        run(lab)
    lab.show(**samples.summary())


class Runner:
    """Runs the steps, and writes the results after each step."""

    def __init__(self, plan: Plan, steps: Mapping[str, Step], extras: Sequence[str] = ()) -> None:
        """Prepare the run of all `steps`; `extras` are steps that may be left out for lack of
        time.
        """
        self._plan, self._steps, self._results = plan, steps, dict[str, Any]()
        self._extras = extras
        self._context: Any = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(["benchmarks.gpu.imports"])
        self._begun = time.monotonic()
        origin = measured_on("python -m benchmarks.gpu")
        self._origin = {**origin, "commit": plan.commit or commit(), "gpu": card()}

    def run(self) -> bool:
        """Run the steps; return whether all criteria were met."""
        beside: tuple[str, BaseProcess, float] | None = None
        for name, step in self._steps.items():
            # A step that needs its whole limit would be cut off at the end of the run.
            is_late = self._left() < (0.5 * step.limit_s if name in self._extras else _SPARE_S)
            if is_late and name in self._extras and not self._plan.dry:
                typer.echo(f"{name}: left out, as no time is left")
                continue
            if self._left() < _SPARE_S:
                self._record(
                    name, {"figures": {}, "checks": [_unmet("runs", "no time was left", "it runs")]}
                )
                continue
            started = (name, self._start(name), time.monotonic())
            if step.beside in self._steps:
                beside = started
                continue
            self._finish(*started)
            if beside is not None:
                self._finish(*beside)
                beside = None
            # CUDA may not survive the fork.
            if name == "facts" and not _passed(self._results[name]):
                self._context = multiprocessing.get_context("spawn")
                self._finish(name, self._start(name), time.monotonic())
        if beside is not None:
            self._finish(*beside)
        return all(map(_passed, self._results.values()))

    def _left(self) -> float:
        return self._plan.seconds - (time.monotonic() - self._begun)

    def _limit_s(self, step: Step) -> float:
        return step.limit_s * self._plan.patience

    def _start(self, name: str) -> BaseProcess:
        step = self._steps[name]
        until = time.monotonic() + min(self._limit_s(step), self._left())
        args = (self._plan, name, step.run, until)
        process: BaseProcess = self._context.Process(target=_child, args=args)
        process.start()
        return process

    def _finish(self, name: str, process: BaseProcess, begun: float) -> None:
        longest_s = self._limit_s(self._steps[name])
        limit_s = min(longest_s, self._left() + time.monotonic() - begun)
        process.join(max(0.0, limit_s - (time.monotonic() - begun)))
        over = process.is_alive()
        if process.pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
        process.kill()  # the process may not have a group yet
        process.join()
        file = self._plan.scratch / f"step-{name}.json"
        found = json.loads(file.read_text()) if file.is_file() else {"figures": {}, "checks": []}
        if over:
            found["checks"].append(_unmet("ends in time", f"not within {limit_s:.0f} s", "its end"))
        elif process.exitcode and _passed(found):
            found["checks"].append(_unmet("exit status", process.exitcode, "0"))
        elif not found["checks"] and not found["figures"]:
            found["checks"].append(_unmet("results", "none", "some"))
        self._record(name, {**found, "seconds": time.monotonic() - begun})

    def _record(self, name: str, found: Mapping[str, Any]) -> None:
        self._results[name] = found
        document = {
            **self._origin,
            "dry": self._plan.dry,
            "seconds": time.monotonic() - self._begun,
            "steps": self._results,
        }
        (self._plan.out / "gpu.json").write_text(json.dumps(document, indent=1) + "\n")
        (self._plan.out / "gpu.md").write_text(to_markdown(document))
        unmet = [check for check in found["checks"] if check["passed"] is False]
        typer.echo(
            f"{name}: {found.get('seconds', 0):.1f} s, "
            f"{'all met' if not unmet else f'{len(unmet)} not met'}"
        )
        for check in unmet:
            typer.echo(f"  {check['name']}: expected {check['want']}, got {check['got']}")


def planned_seconds(steps: Sequence[Step]) -> float:
    """Return the maximum total time of steps, s; a step that runs beside another step adds no
    time.
    """
    return sum(step.limit_s for step in steps if not step.beside)


def show_plan(steps: Mapping[str, Step], extras: Sequence[str], seconds: float) -> None:
    """Print the steps of a run with their limits, and when each begins at the latest."""
    begins_s = 0.0
    for name, step in steps.items():
        beside = f", beside {step.beside}" if step.beside in steps else ""
        typer.echo(f"{begins_s:5.0f} s  {name}: at most {step.limit_s:.0f} s{beside}")
        begins_s += 0.0 if beside else step.limit_s
    typer.echo(f"{begins_s:5.0f} s  of {seconds:.0f} s")
    if extras:
        typer.echo(f"while time is left: {', '.join(extras)}")


def commit() -> str:
    """Return the commit of this checkout, or of the packed checkout, and whether files have changed
    since; empty if the commit is unknown.
    """
    packed = _ROOT / "COMMIT"
    if packed.is_file():
        return packed.read_text().strip()
    head = _git("rev-parse", "--short=12", "HEAD")
    has_changes = bool(head and _git("status", "--porcelain", "--untracked-files=no"))
    return f"{head} with changes" if has_changes else head


def _git(*words: str) -> str:
    """Return the output of a command of git about this checkout; empty if it fails."""
    command = ["git", "-C", str(_ROOT), *words]
    with contextlib.suppress(OSError):
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    return ""


def _passed(found: Mapping[str, Any]) -> bool:
    return all(check["passed"] is not False for check in found["checks"])


def _unmet(name: str, got: Any, want: str) -> dict[str, Any]:
    return {"name": name, "got": got, "want": want, "passed": False}


def to_markdown(document: Mapping[str, Any]) -> str:
    """Return the report of a run."""
    versions = ", ".join(f"{name} {version}" for name, version in document["versions"].items())
    lines = [
        (
            f"{document['gpu']}. Measured {document['date']} at commit "
            f"{document['commit'] or 'unknown'} by `{document['command']}` in "
            f"{document['seconds']:.0f} s. {versions}."
        ),
        "",
    ]
    if document["dry"]:
        lines += ["A dry run on a CPU, in small sizes: its times mean nothing.", ""]
    checks = [
        {"step": name, "criterion": one["name"], "got": one["got"], "want": one["want"],
         "met": {True: "yes", False: "**no**", None: "not judged"}[one["passed"]]}
        for name, step in document["steps"].items() for one in step["checks"]
    ]  # fmt: skip
    lines += [*_table(checks), ""]
    for name, step in document["steps"].items():
        lines += [f"## {name}, {step.get('seconds', 0):.1f} s", ""]
        tables = {
            key: value
            for key, value in step["figures"].items()
            if isinstance(value, list) and value
        }
        lines += [
            f"- {key}: {_cell(value)}"
            for key, value in step["figures"].items()
            if key not in tables
        ]
        for key, rows in tables.items():
            listed = _table(rows) if isinstance(rows[0], dict) else [f"- {row}" for row in rows]
            lines += ["", f"{key}:", "", *listed]
        lines.append("")
    return "\n".join(lines)


def _table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    head = list(dict.fromkeys(name for row in rows for name in row))
    body = [" | ".join(_cell(row.get(name, "")) for name in head) for row in rows]
    return [f"| {line} |" for line in (" | ".join(head), " | ".join("---" for _ in head), *body)]


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3g}" if math.fabs(value) < 1000 else f"{value:,.0f}"
    if isinstance(value, list):
        value = "; ".join(map(str, value)) or "none"
    return str(value).replace("|", "/")
