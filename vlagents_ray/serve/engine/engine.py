"""The core of a replica, without Ray: one policy, its sessions and its batch queue.

Every endpoint (HTTP, WebSocket, a Serve handle, …) decodes a message into `Request`s and queues them;
a callback on a thread of the batch queue receives the reply.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence

from vlagents_ray.contract import Contract
from vlagents_ray.errors import (
    DeadlineExceeded,
    NotReset,
    PolicyFailed,
    PolicyUnavailable,
    UnknownSession,
    VLAgentsError,
)
from vlagents_ray.interface import Act, Agent
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Reply, Request
from vlagents_ray.serve.engine.admission import Admission
from vlagents_ray.serve.engine.arrival import PauseDetector
from vlagents_ray.serve.engine.metrics_buffer import MetricsBuffer
from vlagents_ray.serve.engine.resets import Resets
from vlagents_ray.serve.engine.responses import Watchers, build_reply, public_error, raised_at, timing
from vlagents_ray.serve.engine.session_transfer import DrainList, SessionTransfer
from vlagents_ray.serve.models.checkpoints import Checkpoints
from vlagents_ray.serve.models.loaded_model import LoadedModel, Loader
from vlagents_ray.serve.models.model_manager import ModelManager
from vlagents_ray.serve.queue.batch_queue import BatchQueue, PendingRequest, Rank
from vlagents_ray.serve.queue.call_limits import CallLimits, PolicyCall, PolicyCalls
from vlagents_ray.serve.queue.poller import Poller
from vlagents_ray.serve.queue.preparation import Preparations
from vlagents_ray.serve.sessions import Session, SessionFinder, SessionTable
from vlagents_ray.serve.weights.updates import WeightUpdates, follows
from vlagents_ray.serve.weights.versions import WeightsVersion

logger = logging.getLogger(__name__)

Acting = tuple[PendingRequest, Session[LoadedModel]]


class Engine:
    """Serves an agent, or agents of several checkpoints, to many sessions, from `start` (which loads) to `close`."""

    def __init__(
        self,
        agent: Agent | Checkpoints,
        *,
        max_batch_size: int = 16,
        patience: float = 0.0,
        batch_sizes: Sequence[int] = (),
        session_limit: int = 1000,
        session_idle_s: float = 600.0,
        version: str = "",
        check: Callable[[Contract | None], None] = lambda _: None,
        limits: CallLimits | None = None,
        reply_bytes: int = DEFAULT_LIMITS.reply_bytes,
        in_flight_bytes: int = DEFAULT_LIMITS.in_flight_bytes,
        clock: Callable[[], float] = time.perf_counter,
        wall_clock: Callable[[], int] = time.time_ns,
        poller: Poller | None = None,
        finder: SessionFinder | None = None,
    ) -> None:
        """With `batch_sizes`, batches are padded to the next of these sizes; the largest is `max_batch_size`.
        Without, a compiled policy that names no sizes is compiled for 1, 2, 4, … `max_batch_size`.

        `version` is the policy's version: sessions only move between replicas of equal version and settings. `check`
        raises an error if a policy with that contract cannot be served. A call over its `limits` makes the engine
        unhealthy. Larger replies than `reply_bytes` are not sent; messages in flight take at most `in_flight_bytes`. A
        simulated engine gets simulated clocks (s and ns), and a `poller` that does not block. `finder` finds sessions.
        """
        self._source = agent if isinstance(agent, Checkpoints) else Checkpoints(lambda _: agent)
        self.clock, self.finder = clock, finder
        self.sessions: SessionTable[LoadedModel] = SessionTable(
            session_limit, session_idle_s, wall_clock, self._session_ended
        )
        self.calls, self.pauses = PolicyCalls(limits, clock), PauseDetector(clock)
        loader = Loader(self._source, version, batch_sizes, max_batch_size, check, self.calls)
        self.models = ModelManager(self._source, loader, self.sessions)
        self.stats, self.admission = MetricsBuffer(), Admission(in_flight_bytes)
        loader.on_out_of_memory = self.stats.out_of_memory
        self._batch_sizes, self._reply_bytes = batch_sizes, reply_bytes
        self._preparations: Preparations | None = None  # None if the engine has no threads
        self._loading = self.models.loading()
        self._unready: VLAgentsError | None = self._loading  # for clients
        self._failure: PolicyFailed | None = None  # why the policy did not load, for the operator
        self._hung: PolicyCall | None = None  # overdue call that `notice_hung` found
        self.draining = False  # whether the replica will stop, so that replies ask clients to reconnect elsewhere
        self.drain_list = DrainList()  # connections asked to reconnect only because others hold fewer sessions
        self.queue = BatchQueue(
            self._run,
            max_batch_size,
            prepare=self.models.start,
            idle=self.sessions.drop_idle,
            idle_s=session_idle_s / 10,
            patience=patience,
            is_open=self.sessions.__contains__,
            clock=clock,
            poller=poller,
        )
        self.weights = WeightUpdates(lambda: self.models.own_weights, self.sessions.all)
        self.transfer = SessionTransfer(self.sessions, self.models, self.require_ready)
        self._resets = Resets(self.sessions, self.models, self.queue, finder, clock, reply_bytes)
        self.watchers = Watchers()

    def start(self, *, threaded: bool = True) -> None:
        """Initialize the agent, and return when it can act; raises `PolicyFailed` if it does not load.

        See `BatchQueue.start` for `threaded`.
        """
        try:
            self.queue.start(self.calls.limits.load_s, threaded=threaded)
        except Exception as error:
            failed = f"the policy did not load: {type(error).__name__}"
            self._unready = PolicyFailed(f"{failed}; the server's log says why")
            self._failure = PolicyFailed(f"{failed}: {error}{raised_at(error)}")
            raise self._failure from error
        if threaded:
            self._preparations = Preparations()
            self.pauses.start()
        self._unready = None

    @property
    def ready(self) -> bool:
        """Whether the policy is loaded and healthy."""
        try:
            self.check_health()
        except Exception:  # noqa: BLE001 - a policy's `check_health` may raise any error
            return False
        return True

    def require_ready(self) -> None:
        """Raise `PolicyUnavailable` while the policy loads, `PolicyFailed` if it did not load or its thread ended."""
        if self._unready is not None:
            raise self.models.loading() if self._unready is self._loading else self._unready
        if not self.queue.alive():
            raise PolicyFailed("the policy's thread has ended")
        if self.calls.broken is not None:
            self.calls.require_device()

    def check_health(self) -> None:
        """Raise the full reason why the policy cannot act, including errors of the agents' own health checks.

        It is meant for the operator, and for the controller that replaces unhealthy replicas.
        """
        if self._failure is not None:
            raise self._failure
        if (call := self.calls.overdue()) is not None:
            raise PolicyUnavailable(call.describe())
        self.require_ready()
        self.calls.check_health()
        self.models.check_health()

    def notice_hung(self) -> None:
        """Refuse requests while a call of the policy exceeds its time limit, and answer those that wait for it.

        This is called several times a second, on a thread that makes no calls of the policy.
        """
        call = self.calls.overdue()
        if call is None:
            if self._hung is not None:
                logger.warning("the policy has returned from %r after all", self._hung.op)
                self._hung = self._unready = None
            return
        if self._hung is not None:
            return
        self._hung, said = call, call.describe()
        logger.error("%s. This replica is not healthy until it does. Its thread:\n%s", said, call.stack())
        self.stats.hung(call.op)
        self._unready = PolicyUnavailable(f"{said}; the session begins again at another replica")
        # The policy may still act on the running batch, so its requests must not be sent again; waiting ones may be.
        self.queue.fail(DeadlineExceeded(said), self._unready)

    def drain(self) -> None:
        """Ask all clients, with their next replies, to reconnect to other replicas, since this one will stop."""
        self.draining = True

    def close(self) -> None:
        """Answer waiting requests with 503, finish the running batch, and close the agents."""
        self.pauses.stop()
        self.admission.close()
        self.queue.close(timeout_s=30)
        if self._preparations is not None:
            self._preparations.close()
        self.models.close()

    @property
    def contract(self) -> Contract | None:
        """Contract of the deployment's own checkpoint; None until that is loaded, or if it has no contract."""
        return self.models.contract

    @property
    def version(self) -> tuple[str, str]:
        """Version of the policy; replicas of equal versions can take over each other's sessions."""
        return self.models.version

    def ticket(
        self,
        session_id: str,
        request: Request,
        done: Callable[[Reply], None],
        *,
        owner: str = "",
        connection: str = "",
        transport: str = "",
        quota: tuple[str, int | None] | None = None,
        arrived: float | None = None,
    ) -> PendingRequest:
        """Check a request, raising its errors, and return its ticket for the queue; `done` receives the reply.

        `owner` is the connection with which the session ends; empty for a caller without one. `connection` is
        the source whose turn it is in the queue, if that carries several sessions. See `SessionTable.open` for
        `quota`. `arrived` is the time at which the deadline begins, s of `clock`; by default now.
        """
        self.require_ready()
        rank = Rank.SIMULATION if request.rank == "simulation" else Rank.ROBOT
        arrived = self.clock() if arrived is None else arrived
        ticket = PendingRequest(
            session_id, request, done, rank, arrived, connection=connection, owner=owner, transport=transport
        )
        if request.op == "act":
            session = self.sessions.get(session_id)
            if session.agent is None:
                raise NotReset(f"session {session_id!r}: act before a successful reset; reset first")
            if (step := request.step) is not None and step > session.steps and step > session.expected:
                raise session.wrong_step(step)
            session.owner, session.transport, session.connection = owner, transport, connection
            if (model := session.model) is not None:  # another thread may set it to None
                model.check(request)
            if self._preparations is not None and self.queue.window.overlaps:
                ticket.preparation = self._preparations.begin(session.agent, request.obs)
        elif request.op == "reset":
            ticket.choice, request.kwargs = self._source.split_options(request.kwargs)
            ticket.follows = follows(request.kwargs, by_default=rank is not Rank.ROBOT)
            if (model := self.models.loaded(ticket.choice)) is not None:  # otherwise it is checked after loading
                model.check(request)
            session = self.sessions.open(session_id, owner, transport, connection, quota)
            ticket.first = self.sessions.begin(session, request.step)
        return ticket

    def submit(self, session_id: str, request: Request, done: Callable[[Reply], None]) -> PendingRequest:
        """Queue a request, and return its ticket; `done` receives the reply."""
        ticket = self.ticket(session_id, request, done)
        self.queue.put(ticket)
        return ticket

    def withdraw(self, *tickets: PendingRequest) -> None:
        """Cancel requests as `BatchQueue.withdraw` does, and undo resets that have not begun."""
        self.queue.withdraw(*tickets)
        for ticket in tickets:
            if ticket.request.op == "reset" and not ticket.begun:
                self.sessions.undo(ticket.session_id, ticket.first)

    def _session_ended(self, session: Session[LoadedModel]) -> None:
        self.models.release(session)

    def _run(self, batch: Sequence[PendingRequest]) -> None:
        """Answer every ticket of a batch. Called on the policy's thread."""
        acting: dict[tuple[LoadedModel, WeightsVersion], list[Acting]] = {}
        for ticket in batch:
            try:
                if ticket.request.op == "act":
                    session, model, weights = self._ready(ticket)
                    acting.setdefault((model, weights), []).append((ticket, session))
                elif ticket.request.op == "reset":
                    self._resets.run(ticket)
                elif ticket.request.op == "export":
                    self.transfer.export(ticket)
                elif ticket.request.op == "release":
                    self.transfer.release(ticket)
                elif ticket.request.op == "observe":
                    self._observe(ticket)
                else:
                    if ticket.request.op == "adopt":
                        self.transfer.adopt(ticket.session_id, ticket.request.kwargs)
                    else:
                        self.sessions.close(ticket.session_id)
                    ticket.answer(Reply(ticket.request.request_id, info={}))
            except Exception as error:  # noqa: BLE001 - becomes the reply
                ticket.begun = ticket.begun and ticket.request.op != "act"  # the policy has not received this act
                ticket.answer(Reply(ticket.request.request_id, error=public_error(error, ticket)))
        for (model, weights), group in acting.items():
            prepared_s = 0.0
            if self.queue.window.slow:
                group, prepared_s = self._prepared(model, group)  # noqa: PLW2901 - without those that failed
            if group:
                self._act(model, weights, group, prepared_s)

    def _ready(self, ticket: PendingRequest) -> tuple[Session[LoadedModel], LoadedModel, WeightsVersion]:
        session = self.sessions.get(ticket.session_id)
        model, weights = session.model, session.weights
        if session.agent is None:  # an earlier reset in the queue failed, or waits for its checkpoint
            raise NotReset(f"session {ticket.session_id!r}: its last reset failed; reset again")
        step = ticket.request.step
        if step is not None and step != session.steps:
            raise session.wrong_step(step)
        if model is None or weights is None:
            raise UnknownSession(f"session {ticket.session_id!r}: has just been closed; reset it")
        return session, model, weights

    def _observe(self, ticket: PendingRequest) -> None:
        session, model, weights = self._ready(ticket)
        if session.agent is not None and ticket.request.obs is not None:  # `_ready` and the decoder ensure both
            with model.busy, model.uncaptured, model.call("observe"):
                model.require_open()
                model.parameters.use(weights)
                session.agent.observe(ticket.request.obs)
        ticket.request.obs = None
        ticket.answer(Reply(ticket.request.request_id, info={}))

    def _prepared(self, model: LoadedModel, acting: list[Acting]) -> tuple[list[Acting], float]:
        """Finish the preparations of observations, and answer the requests whose preparation failed.

        Returns:
            The other requests, and the time that this took, s, which counts as inference.
        """
        preparations = [(ticket.preparation, session.agent) for ticket, session in acting]
        if all(preparation is None for preparation, _ in preparations):
            return acting, 0.0
        with model.busy, model.uncaptured, model.call("act", "prepare") as call:
            errors = {} if model.closed else Preparations.finish(preparations)
        for place, error in errors.items():
            ticket = acting[place][0]
            ticket.request.obs = None
            ticket.answer(Reply(ticket.request.request_id, error=public_error(error, ticket)))
        return [one for place, one in enumerate(acting) if place not in errors], call.ended - call.began

    def _act(self, model: LoadedModel, weights: WeightsVersion, acting: Sequence[Acting], prepared_s: float) -> None:
        """Answer the act requests of sessions with one version of one model's weights."""
        observations = [ticket.request.obs for ticket, _ in acting]
        agents = [session.agent for _, session in acting]
        padding = model.pad(observations, agents) if self._batch_sizes else 0
        rows = len(observations)
        call = model.call("act", rows if self._batch_sizes else None)
        try:
            with model.busy, model.uncaptured, call:
                model.require_open()
                model.parameters.use(weights)
                results: Sequence[Act | Exception] = model.agent.act_batch(observations, agents)  # type: ignore[arg-type]
            if len(results) != rows:
                raise PolicyFailed(f"act_batch: got {rows} observations, returned {len(results)} actions")
        except Exception as error:  # noqa: BLE001 - becomes the replies
            results = [error] * rows
        # Not after a lone act that succeeded as the one before did: the calls would be a hundredth of its time.
        if len(acting) > 1 or isinstance(results[0], Exception) or model.calls.failed_batches:
            model.calls.record_batch(results[: len(acting)])
        del observations  # they may lie in memory that their sender needs back
        for ticket, _ in acting:
            ticket.request.obs = None
        if padding:
            model.padding.check_results(results[len(acting) :])
            results = results[: len(acting)]
        defer = self.queue.full_batch_waits()
        unsent = []
        for (ticket, session), result in zip(acting, results, strict=True):
            reply = build_reply(ticket, session, result, model.contract, self._reply_bytes, weights.info)
            reply.timing = timing(ticket.arrived, call.began - prepared_s, call.ended)
            reply.timing["batch_size"] = len(acting)
            if defer and ticket.rank is not Rank.ROBOT:
                unsent.append((ticket, reply))
            else:
                ticket.answer(reply)
        if unsent:
            self.queue.answer_later(unsent)
        self.stats.batch(len(acting), rows)
