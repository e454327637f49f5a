"""Manages the checkpoints in the memory of a replica. They are loaded on demand, and evicted when
another checkpoint needs the memory.

The first checkpoint is loaded on the policy's thread. The thread `checkpoints` then loads and
evicts all other checkpoints, one at a time, while sessions of loaded checkpoints act. `ModelCache`
decides which checkpoint is next.

Ray's `serve.multiplexed` only counts models. At its limit, it unloads the least recently requested
model, even while sessions use that model, and never waits for the sessions. This cache tracks the
sessions instead.

A deployment's own settings can change (`ModelManager.configure`). The new checkpoint is then loaded
next to the old one. New episodes use the new checkpoint, and the old one is evicted when its last
episode has ended.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from vlagents_ray.abilities import BeginsWithPlan, ChecksHealth, ContinuesPlans, ability
from vlagents_ray.contract import Contract
from vlagents_ray.errors import (
    CheckpointFailed,
    DeadlineExceeded,
    PolicyUnavailable,
    UnknownSession,
    VLAgentsError,
)
from vlagents_ray.interface import Agent
from vlagents_ray.policies.base.accelerator import free_memory, gpu_memory
from vlagents_ray.policies.base.program import Program
from vlagents_ray.serve.models.checkpoints import Checkpoints, resolved
from vlagents_ray.serve.models.loaded_model import (
    ComputesElsewhere,
    GpuWork,
    LoadedModel,
    Loader,
    key_of,
)
from vlagents_ray.serve.requests import DEFAULT, CheckpointChoice
from vlagents_ray.serve.sessions import Session, SessionTable
from vlagents_ray.serve.weights import ModelWeights
from vlagents_ray.weights.trainable import beside_acts

# Waiting time for a slot after which a checkpoint in use accepts no more episodes.
PATIENCE_S = 10.0

# Callback with the argument None when a session holds its model, or with the error if loading
# failed.
OnLoaded = Callable[[VLAgentsError | None], None]
# Callbacks to call, each with its argument.
DueCallbacks = list[tuple[OnLoaded, VLAgentsError | None]]
logger = logging.getLogger(__name__)

# Time without an act after which the deferred loading of a model continues, s. An act that arrives
# meanwhile waits for up to a second.
QUIET_S = 5.0
# Interval of the checks whether callers are still waiting, and whether models compute, s.
_CHECK_S = 1.0
# Longest wait for the thread `checkpoints`, and for the running batch of each model, s.
_CLOSE_S = 10.0


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


@dataclass(frozen=True, slots=True)
class DeferredTask:
    """The task to continue the deferred loading of a model."""

    key: str  # key of the model


class ModelCache:
    """The eviction policy: the loaded models, the sessions that wait for other models, and the next
    task. It uses no threads; its lock `changed` guards all calls. If all slots are in use:

    - The least recently used checkpoint without a session is evicted.
    - If all have sessions, the waiting sessions wait for episodes to end. After `PATIENCE_S`, the
      checkpoint that was loaded first accepts no more episodes, until its sessions have ended and
      it is evicted. Ten checkpoints can therefore share two slots, and each of them stays loaded
      for long enough to be worth loading.
    """

    def __init__(self, source: Checkpoints) -> None:
        # Condition that is held during all calls, and notified after changes.
        self.changed = threading.Condition()
        self.config = source.config  # the deployment's own settings in effect
        self.next: dict[str, Any] | None = None  # settings of a swap that has not finished
        self.failure: str | None = None  # error of the last swap
        # Models by the keys of their settings, the least recently used first.
        self.loaded: dict[str, LoadedModel] = {}
        self.waiting: list[Waiter] = []  # waiting sessions in order of arrival
        self.draining = ""  # key of the model that accepts no more episodes before its eviction
        self._source = source

    def describe(self) -> dict[str, Any]:
        """Return the available choices, the loaded checkpoints and the state of the last swap,
        for the metadata.
        """
        swap = None
        if self.next is not None:
            swap = {"state": "loading", "checkpoint": resolved(self.next)}
        elif self.failure is not None:
            swap = {"state": "failed", "error": self.failure}
        loaded = [model.checkpoint for model in self.loaded.values()]
        weights = [model.weights for model in self.loaded.values()]
        return {
            **self._source.describe(self.config),
            "loaded": loaded,
            "weights": weights,
            "swap": swap,
        }

    def find(self, choice: CheckpointChoice) -> LoadedModel | None:
        """Return the model that an episode of the choice would use now; None if that model is
        not loaded.
        """
        return self.loaded.get(key_of(self._settings(choice)))

    def free(self, choice: CheckpointChoice) -> LoadedModel | None:
        """Return the model that an episode of the choice may use now; None if the episode must wait
        for the model.
        """
        model = self.find(choice)
        return None if model is None or model.key == self.draining else model

    def assign(self, session: Session[LoadedModel], model: LoadedModel) -> LoadedModel:
        """Assign the model to the session, which may have had another model, and return
        the model.
        """
        self._take_model(session)
        # The most recently used model is the last one.
        self.loaded[model.key] = self.loaded.pop(model.key)
        session.model = model
        model.sessions += 1
        return model

    def release_model(self, session: Session[LoadedModel]) -> bool:
        """Release the model that the session holds, and return whether the session held a model;
        may be called without the lock.
        """
        with self.changed:
            held = self._take_model(session)
            if held:
                self.changed.notify_all()
            return held

    def _take_model(self, session: Session[LoadedModel]) -> bool:
        model, session.model = session.model, None
        if model is not None:
            model.sessions -= 1
        return model is not None

    def swap(self) -> LoadedModel | None:
        """Put the new settings into effect if their model is loaded, and return the model;
        otherwise return None.
        """
        model = None if self.next is None else self.loaded.get(key_of(self.next))
        if self.next is not None and model is not None:
            self.config, self.next = self.next, None
        return model

    def pop_due(self) -> DueCallbacks:
        """Remove the sessions whose wait has ended. Return their callbacks, each with its error or
        None.
        """
        due: DueCallbacks = []
        for waiter in list(self.waiting):
            error: VLAgentsError | None = None
            if waiter.session.over:
                error = UnknownSession(
                    f"session {waiter.session.id!r}: closed while it waited for {waiter.choice}"
                )
            elif waiter.is_abandoned():
                error = too_late(waiter.choice)
            elif (model := self.free(waiter.choice)) is None:
                continue
            else:
                self.assign(waiter.session, model)
            self.waiting.remove(waiter)
            due.append((waiter.on_loaded, error))
        return due

    def plan(self, fits: Callable[[int], bool]) -> LoadTask | EvictTask | None:
        """Return the next task, or None. This also decides which model is `draining`.

        `fits` returns whether one more model fits into memory next to the given number of models.
        """
        self.draining = ""
        idle = [model for model in self.loaded.values() if not model.sessions]
        for model in idle:
            if not self._source.offers(model.choice, model.settings, self.config):
                return EvictTask(model.key)

        awaited = self._next_load()
        if awaited is None:
            return None
        task, since = awaited

        limit = self._source.limit
        if len(self.loaded) < limit:
            if fits(len(self.loaded)):
                return task
            limit = len(self.loaded)

        # During a swap, episodes still begin with the old settings, so the model of these settings
        # is evicted last.
        old = None if self.next is None else self.config
        if idle:
            self.draining = min(idle, key=lambda model: model.settings == old).key
            return EvictTask(self.draining)
        oldest = min(self.loaded.values(), key=lambda model: (model.settings == old, model.since))
        if time.monotonic() - since > PATIENCE_S:
            self.draining = oldest.key
        if self.next is not None and limit == 1:
            return EvictTask(oldest.key, at_once=True)
        return None

    def next_deferring(self) -> str | None:
        """Return the key of a model that is not loaded completely; None if all models
        are complete.
        """
        return next((key for key, model in self.loaded.items() if model.deferred is not None), None)

    def failed(self, settings: dict[str, Any], failure: str) -> DueCallbacks:
        """Remove the sessions that waited for settings that failed to load; return their callbacks
        with the error.

        A later request for these settings loads them again.
        """
        if settings == self.next:
            self.next, self.failure = None, failure  # the old settings stay in effect
        failed = [waiter for waiter in self.waiting if self._settings(waiter.choice) == settings]
        self.waiting = [waiter for waiter in self.waiting if waiter not in failed]
        return [(waiter.on_loaded, CheckpointFailed(failure)) for waiter in failed]

    def _settings(self, choice: CheckpointChoice) -> dict[str, Any]:
        return self._source.settings(choice, self.config)

    def _next_load(self) -> tuple[LoadTask, float] | None:
        """Return the next model to load, and the start of the wait, s. A swap has priority."""
        if self.next is not None:
            return LoadTask(DEFAULT, self.next), float("-inf")
        for waiter in self.waiting:
            if self.find(waiter.choice) is None:
                return LoadTask(waiter.choice, self._settings(waiter.choice)), waiter.since
        return None


def too_late(choice: CheckpointChoice) -> DeadlineExceeded:
    """Return the error for a reset whose caller no longer waits."""
    return DeadlineExceeded(f"{choice} was not loaded in time; try again, or allow more time")


class ModelManager:
    """Manages the models of a replica. Thread-safe: it releases its lock before it calls other
    components.
    """

    def __init__(
        self,
        source: Checkpoints,
        loader: Loader,
        cache: ModelCache,
        sessions: SessionTable[LoadedModel],
        on_step: Callable[[str], None] | None = None,
        quiet_s: Callable[[], float] = lambda: 0.0,
    ) -> None:
        """Manage the models of a replica.

        Args:
            source: The checkpoints of the deployment.
            loader: Loads models.
            cache: The loaded models, which the sessions release when they end.
            sessions: The sessions of the replica. If a model is evicted immediately, its sessions
                are closed.
            on_step: Called with each step of a long first load, on the thread that loads.
            quiet_s: Returns the time since a model last computed actions, s; 0 if deferred parts
                may not be loaded now.
        """
        # Whether chunks of the deployment's own model continue the executed plan.
        self.continues_plans = False
        # Maximum number of rows of the executed plan that a chunk repeats exactly at its beginning;
        # 0 for none.
        self.longest_prefix = 0
        # Contract of the last loaded model among the deployment's own models.
        self.contract: Contract | None = None
        # Weights of the last loaded model among the deployment's own models.
        self.weights: dict[str, Any] | None = None
        self.devices: list[dict[str, Any]] = []  # devices of that model
        self.files: Program = {}  # digests of the files named in the settings of that model
        self.step = ""  # the step of a long first load, such as "compiling 4 rows (3 of 5)"
        self._on_step, self._quiet_s = on_step, quiet_s
        self._source, self._loader = source, loader
        self._sessions = sessions
        self._first: Agent | None = None
        self._fingerprint = ""
        self._cache, self._changed = cache, cache.changed
        self._begun = self._loaded = self._closed = self._full = False
        self._thread = threading.Thread(target=self._loop, name="checkpoints", daemon=True)

    @property
    def config(self) -> dict[str, Any]:
        """The deployment's own settings in effect."""
        return self._cache.config

    def configure(self, config: Mapping[str, Any]) -> None:
        """Set the deployment's own settings. The first call sets the initial settings; a later call
        starts a swap.
        """
        settings = dict(config)
        with self._changed:
            if not self._begun:
                self._begun, self._cache.config = True, settings
                self._first = self._source.make(settings)
            else:
                self._cache.next = None if settings == self.config else settings
                self._cache.failure = None
                self._wake()

    def start(self) -> None:
        """Load the deployment's own checkpoint on the calling thread.

        Raises:
            BaseException: The checkpoint cannot be served.
        """
        self._begun = True
        first, self._first = self._first, None
        model = self._loader.load(DEFAULT, self.config, self._set_step, first)
        with self._changed:
            self._cache.loaded[model.key] = model
            self._set_own_model(model)
            self._loaded = True
            if self._cache.next is not None:
                self._wake()

    def close(self) -> None:
        """Unload all models; waiting sessions get `PolicyUnavailable`."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread.ident is not None:
            self._thread.join(_CLOSE_S)
        with self._changed:
            waiting, self._cache.waiting = self._cache.waiting, []
            loaded, self._cache.loaded = self._cache.loaded, {}
        _run_callbacks([(waiter.on_loaded, _stopping()) for waiter in waiting])
        for model in loaded.values():
            model.close(_CLOSE_S)

    def check_health(self) -> None:
        """Raise the error of the first loaded agent whose health check fails."""
        with self._changed:
            loaded = list(self._cache.loaded.values())
        for model in loaded:
            checks = ability(model.agent, ChecksHealth)
            if checks is not None:
                checks.check_health()

    @property
    def version(self) -> tuple[str, str]:
        """Version of the policy, which is equal in replicas of the same policy with
        equal settings.
        """
        return self._loader.version(self.config), self._fingerprint

    @property
    def own_weights(self) -> ModelWeights:
        """Versions of the weights of the deployment's own model; raises `PolicyUnavailable` before
        that model is loaded.
        """
        with self._changed:
            model = self._cache.find(DEFAULT)
        if model is None:
            raise self.loading()
        return model.parameters

    @property
    def uncompiled(self) -> list[str]:
        """Return the parts of the loaded models that run without compilation, although their
        settings request it.
        """
        uncompiled: list[str] = []
        with self._changed:
            for model in self._cache.loaded.values():
                uncompiled.extend(model.report.uncompiled)
        return uncompiled

    def gpu_memory(self) -> dict[str, int]:
        """Return the memory of the GPUs of the loaded models, see `accelerator.gpu_memory`; "free"
        is the least of the amounts that the processes can allocate there.
        """
        by_process = [gpu_memory(self.devices)]
        for agent in self._agents_elsewhere():
            by_process.append(agent.gpu_memory())

        total = Counter[str]()
        for memory in by_process:
            total.update(memory)
        free = [memory["free"] for memory in by_process if memory]
        return {**total, "free": min(free)} if free else {}

    def gpu_work_elsewhere(self) -> list[GpuWork]:
        """Return the GPU work of each other process of the replica since the last call."""
        return [agent.gpu_work() for agent in self._agents_elsewhere()]

    def _agents_elsewhere(self) -> list[ComputesElsewhere]:
        """Return the loaded agents that compute in other processes."""
        with self._changed:
            agents = [model.agent for model in self._cache.loaded.values()]
        return [agent for agent in agents if isinstance(agent, ComputesElsewhere)]

    def _fits(self, loaded: int) -> bool:
        """Return whether the GPU has enough memory for one more checkpoint, assuming that it takes
        as much memory as each loaded checkpoint.
        """
        memory, full = self.gpu_memory() if loaded else {}, self._full
        self._full = bool(memory) and memory["free"] * loaded < memory["reserved"]
        if self._full and not full:
            cure = f"set checkpoints: {{loaded: {loaded}}}, or smaller batch.sizes"
            logger.warning(
                "the next checkpoint waits until one of the %d loaded checkpoints leaves the "
                "GPU: %s bytes; %s",
                loaded,
                memory,
                cure,
            )
        return not self._full

    def loading(self) -> PolicyUnavailable:
        """Return the error for clients while the first checkpoint is loaded. The error contains the
        current step of loading.
        """
        return PolicyUnavailable(
            f"the policy is loading{self.step and f' ({self.step})'}; try again"
        )

    def describe(self) -> dict[str, Any]:
        """Return the available choices, the loaded checkpoints and the state of the last swap,
        for the metadata.
        """
        with self._changed:
            return self._cache.describe()

    def loaded(self, choice: CheckpointChoice) -> LoadedModel | None:
        """Return the model that an episode of the choice would use now; None if that model is not
        loaded.
        """
        with self._changed:
            return self._cache.find(choice)

    def hold(
        self,
        session: Session[LoadedModel],
        choice: CheckpointChoice,
        on_loaded: OnLoaded,
        is_abandoned: Callable[[], bool] = lambda: False,
    ) -> LoadedModel | None:
        """Return the model for a session's next episode. The session keeps the model until the next
        call for this session, or until the session ends.

        Args:
            session: The session; it releases the model that it held before.
            on_loaded: Called only if the session has to wait for the model: with None once the
                session has the model, or with the error.
            is_abandoned: Returns whether the caller no longer waits.

        Returns:
            The model; None if the session has to wait for the model.
        """
        with self._changed:
            self._require_open()
            self._cache.release_model(session)

            model = self._cache.free(choice)
            if model is not None and not session.over:
                return self._cache.assign(session, model)
            self._cache.waiting.append(Waiter(session, choice, on_loaded, is_abandoned))
            self._wake()
            return None

    def adopt(
        self,
        session: Session[LoadedModel],
        choice: CheckpointChoice,
        settings: Mapping[str, Any],
        timeout_s: float,
    ) -> LoadedModel:
        """Return the model for a session from another replica.

        If the deployment offers that model, the model is loaded, unless loading takes longer than
        `timeout_s`.

        Raises:
            UnknownSession: The session cannot continue here.
        """
        with self._changed:
            self._require_open()
            model = self._cache.loaded.get(key_of(settings))
            if model is not None:
                return self._cache.assign(session, model)
            if timeout_s <= 0 or not self._source.offers(choice, settings, self.config):
                raise UnknownSession(
                    f"session {session.id!r}: {choice} is not loaded here; reset it"
                )

        done = threading.Event()
        errors: list[VLAgentsError] = []

        def on_loaded(error: VLAgentsError | None) -> None:
            errors.extend([] if error is None else [error])
            done.set()

        if self.hold(session, choice, on_loaded) is None:
            done.wait(timeout_s)
        if session.model is not None:
            return session.model
        if errors:
            raise errors[0]
        raise UnknownSession(
            f"session {session.id!r}: loading {choice} takes too long; reset the session"
        )

    def release_model(self, session: Session[LoadedModel]) -> None:
        """Release the model of a session that has no episode."""
        self._cache.release_model(session)

    def _require_open(self) -> None:
        if self._closed:
            raise _stopping()

    def _wake(self) -> None:
        """Wake up the thread `checkpoints`, which then checks for work. The first call after
        `start` starts the thread.
        """
        if self._thread.ident is None and self._loaded and not self._closed:
            self._thread.start()
        self._changed.notify_all()

    def _set_step(self, step: str) -> None:
        if not self._loaded:
            self.step = step
            if self._on_step is not None:
                self._on_step(step)

    def _set_own_model(self, model: LoadedModel) -> None:
        self.contract, self._fingerprint = model.contract, model.version[1]
        plans = ability(model.agent, ContinuesPlans)
        self.continues_plans = plans is not None and plans.continues_plans
        prefixes = ability(model.agent, BeginsWithPlan)
        self.longest_prefix = 0 if prefixes is None else prefixes.longest_prefix
        self.weights, self.files, self.devices = model.weights, model.files, model.report.devices

    def _loop(self) -> None:
        while (task := self._next_task()) is not None:
            try:
                if isinstance(task, LoadTask):
                    self._load(task)
                elif isinstance(task, EvictTask):
                    self._unload(task)
                elif isinstance(task, DeferredTask):
                    self._load_deferred(task)
                else:
                    _run_callbacks(task)
            except Exception:
                logger.exception("the thread of the checkpoints continues")

    def _next_task(self) -> LoadTask | EvictTask | DeferredTask | DueCallbacks | None:
        """Wait for the next task, or for callbacks that are due, and return them; None after
        `close`.
        """
        with self._changed:
            while not self._closed:
                model = self._cache.swap()
                if model is not None:
                    self._set_own_model(model)
                    logger.info("new episodes begin with %s", model.checkpoint)

                # This comes before `plan`, which might evict a model that was just loaded.
                due = self._cache.pop_due()
                if due:
                    return due

                draining = self._cache.draining
                task = self._cache.plan(self._fits)
                if task is not None:
                    return task

                deferring = self._cache.next_deferring()
                if deferring is not None and self._quiet_s() >= QUIET_S:
                    return DeferredTask(deferring)
                if self._cache.draining == draining:
                    must_check = self._cache.waiting or deferring is not None
                    self._changed.wait(_CHECK_S if must_check else None)
        return None

    def _load(self, task: LoadTask) -> None:
        begun = time.monotonic()
        try:
            with beside_acts(None):
                model = self._loader.load(
                    task.choice, task.settings, self._set_step, beside_acts=True
                )
        except BaseException as error:
            logger.exception("%s did not load", task.choice)
            failure = (
                f"{task.choice} did not load: {type(error).__name__}; the server's log says why"
            )
            with self._changed:
                due = self._cache.failed(task.settings, failure)
        else:
            logger.info(
                "%s: loaded %s in %.1f s", task.choice, model.checkpoint, time.monotonic() - begun
            )
            with self._changed:
                if not self._closed:
                    self._cache.loaded[model.key] = model
                    return
            model.close()
            return
        _run_callbacks(due)
        free_memory()

    def _load_deferred(self, task: DeferredTask) -> None:
        with self._changed:
            model = self._cache.loaded.get(task.key)
        if model is not None:
            with beside_acts(None):
                self._loader.load_deferred(model)

    def _unload(self, task: EvictTask) -> None:
        with self._changed:
            model = self._cache.loaded[task.key]
        if task.at_once:
            logger.info(
                "there is room for only one checkpoint: the sessions of the old checkpoint end, "
                "so that the next one can be loaded"
            )
            self._sessions.close_those_of(model)
        with self._changed:
            # A session that moves here from another replica may hold the model, and not be in a
            # table yet.
            if task.at_once and model.sessions:
                self._changed.wait(_CHECK_S)
            if model.sessions:  # a session still holds the model, or has been assigned it meanwhile
                return
            del self._cache.loaded[task.key]
        logger.info("%s: unloading %s", model.choice, model.checkpoint)
        model.close()
        del model
        free_memory()


def _stopping() -> PolicyUnavailable:
    return PolicyUnavailable("the replica is stopping; connect again")


def _run_callbacks(due: DueCallbacks) -> None:
    for on_loaded, error in due:
        on_loaded(error)
