"""Evaluation: episodes as keyed jobs, played in parallel by Ray actors, recorded exactly once.

summary = evaluate(
    EvalConfig(policies=[{"url": "http://localhost:8000"}], suites=[{"envs": ["tabletop"]}], out="runs/first")
)
"""

from vlagents_ray.evaluate.cluster import most_cpus, most_gpus
from vlagents_ray.evaluate.config import ClockConfig, EvalConfig, PolicyConfig, StopConfig, SuiteConfig, WorkerConfig
from vlagents_ray.evaluate.progress import Progress, SilentProgress, progress_for
from vlagents_ray.evaluate.report import print_summary, results_table
from vlagents_ray.evaluate.results import Results, synchronous_twin
from vlagents_ray.evaluate.runner import EvaluationInterrupted, OutOfTime, check, evaluate
from vlagents_ray.evaluate.statistics import Rate, wilson
from vlagents_ray.evaluate.stopping import confidence_sequence
from vlagents_ray.evaluate.summary import Group, Summary

__all__ = [
    "ClockConfig",
    "EvalConfig",
    "EvaluationInterrupted",
    "Group",
    "OutOfTime",
    "PolicyConfig",
    "Progress",
    "Rate",
    "Results",
    "SilentProgress",
    "StopConfig",
    "SuiteConfig",
    "Summary",
    "WorkerConfig",
    "check",
    "confidence_sequence",
    "evaluate",
    "most_cpus",
    "most_gpus",
    "print_summary",
    "progress_for",
    "results_table",
    "synchronous_twin",
    "wilson",
]
