"""The core of a replica, without Ray: one policy, its sessions and its batch queue.

Every endpoint (HTTP, WebSocket, a Serve handle, …) decodes a message, and its `Sender` submits the
requests to the `Intake`, which queues them. The `Runner` takes batches from the queue on the
policy's thread, and delivers the answers. The `ModelManager` loads checkpoints.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress

from vlagents_ray.contract import Contract
from vlagents_ray.errors import OutcomeUnknown
from vlagents_ray.interface import Agent
from vlagents_ray.protocol.messages import Priority
from vlagents_ray.serve.engine.admission import Admission
from vlagents_ray.serve.engine.background_calls import BackgroundCalls
from vlagents_ray.serve.engine.health import Health
from vlagents_ray.serve.engine.intake import Intake
from vlagents_ray.serve.engine.metrics_buffer import Collected, MetricsBuffer
from vlagents_ray.serve.engine.moves import SessionMoves
from vlagents_ray.serve.engine.observer import Observers
from vlagents_ray.serve.engine.parts import EngineParts
from vlagents_ray.serve.engine.pauses import PauseDetector
from vlagents_ray.serve.engine.runner import Runner
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.models.checkpoints import Checkpoints
from vlagents_ray.serve.models.loaded_model import LoadedModel, Loader
from vlagents_ray.serve.models.model_manager import ModelCache, ModelManager
from vlagents_ray.serve.periodic import each_half_second
from vlagents_ray.serve.queue.batch_queue import BatchQueue
from vlagents_ray.serve.queue.call_limits import PolicyCalls
from vlagents_ray.serve.queue.poller import Poller
from vlagents_ray.serve.queue.replica_pace import ReplicaPace
from vlagents_ray.serve.sessions import DrainList, SessionFinder, SessionTable
from vlagents_ray.serve.weights import Rest, WeightUpdates

_DEFAULT = EngineSettings()


class Engine:
    """Serves an agent, or agents of several checkpoints, to many sessions, from `start`, which
    loads the policy, to `close`.

    `intake` checks and queues requests, `runner` runs the batches, and `models` loads checkpoints.
    `health` contains the reason if the policy cannot act, and `moves` moves sessions between
    replicas.
    """

    def __init__(
        self,
        agent: Agent | Checkpoints,
        settings: EngineSettings = _DEFAULT,
        *,
        finder: SessionFinder | None = None,
        on_step: Callable[[str], None] | None = None,
        clock: Callable[[], float] = time.perf_counter,
        wall_clock: Callable[[], int] = time.time_ns,
        poller: Poller | None = None,
    ) -> None:
        """Create the engine, without loading the policy.

        Args:
            agent: The agent, or the checkpoints among which sessions can choose.
            settings: The settings.
            finder: Fetches sessions from other replicas.
            on_step: Called with each step of a long load, on the thread that loads.
            clock: Clock, s; a simulated engine has simulated clocks.
            wall_clock: Wall clock, ns.
            poller: Poller of the queue; that of a simulated engine does not block.
        """
        source = agent if isinstance(agent, Checkpoints) else Checkpoints(lambda _: agent)
        self.settings, self.clock, self.finder = settings, clock, finder
        self.stats = MetricsBuffer()
        self.observers = Observers()
        self.calls, self.pauses = PolicyCalls(settings.limits, clock), PauseDetector(clock)
        self.drain_list = DrainList()

        cache = ModelCache(source)
        self.sessions: SessionTable[LoadedModel] = SessionTable(
            settings.session_limit, settings.session_idle_s, wall_clock, cache
        )
        loader = Loader(
            source,
            settings.version,
            settings.batch_sizes,
            settings.max_batch_size,
            settings.check,
            self.calls,
            self.stats,
        )
        self.models = ModelManager(source, loader, cache, self.sessions, on_step, self._quiet_s)
        self.weights = WeightUpdates(self.models, self.sessions)
        self.health = Health(self.models, self.calls, self.stats)
        self.queue = BatchQueue(
            settings.max_batch_size,
            sessions=self.sessions,
            idle_s=settings.session_idle_s / 10,
            patience=settings.patience,
            clock=clock,
            poller=poller,
        )
        self.admission = Admission(settings.in_flight_bytes, self.queue.window)

        self.pace = ReplicaPace(
            self.queue.window.curve,
            lambda: [session.plan for session in self.sessions.all()],
            settings.max_batch_size,
            clock,
            lambda: self.queue.depth_of(Priority.ROBOT),
        )

        parts = EngineParts(
            settings=settings,
            clock=clock,
            source=source,
            sessions=self.sessions,
            models=self.models,
            weights=self.weights,
            queue=self.queue,
            pace=self.pace,
            health=self.health,
            stats=self.stats,
            drain_list=self.drain_list,
            finder=finder,
        )
        self._background = BackgroundCalls(parts)
        self.intake, self.moves = Intake(parts, self._background), SessionMoves(parts)
        self.runner = Runner(parts, self.intake, self.moves)

    def start(self) -> None:
        """Load the policy on its thread, and return when it can act.

        Raises:
            PolicyFailed: The policy does not load, or not within the time limit.
        """
        try:
            self.runner.start()
        except Exception as error:
            raise self.health.fail_loading(error) from error
        if self.settings.threaded:
            self.pauses.start()
            each_half_second.add(self.queue.lend_poller)
        self.health.finish_loading()

    def collect_stats(self) -> Collected:
        """Return the metrics recorded since the last call, including the processes of policies that
        run in another Python environment.
        """
        for work in self.models.gpu_work_elsewhere():
            self.stats.add_gpu_work(work)
        return self.stats.collect()

    def _quiet_s(self) -> float:
        """Return the time since a model last computed actions, s; 0 while a model computes, or
        while the policy sleeps.
        """
        return 0.0 if self.weights.acting_lock.locked() else self.queue.quiet_s()

    @property
    def contract(self) -> Contract | None:
        """Contract of the deployment's own checkpoint; None if the checkpoint is not loaded yet or
        has no contract.
        """
        return self.models.contract

    @property
    def draining(self) -> bool:
        """Whether the replica will stop, so that replies request reconnections."""
        return self.drain_list.draining

    def notice_hung(self) -> None:
        """Reject requests while a call of the policy exceeds its time limit, and answer waiting
        requests with an error. This method is called several times per second, on a thread that
        does not call the policy.
        """
        hanging = self.health.find_hanging_call()
        if hanging is None:
            return

        # The policy may still process the running batch, so its requests must not be sent again,
        # unlike waiting requests. Each call does this again, since a request that was checked
        # before a call may be queued after it.
        running, waiting = self.queue.clear()
        for pending in running:
            pending.fail(OutcomeUnknown(hanging.description))
        for pending in waiting:
            self.intake.fail(pending, hanging.refusal)

    def close(self) -> None:
        """Answer waiting requests with 503, finish the running batch, and close the agents."""
        self.pauses.stop()
        each_half_second.remove(self.queue.lend_poller)
        self.admission.close()
        self.stop(timeout_s=30)
        self.intake.close()
        self._background.close()
        self.models.close()

    def stop(self, timeout_s: float) -> None:
        """Reject all requests except the requests in the running batch, and wait at most
        `timeout_s` for the end of that batch.
        """
        # This fails if the policy is loading, or if the GPU has too little memory to wake the
        # policy.
        with suppress(Exception):
            self.weights.rest(Rest("wake"))

        stopping = self.health.stop()
        for pending in self.queue.close():
            self.intake.fail(pending, stopping)
        self.runner.join(timeout_s)
