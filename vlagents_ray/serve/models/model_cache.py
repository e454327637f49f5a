"""The eviction policy for loaded checkpoints: the sessions that hold each, the waiting sessions, and the next task.

It uses no threads; the lock of `vlagents_ray.serve.models.model_manager` guards all calls. If all slots are in use:

- The least recently used checkpoint without a session is evicted.
- If all have sessions, the waiting sessions wait for episodes to end. After `PATIENCE_S`, the checkpoint that was
  loaded first accepts no further episodes, until its sessions have ended and it is evicted. So ten checkpoints can
  take turns in two slots, each for long enough to be worth loading.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from vlagents_ray.errors import CheckpointFailed, DeadlineExceeded, UnknownSession, VLAgentsError
from vlagents_ray.serve.models.checkpoints import Checkpoints, resolved
from vlagents_ray.serve.models.loaded_model import LoadedModel, key_of
from vlagents_ray.serve.requests import DEFAULT, CheckpointChoice
from vlagents_ray.serve.sessions import Session

PATIENCE_S = 10.0  # waiting time for a slot after which a checkpoint in use accepts no further episodes

OnLoaded = Callable[
    [VLAgentsError | None], None
]  # called with None once a session holds its model, else with the error
DueCallbacks = list[tuple[OnLoaded, VLAgentsError | None]]  # callbacks to call, each with its argument


@dataclass(slots=True, eq=False)
class Waiter:
    """A session whose episode waits for its checkpoint."""

    session: Session[LoadedModel]
    choice: CheckpointChoice
    on_loaded: OnLoaded
    is_abandoned: Callable[[], bool]  # returns whether the caller no longer waits
    since: float = field(default_factory=time.monotonic)  # start of the wait, s


@dataclass(frozen=True, slots=True)
class LoadTask:
    """The task to load a model."""

    choice: CheckpointChoice
    settings: dict[str, Any]


@dataclass(frozen=True, slots=True)
class EvictTask:
    """The task to evict a model."""

    key: str  # key of the model; a reference to the model would delay the release of its memory
    at_once: bool = False  # whether to end the model's sessions


class ModelCache:
    """The loaded models, and the sessions that wait for others."""

    def __init__(self, source: Checkpoints) -> None:
        self.config = source.config  # the deployment's own settings in effect
        self.next: dict[str, Any] | None = None  # settings to swap to
        self.failure: str | None = None  # error of the last swap
        self.loaded: dict[str, LoadedModel] = {}  # models by the keys of their settings, the least recently used first
        self.waiting: list[Waiter] = []  # waiting sessions in order of arrival
        self.draining = ""  # key of the model that accepts no further episodes before its eviction
        self._source = source

    def describe(self) -> dict[str, Any]:
        """Return the available choices, the loaded checkpoints and the state of the last swap, for the metadata."""
        swap = None
        if self.next is not None:
            swap = {"state": "loading", "checkpoint": resolved(self.next)}
        elif self.failure is not None:
            swap = {"state": "failed", "error": self.failure}
        loaded = [model.checkpoint for model in self.loaded.values()]
        weights = [model.weights for model in self.loaded.values()]
        return {**self._source.describe(self.config), "loaded": loaded, "weights": weights, "swap": swap}

    def offers(self, choice: CheckpointChoice, settings: Mapping[str, Any]) -> bool:
        """Return whether the deployment offers that choice, and it results in these settings."""
        return self._source.offers(choice, settings, self.config)

    def find(self, choice: CheckpointChoice) -> LoadedModel | None:
        """Return the model with which an episode of that choice would begin now, or None if it is not loaded."""
        return self.loaded.get(key_of(self._settings(choice)))

    def free(self, choice: CheckpointChoice, *, follows: bool) -> LoadedModel | None:
        """Return the model with which an episode may begin now; None if it has to wait for it, or for its weights.

        Args:
            choice: The chosen checkpoint.
            follows: Whether the episode takes the newest version of the weights.
        """
        model = self.find(choice)
        if model is None or model.key == self.draining:
            return None
        return model if not follows or model.parameters.settle() else None

    def assign(self, session: Session[LoadedModel], model: LoadedModel) -> LoadedModel:
        """Let the session hold the model, in place of any other, and return the model."""
        self.release_model(session)
        self.loaded[model.key] = self.loaded.pop(model.key)  # the most recently used is the last
        session.model = model
        model.sessions += 1
        return model

    def release_model(self, session: Session[LoadedModel]) -> bool:
        """Release the model that the session holds; return whether it held one."""
        model, session.model = session.model, None
        if model is not None:
            model.sessions -= 1
        return model is not None

    def swap(self) -> LoadedModel | None:
        """Put the new settings into effect if their model is loaded, and return that model; otherwise None."""
        model = None if self.next is None else self.loaded.get(key_of(self.next))
        if self.next is not None and model is not None:
            self.config, self.next = self.next, None
        return model

    def pop_due(self) -> DueCallbacks:
        """Remove the sessions that no longer need to wait; return their callbacks with the errors, if any."""
        due: DueCallbacks = []
        for waiter in list(self.waiting):
            error: VLAgentsError | None = None
            if waiter.session.over:
                error = UnknownSession(f"session {waiter.session.id!r}: closed while it waited for {waiter.choice}")
            elif waiter.is_abandoned():
                error = too_late(waiter.choice)
            elif (model := self.free(waiter.choice, follows=waiter.session.follows)) is None:
                continue
            else:
                self.assign(waiter.session, model)
            self.waiting.remove(waiter)
            due.append((waiter.on_loaded, error))
        return due

    def plan(self) -> LoadTask | EvictTask | None:
        """Return the next task, or None; also decides which model is `draining`."""
        self.draining = ""
        idle = [model for model in self.loaded.values() if not model.sessions]
        for model in idle:
            if not self.offers(model.choice, model.settings):
                return EvictTask(model.key)
        wanted = self._most_wanted()
        if wanted is None:
            return None
        task, since = wanted
        if len(self.loaded) < self._source.limit:
            return task
        old = None if self.next is None else self.config  # episodes begin with it during a swap: it is evicted last
        if idle:
            self.draining = min(idle, key=lambda model: model.settings == old).key
            return EvictTask(self.draining)
        oldest = min(self.loaded.values(), key=lambda model: (model.settings == old, model.since))
        if time.monotonic() - since > PATIENCE_S:
            self.draining = oldest.key
        if self.next is not None and self._source.limit == 1:
            return EvictTask(oldest.key, at_once=True)
        return None

    def failed(self, settings: dict[str, Any], failure: str) -> DueCallbacks:
        """Remove the sessions that waited for settings that failed to load; return their callbacks with the error.

        A later request for these settings loads them again.
        """
        if settings == self.next:
            self.next, self.failure = None, failure  # the old settings stay in effect
        failed = [waiter for waiter in self.waiting if self._settings(waiter.choice) == settings]
        self.waiting = [waiter for waiter in self.waiting if waiter not in failed]
        return [(waiter.on_loaded, CheckpointFailed(failure)) for waiter in failed]

    def _settings(self, choice: CheckpointChoice) -> dict[str, Any]:
        return self._source.settings(choice, self.config)

    def _most_wanted(self) -> tuple[LoadTask, float] | None:
        """Return the next model to load, and the start of the wait for it, s; a swap goes first."""
        if self.next is not None:
            return LoadTask(DEFAULT, self.next), float("-inf")
        for waiter in self.waiting:
            if self.find(waiter.choice) is None:
                return LoadTask(waiter.choice, self._settings(waiter.choice)), waiter.since
        return None


def too_late(choice: CheckpointChoice) -> DeadlineExceeded:
    """Return the error for a reset whose caller no longer waits."""
    return DeadlineExceeded(f"{choice} was not loaded in time; ask again, or allow more time")
