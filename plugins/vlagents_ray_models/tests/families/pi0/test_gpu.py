"""All steps of `make gpu` start and end on a CPU, in small sizes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from benchmarks.gpu.steps import STEPS

ROOT = Path(__file__).resolve().parents[5]


def test_a_dry_run_of_all_steps_meets_its_criteria(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks.gpu", "--dry", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    log = (tmp_path / "gpu.log").read_text()
    assert done.returncode == 0, f"{done.stdout}{done.stderr}{log[-20_000:]}"
    steps = json.loads((tmp_path / "gpu.json").read_text())["steps"]
    assert steps.keys() == STEPS.keys()
    assert all(step["figures"] or step["checks"] for step in steps.values())
    eager, compiled = (steps[name]["figures"]["curve"] for name in ("eager", "compiled"))
    assert [row["rows"] for row in eager] == [row["rows"] for row in compiled] == [1, 2]
    assert all(0 < row["network_ms"] <= row["bare_ms"] for row in [*eager, *compiled])
    assert [row["robots"] for row in steps["served"]["figures"]["robots"]] == [1, 2]
