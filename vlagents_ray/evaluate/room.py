"""What becomes of an evaluation for some of whose workers the cluster finds no room."""

from __future__ import annotations

import logging
from collections.abc import Callable
from time import monotonic

import ray

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.config import EvalConfig, WorkerConfig

log = logging.getLogger(__name__)


class Room:
    """It goes on with the workers that play: the node of another one may have been lost, and may come back."""

    def __init__(self, config: EvalConfig, now: Callable[[], float] = monotonic) -> None:
        self._config = config
        self._now = now
        self._played = now()  # when an episode was last being played
        self._short = False  # has it been said that there is not room for all?

    def used(self) -> None:
        """Take note that an episode is being played."""
        self._played = self._now()

    def found(self) -> None:
        """Take note that a worker has come up."""
        self._short = False

    def lacks(self, since: float) -> bool:
        """Has a worker that was started then waited for too long?"""
        return self._now() - since > self._config.place_timeout_s

    def miss(self, worker: WorkerConfig, running: int) -> None:
        """One waits for too long, while so many run: a warning, and `ConfigError` if nothing is played either."""
        stuck = self.lacks(self._played)
        if self._short and not stuck:
            return
        self._short = True
        want = {"CPU": worker.cpus, "GPU": worker.gpus}
        message = (
            f"the cluster found no room for a worker in {self._config.place_timeout_s:g} s: each wants {want}, "
            f"free are {ray.available_resources()} of {ray.cluster_resources()}; lower `workers` or "
            f"`worker.cpus`, or raise `place_timeout_s` if the cluster is still growing"
        )
        if stuck:
            raise ConfigError(message)
        log.warning("going on with %d of %d workers: %s", running, self._config.workers, message)
