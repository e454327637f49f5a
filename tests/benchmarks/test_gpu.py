"""The steps of `make gpu` run in separate processes, and the report contains the result of each, or
the reason of its end.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from eval_fakes import wait_for

from benchmarks.gpu import pack
from benchmarks.gpu import runner as gpu_runner
from benchmarks.gpu.lab import SECONDS, Acting, Lab, Plan, Step, row_error
from benchmarks.gpu.runner import Runner, planned_seconds, run_sampled, to_markdown
from benchmarks.gpu.samples import GpuSamples
from benchmarks.gpu.steps import GPU_TESTS, RUNS, STEPS
from benchmarks.network import NetworkTimer, busy_time
from vlagents_ray.errors import PolicyFailed
from vlagents_ray.policies.compilation import Compilation

HANG_S = 10  # long enough for a step to begin on a busy machine


def finds(lab: Lab) -> None:
    lab.show(rows=[{"rows": 1, "ms": 2.5}], note="a|b")
    lab.check("ratio", 0.5, most=0.4, speed=True)
    lab.check("failed", 0, equal=0)


def misses(lab: Lab) -> None:
    lab.check("ratio", 0.5, least=0.9)


def fails(lab: Lab) -> None:
    lab.show(before=1)
    raise RuntimeError("CUDA error: an illegal memory access was encountered")


def dies(lab: Lab) -> None:
    lab.show(before=1)
    os.kill(os.getpid(), signal.SIGKILL)


def hangs(lab: Lab) -> None:
    lab.show(before=1)
    subprocess.run(["sleep", "600"], check=False)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return the report of steps of all kinds."""
    plan = Plan(tmp_path_factory.mktemp("out"), tmp_path_factory.mktemp("scratch"), dry=True)
    steps = {"finds": finds, "misses": misses, "fails": fails, "dies": dies, "hangs": hangs}
    runner = Runner(
        plan, {name: Step(run, HANG_S if run is hangs else 60) for name, run in steps.items()}
    )
    assert runner.run() is False
    assert (plan.out / "gpu.md").read_text().count("**no**") == 4
    log = (plan.out / "gpu.log").read_text()
    assert "illegal memory access" in log
    assert "Timeout (" in log  # the place at which the step hung
    assert "in hangs" in log
    document: dict[str, Any] = json.loads((plan.out / "gpu.json").read_text())
    return document


@pytest.mark.torch
@pytest.mark.parametrize(
    ("step", "said"),
    [
        ("misses", {"name": "ratio", "got": 0.5, "want": "at least 0.9", "passed": False}),
        ("fails", {"name": "runs to its end", "passed": False}),
        ("dies", {"name": "exit status", "got": -signal.SIGKILL, "passed": False}),
        ("hangs", {"name": "ends in time", "got": f"not within {HANG_S} s", "passed": False}),
    ],
)
def test_a_step_that_misses_fails_dies_or_hangs_costs_itself_alone(
    found: dict[str, Any], step: str, said: dict[str, Any]
) -> None:
    [check] = found["steps"][step]["checks"]
    assert said.items() <= check.items()
    assert step == "misses" or found["steps"][step]["figures"] == {"before": 1}


@pytest.mark.torch
def test_a_dry_run_judges_no_time(found: dict[str, Any]) -> None:
    step = found["steps"]["finds"]
    assert [check["passed"] for check in step["checks"]] == [None, True]
    text = to_markdown({**found, "steps": {"finds": step}})
    assert "| finds | ratio | 0.5 | at most 0.4 | not judged |" in text
    assert "| rows | ms |" in text
    assert "- note: a/b" in text


def takes_a_while(lab: Lab) -> None:
    time.sleep(1.0)
    lab.show(ended=True)


@pytest.mark.torch
def test_a_busy_cpu_may_take_longer_for_a_step_than_a_gpu(tmp_path: Path) -> None:
    steps = {"slow": Step(takes_a_while, 0.5)}
    assert Runner(Plan(tmp_path, tmp_path), steps).run() is False
    assert Runner(Plan(tmp_path, tmp_path, patience=100.0), steps).run() is True


@pytest.mark.torch
def test_steps_without_time_are_named(tmp_path: Path) -> None:
    runner = Runner(Plan(tmp_path, tmp_path, dry=True, seconds=1), {"finds": Step(finds, 60)})
    assert runner.run() is False
    assert (
        json.loads((tmp_path / "gpu.json").read_text())["steps"]["finds"]["checks"][0]["got"]
        == "no time was left"
    )


def test_it_runs_without_ray_and_needs_no_torch_to_start() -> None:
    code = (
        "import sys; sys.modules['ray'] = None\n"
        "import benchmarks.gpu.__main__, vlagents_ray_learn.publisher, "
        "vlagents_ray.serve.endpoints.http\n"
        "assert 'torch' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_what_is_packed_for_a_machine_without_a_network_exists_and_has_what_is_imported_there() -> (
    None
):
    assert [name for name in pack.FOLDERS if not (pack.ROOT / name).exists()] == []
    files = [
        *(pack.ROOT / "benchmarks" / "gpu").glob("*.py"),
        *(pack.ROOT / name for name in GPU_TESTS),
    ]
    text = "\n".join(file.read_text() for file in files)
    imported = set(re.findall(r"^ *from (vlagents_ray\w*)", text, re.MULTILINE))
    packed = {
        path.parent.name
        for project in pack.PROJECTS
        for path in Path(project).glob("vlagents_ray*/py.typed")
    }
    assert imported <= packed


def test_the_limits_of_each_run_fit_into_its_time_and_both_into_a_quarter_of_an_hour() -> None:
    for run in RUNS.values():
        assert planned_seconds([STEPS[name] for name in run.steps]) <= SECONDS
    assert len(RUNS) * SECONDS <= 900 - 30  # a machine takes time to start
    named = [name for run in RUNS.values() for name in (*run.steps, *run.extras)]
    assert {*named} == {*STEPS}


@pytest.mark.slow
def test_the_plan_is_printed_and_one_that_does_not_fit_is_rejected() -> None:
    command = [sys.executable, "-m", "benchmarks.gpu", "--run", "serving"]
    plan = subprocess.run([*command, "--plan"], capture_output=True, text=True, check=True).stdout
    assert "served: at most 50 s" in plan
    assert "of 430 s" in plan
    assert "while time is left: destruction" in plan
    done = subprocess.run(
        [*command, "--seconds", "100"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "--seconds: expected at least" in done.stderr


@pytest.mark.torch
def test_a_step_that_is_an_extra_is_left_out_without_time_and_is_no_failure(
    tmp_path: Path,
) -> None:
    steps = {"finds": Step(finds, 60), "later": Step(finds, 600)}
    plan = Plan(tmp_path, tmp_path, dry=False, seconds=100)
    assert Runner(plan, {"later": steps["later"]}, ["later"]).run() is True
    assert not (tmp_path / "gpu.json").exists()


def test_samples_of_the_gpu_give_energy_clock_and_what_limits_it() -> None:
    found = GpuSamples()
    for line in ("350.5, 1980, 61, 0x0000000000000004", "349.5, 1970, 63, 0x0000000000000001"):
        found.add(line)
    found.add("[N/A], [N/A], 62, [N/A]")
    found.add("Terminated")
    assert found.figures(10.0) == {
        "watts": 350.0,
        "joules_an_act": 35.0,
        "clock_mhz": 1975.0,
        "celsius": 63.0,
        "clock_limited_by": "power cap",
    }
    assert GpuSamples().figures(10.0) == {}


def test_samples_are_taken_from_nvidia_smi_while_something_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "nvidia-smi"
    program.write_text('#!/bin/sh\nwhile echo "300, 1900, 50, 0x0"; do sleep 0.02; done\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    with GpuSamples() as taken:
        wait_for(lambda: len(taken.watts) > 2)
        taken.forget()
        wait_for(lambda: len(taken.watts) > 2)
    assert taken.figures(1.0)["watts"] == 300.0


def test_a_step_reports_the_clock_of_its_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "nvidia-smi"
    program.write_text('#!/bin/sh\nwhile echo "300, 1900, 50, 0x4"; do sleep 0.02; done\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")

    def waits_for_samples(lab: Lab) -> None:
        time.sleep(0.5)
        lab.show(rows=3)

    run_sampled(Lab(Plan(tmp_path, tmp_path), "waits"), waits_for_samples)
    assert json.loads((tmp_path / "step-waits.json").read_text())["figures"] == {
        "rows": 3,
        "watts": 300.0,
        "clock_mhz": 1900.0,
        "celsius": 50.0,
        "clock_limited_by": "power cap",
    }


def test_the_commit_says_whether_files_have_changed_since(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def git(*words: str) -> str:
        command = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b", *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    monkeypatch.setattr(gpu_runner, "_ROOT", tmp_path)
    git("init")
    file = tmp_path / "file"
    file.write_text("before")
    git("add", "file")
    git("commit", "--message", "first")
    head = git("rev-parse", "--short=12", "HEAD")
    assert gpu_runner.commit() == head
    (tmp_path / "not-added").write_text("a report")
    assert gpu_runner.commit() == head
    file.write_text("after")
    assert gpu_runner.commit() == f"{head} with changes"
    (tmp_path / "COMMIT").write_text("packed\n")
    assert gpu_runner.commit() == "packed"


@pytest.mark.torch
def test_the_longest_kernels_are_those_of_their_core() -> None:
    torch = pytest.importorskip("torch")
    timer = NetworkTimer()
    with timer.loading():
        multiply = Compilation(False).core("multiply", lambda x: x @ x)
        add = Compilation(False).core("add", lambda x: x + 1 + x)
    x = torch.ones(200, 200)
    found = timer.kernels(lambda: (multiply(x), torch.sin(x), add(x)))
    names = {core: {row["kernel"] for row in rows} for core, rows in found.items()}
    assert {*names} == {"multiply", "add"}
    assert "aten::mm" in names["multiply"] - names["add"]
    assert "aten::add" in names["add"] - names["multiply"]
    assert "aten::sin" not in names["multiply"] | names["add"]
    [added] = [row for row in found["add"] if row["kernel"] == "aten::add"]
    assert added["calls"] == 2
    assert all(0 < row["share"] <= 1 for rows in found.values() for row in rows)
    assert timer.measure(lambda: add(x)) is not None


def test_the_network_is_timed_alone_and_once(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(100))
    monkeypatch.setattr(
        "benchmarks.network.time", SimpleNamespace(perf_counter=lambda: float(next(clock)))
    )
    timer, rows = NetworkTimer(), [SimpleNamespace(is_cuda=False)]
    with timer.loading():
        inner = Compilation(False).core("inner", lambda x: x)
        outer = Compilation(False).core("outer", inner)
    assert timer.measure(lambda: (next(clock), outer(rows[0]), next(clock), inner(rows[0]))) == 2000
    assert timer.measure(lambda: None) is None
    inner(rows[0])  # an unmeasured call, which takes no time on the simulated clock
    assert Compilation(False).core("plain", inner) is inner


def test_a_timed_core_is_part_of_another_as_without_a_timer() -> None:
    compilation = Compilation("graphs")
    with NetworkTimer().loading():
        part = compilation.core("part", lambda x: x)
        compilation.core("whole", part, parts=[part], by_regions=True)
    assert compilation.cores[1]._parts == compilation.cores[:1]


def test_gaps_are_between_kernels_that_may_overlap() -> None:
    spans = [
        (0.0, 10.0, "a"),
        (2.0, 4.0, "b"),
        (15.0, 20.0, "c"),
        (18.0, 21.0, "d"),
        (31.0, 32.0, "e"),
    ]
    assert busy_time(spans) == (17.0, [(10.0, "e"), (5.0, "c")])
    assert busy_time([]) == (0.0, [])


def test_robots_pause_between_two_measurements() -> None:
    acted = threading.Semaphore(0)

    def act() -> None:
        acted.release()
        time.sleep(0.001)

    with Acting([act]) as acting:
        acting.pause()
        time.sleep(0.05)
        while acted.acquire(blocking=False):
            pass
        assert not acted.acquire(timeout=0.05)
        acting.resume()
        assert acting.during(acted.acquire, 1)["acts"] >= 1


def test_robots_act_until_an_action_ends_and_errors_are_counted() -> None:
    acted, allowed = threading.Semaphore(0), threading.Semaphore(0)

    def act() -> None:
        allowed.acquire()
        acted.release()
        raise PolicyFailed("again")

    with Acting([act]) as acting:
        found = acting.during(lambda: (allowed.release(), acted.acquire()), 1)
        allowed.release()
    assert (found["acts"], found["failed"], found["errors"]) == (1, 1, "PolicyFailed: again")


def test_the_error_of_rows_is_relative_to_the_largest() -> None:
    import numpy as np

    want = np.array([[3.0, 4.0], [0.0, 0.0]])
    assert row_error(want + np.array([[0.0, 0.0], [0.5, 0.0]]), want) == pytest.approx(0.1)
