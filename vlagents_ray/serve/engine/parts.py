"""The objects that the intake, the runner and the moves of one engine share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from vlagents_ray.serve.engine.health import Health
from vlagents_ray.serve.engine.metrics_buffer import MetricsBuffer
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.models.served_model import ServedModel
from vlagents_ray.serve.queue.batch_queue import BatchQueue
from vlagents_ray.serve.queue.replica_pace import ReplicaPace
from vlagents_ray.serve.sessions import DrainList, SessionFinder, SessionTable
from vlagents_ray.serve.weights import WeightUpdates


@dataclass(frozen=True, slots=True)
class EngineParts:
    """The objects that the intake, the runner and the moves of one engine share."""

    settings: EngineSettings
    clock: Callable[[], float]  # s
    sessions: SessionTable[LoadedModel]
    model: ServedModel
    weights: WeightUpdates
    queue: BatchQueue
    pace: ReplicaPace
    health: Health
    stats: MetricsBuffer
    drain_list: DrainList
    finder: SessionFinder | None  # fetches sessions from other replicas
