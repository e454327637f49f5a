"""The core of a replica, without Ray: one policy, its sessions and its batch queue.

Every endpoint (HTTP, WebSocket, a Serve handle, …) decodes a message, and its `Sender` submits the
requests to the `Intake`, which queues them. The `Runner` takes batches from the queue on the
policy's thread, and delivers the answers. The `ServedModel` loads the policy, and replaces it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from vlagents_ray.contract import Contract
from vlagents_ray.errors import OutcomeUnknown, PolicyUnavailable
from vlagents_ray.interface import Agent
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
from vlagents_ray.serve.models.loaded_model import LoadedModel, Loader, PolicySource
from vlagents_ray.serve.models.served_model import ServedModel
from vlagents_ray.serve.periodic import each_half_second
from vlagents_ray.serve.queue.batch_queue import BatchQueue
from vlagents_ray.serve.queue.call_limits import PolicyCalls
from vlagents_ray.serve.queue.poller import Poller
from vlagents_ray.serve.queue.replica_pace import ReplicaPace, RobotPlan
from vlagents_ray.serve.sessions import DrainList, SessionFinder, SessionTable
from vlagents_ray.serve.weights import Rest, WeightUpdates

_DEFAULT = EngineSettings()


class Engine:
    """Serves a policy to many sessions, from `start`, which loads the policy, to `close`.

    `intake` checks and queues requests, `runner` runs the batches, and `model` is the loaded
    policy. `health` contains the reason if the policy cannot act, and `moves` moves sessions
    between replicas.
    """

    def __init__(
        self,
        policy: Agent | PolicySource,
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
            policy: The agent, or the settings of the policy and the function that creates its
                agents, with which `swap` can load other settings.
            settings: The settings.
            finder: Fetches sessions from other replicas.
            on_step: Called with each step of a long load, on the thread that loads.
            clock: Clock, s; a simulated engine has simulated clocks.
            wall_clock: Wall clock, ns.
            poller: Poller of the queue; that of a simulated engine does not block.
        """
        source = policy if isinstance(policy, PolicySource) else PolicySource(lambda _: policy)
        self.settings, self.clock, self.finder = settings, clock, finder
        self.stats = MetricsBuffer()
        self.observers = Observers()
        self.calls, self.pauses = PolicyCalls(settings.limits, clock), PauseDetector(clock)
        self.drain_list = DrainList()

        self.sessions: SessionTable[LoadedModel] = SessionTable(
            settings.session_limit, settings.session_idle_s, wall_clock
        )
        loader = Loader(
            source.make,
            settings.version,
            settings.padded_sizes,
            settings.max_batch_size,
            settings.check,
            self.calls,
            self.stats,
            invariant=settings.invariant,
        )
        self.model = ServedModel(source.config, loader, self.sessions, on_step)
        self._swapping = threading.Lock()  # held during a swap
        self.weights = WeightUpdates(self.model, self.sessions)
        self.health = Health(self.model, self.calls, self.stats)
        self.queue = BatchQueue(
            settings.max_batch_size,
            sessions=self.sessions,
            idle_s=settings.session_idle_s / 10,
            patience=settings.patience,
            clock=clock,
            poller=poller,
        )
        self.admission = Admission(settings.in_flight_bytes, self.queue.window)

        self.pace = ReplicaPace(self.queue, self._plans, clock)

        parts = EngineParts(
            settings=settings,
            clock=clock,
            sessions=self.sessions,
            model=self.model,
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

    def start(self, config: Mapping[str, Any] | None = None) -> None:
        """Load the policy on its thread, and return when it can act.

        Args:
            config: The settings of the policy, in place of those in its `PolicySource`.

        Raises:
            PolicyFailed: The policy does not load, or not within the time limit.
        """
        if config is not None:
            self.model.config = dict(config)
        try:
            self.runner.start()
        except Exception as error:
            raise self.health.fail_loading(error) from error
        if self.settings.threaded:
            self.pauses.start()
            each_half_second.add(self.queue.lend_poller)
        self.health.finish_loading()

    def swap(self, config: Mapping[str, Any]) -> None:
        """Load the policy with other settings in place of the loaded one, and return when it can
        act. All sessions end. Until the policy can act, requests are rejected with
        `PolicyUnavailable`, and after a failed attempt with `PolicyFailed`, which the next call may
        correct.

        The method does nothing if the policy acts with these settings already. The policy's thread
        must not call it, unless the engine has no threads.

        Raises:
            PolicyFailed: The policy does not load, or not within the time limit.
        """
        with self._swapping:
            if self.model.loaded is not None and dict(config) == self.model.config:
                return
            with suppress(PolicyUnavailable):  # no policy is loaded, or it does not wake
                self.weights.rest(Rest("wake"))
            self.health.begin_loading()
            try:
                self.runner.swap(config)
            except Exception as error:
                raise self.health.fail_loading(error) from error
            self.health.finish_loading()

    def _plans(self) -> list[tuple[RobotPlan, bool]]:
        """Return the plan of each session, and whether a request of the session waits."""
        waiting = self.queue.waiting_sessions()
        return [(session.plan, session.id in waiting) for session in self.sessions.all()]

    def collect_stats(self) -> Collected:
        """Return the metrics recorded since the last call, including the processes of policies that
        run in another Python environment.
        """
        work = self.model.gpu_work_elsewhere()
        if work is not None:
            self.stats.add_gpu_work(work)
        return self.stats.collect()

    @property
    def contract(self) -> Contract | None:
        """Contract of the loaded policy; None if no policy is loaded, or if it has no contract."""
        return self.model.contract

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
        """Answer waiting requests with 503, finish the running batch, and close the agent."""
        self.pauses.stop()
        each_half_second.remove(self.queue.lend_poller)
        self.admission.close()
        self.stop(timeout_s=30)
        self.intake.close()
        self._background.close()
        self.model.close()

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
