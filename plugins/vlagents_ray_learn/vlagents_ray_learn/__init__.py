"""Learning with served policies: pushes of weights, evaluations, transitions, vector environments.

All names except `Publisher`, `TrainingEvaluation` and `log_ratio` need the extra "rollouts"
(pyarrow, gymnasium). A module is loaded when one of its names is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vlagents_ray_learn.columns import LogRatio, answers, arrays, log_ratio
    from vlagents_ray_learn.publisher import Publisher
    from vlagents_ray_learn.rollouts import RolloutPlan, Rollouts, RolloutStats
    from vlagents_ray_learn.training_evaluation import TrainingEvaluation
    from vlagents_ray_learn.vector_env import BatchVectorEnv, as_vector_env

# Module -> names that it defines.
_NAMES = {
    "columns": ("LogRatio", "answers", "arrays", "log_ratio"),
    "publisher": ("Publisher",),
    "rollouts": ("RolloutPlan", "RolloutStats", "Rollouts"),
    "training_evaluation": ("TrainingEvaluation",),
    "vector_env": ("BatchVectorEnv", "as_vector_env"),
}

__all__ = [
    "BatchVectorEnv",
    "LogRatio",
    "Publisher",
    "RolloutPlan",
    "RolloutStats",
    "Rollouts",
    "TrainingEvaluation",
    "answers",
    "arrays",
    "as_vector_env",
    "log_ratio",
]


def __getattr__(name: str) -> Any:
    for module, names in _NAMES.items():
        if name in names:
            return getattr(importlib.import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
