"""Results are read where no Ray is installed: on a laptop, in a notebook."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

from eval_fakes import ToZero
from in_process_evaluation import without_ray

from vlagents_ray.evaluate import EvalConfig, evaluate

READ = """
import sys
for name in ("jinja2", "ray", "rich", "torch"):
    sys.modules[name] = None  # as if it were not installed
from vlagents_ray.evaluate import Results, compare
results = Results.load(sys.argv[1])
print(sum(len(cell.episodes) for cell in results.cells))
"""


def test_results_are_read_without_ray(config: Callable[..., EvalConfig]) -> None:
    with without_ray():
        summary = evaluate(config(), agent_factory=ToZero)
    command = [sys.executable, "-W", "error", "-c", READ, str(summary.out)]
    told = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert told.returncode == 0, told.stderr
    assert told.stdout.strip() == str(summary.total.episodes)
