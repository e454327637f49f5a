"""Evaluations: episodes run in parallel in Ray actors, and each episode is recorded exactly
once.

    policies = [{"url": "http://localhost:8000"}]
    suites = [{"envs": ["tabletop"]}]
    summary = evaluate(EvalConfig(policies=policies, suites=suites, out="runs/first"))

Configurations and results are read without Ray. Code that runs episodes or prints is imported on
first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from vlagents_ray.evaluate.artifacts.recorder import Trajectory
from vlagents_ray.evaluate.plan.config import (
    ClockConfig,
    EvalConfig,
    PolicyConfig,
    StopConfig,
    SuiteConfig,
    WorkerConfig,
)
from vlagents_ray.evaluate.results.comparison import Comparison, compare
from vlagents_ray.evaluate.results.reader import Results, synchronous_twin
from vlagents_ray.evaluate.results.statistics import (
    Pairs,
    Rate,
    confidence_sequence,
    difference_interval,
    holm,
    mcnemar,
    paired_test,
)
from vlagents_ray.evaluate.results.summary import Group, Summary
from vlagents_ray.success import wilson

if TYPE_CHECKING:
    from vlagents_ray.evaluate.plan.cases import most_cpus, most_gpus
    from vlagents_ray.evaluate.plan.resolved import ResolvedPlan, resolve
    from vlagents_ray.evaluate.report.terminal import (
        Progress,
        print_summary,
        progress_for,
        results_table,
    )
    from vlagents_ray.evaluate.run import EvaluationInterrupted, OutOfTime, check, evaluate

_LATE = {
    "plan.cases": ("most_cpus", "most_gpus"),
    "plan.resolved": ("ResolvedPlan", "resolve"),
    "report.terminal": ("Progress", "print_summary", "progress_for", "results_table"),
    "run": ("EvaluationInterrupted", "OutOfTime", "check", "evaluate"),
}  # module -> names that are imported from it on first use

__all__ = [
    "ClockConfig",
    "Comparison",
    "EvalConfig",
    "EvaluationInterrupted",
    "Group",
    "OutOfTime",
    "Pairs",
    "PolicyConfig",
    "Progress",
    "Rate",
    "ResolvedPlan",
    "Results",
    "StopConfig",
    "SuiteConfig",
    "Summary",
    "Trajectory",
    "WorkerConfig",
    "check",
    "compare",
    "confidence_sequence",
    "difference_interval",
    "evaluate",
    "holm",
    "mcnemar",
    "most_cpus",
    "most_gpus",
    "paired_test",
    "print_summary",
    "progress_for",
    "resolve",
    "results_table",
    "synchronous_twin",
    "wilson",
]


def __getattr__(name: str) -> Any:
    for module, names in _LATE.items():
        if name in names:
            return getattr(importlib.import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
