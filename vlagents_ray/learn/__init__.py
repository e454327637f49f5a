"""Learning with served policies: new weights, evaluations while they are trained, transitions, vector environments.

All but `Publisher` and `TrainingEvaluation` needs the extra "learn" (pyarrow, gymnasium). Modules are loaded when their
names are first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vlagents_ray.learn.columns import answers, arrays
    from vlagents_ray.learn.publisher import Publisher
    from vlagents_ray.learn.rollouts import RolloutPlan, Rollouts, RolloutStats
    from vlagents_ray.learn.training_evaluation import TrainingEvaluation
    from vlagents_ray.learn.vector_env import BatchVectorEnv, as_vector_env

_LATE = {
    "BatchVectorEnv": "vector_env",
    "Publisher": "publisher",
    "RolloutStats": "rollouts",
    "RolloutPlan": "rollouts",
    "Rollouts": "rollouts",
    "TrainingEvaluation": "training_evaluation",
    "answers": "columns",
    "arrays": "columns",
    "as_vector_env": "vector_env",
}

__all__ = [
    "BatchVectorEnv",
    "Publisher",
    "RolloutPlan",
    "RolloutStats",
    "Rollouts",
    "TrainingEvaluation",
    "answers",
    "arrays",
    "as_vector_env",
]


def __getattr__(name: str) -> Any:
    if name not in _LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_LATE[name]}"), name)
