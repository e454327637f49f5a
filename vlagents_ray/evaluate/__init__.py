"""Evaluation: episodes as keyed jobs, played in parallel by Ray actors, recorded exactly once.

summary = evaluate(EvalConfig(envs=["tabletop"], policy_url="http://localhost:8000", out="runs/first"))
"""

from vlagents_ray.evaluate.config import EvalConfig
from vlagents_ray.evaluate.progress import Progress, SilentProgress, progress_for
from vlagents_ray.evaluate.report import print_summary, results_table
from vlagents_ray.evaluate.runner import EvaluationInterrupted, check, evaluate
from vlagents_ray.evaluate.statistics import Rate, wilson
from vlagents_ray.evaluate.summary import Group, Summary

__all__ = [
    "EvalConfig",
    "EvaluationInterrupted",
    "Group",
    "Progress",
    "Rate",
    "SilentProgress",
    "Summary",
    "check",
    "evaluate",
    "print_summary",
    "progress_for",
    "results_table",
    "wilson",
]
