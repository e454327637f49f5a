"""The steps of `make gpu` run in processes of their own, and the report says what each found, or
why it ended.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks.gpu import pack
from benchmarks.gpu.lab import Acting, Lab, Plan, row_error
from benchmarks.gpu.runner import Runner, to_markdown
from benchmarks.gpu.steps import GPU_TESTS, STEPS, Step
from benchmarks.network import NetworkTimer, busy_time
from vlagents_ray.errors import PolicyFailed
from vlagents_ray.policies.compilation import Compilation


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
    """The report of steps of all kinds."""
    plan = Plan(tmp_path_factory.mktemp("out"), tmp_path_factory.mktemp("scratch"), dry=True)
    steps = {"finds": finds, "misses": misses, "fails": fails, "dies": dies, "hangs": hangs}
    runner = Runner(
        plan, {name: Step(run, 3 if run is hangs else 60) for name, run in steps.items()}
    )
    assert runner.run() is False
    assert (plan.out / "gpu.md").read_text().count("**no**") == 4
    log = (plan.out / "gpu.log").read_text()
    assert "illegal memory access" in log
    assert "Timeout (" in log  # where the step that hangs was
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
        ("hangs", {"name": "ends in time", "got": "not within 3 s", "passed": False}),
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


def test_the_steps_fit_into_the_ten_minutes_of_a_machine() -> None:
    assert [*STEPS][:: len(STEPS) - 1] == ["facts", "destruction"]
    assert Plan(Path(), Path()).seconds < 600


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
    inner(rows[0])  # not measured: takes no time from the clock
    assert Compilation(False).core("plain", inner) is inner


def test_a_timed_core_is_part_of_another_as_without_a_timer() -> None:
    compilation = Compilation("graphs")
    with NetworkTimer().loading():
        part = compilation.core("part", lambda x: x)
        compilation.core("whole", part, parts=[part])
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
