"""The core of a replica, without Ray: one policy, its sessions and its batch queue.

Every endpoint (HTTP, WebSocket, a Serve handle, …) decodes a message, and its `Sender` submits the
requests to the engine. The engine runs the policy's thread, which takes batches from the queue,
runs them, and finishes their requests.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from functools import partial
from typing import Any

from vlagents_ray.contract import Contract
from vlagents_ray.errors import (
    ConnectionLost,
    DeadlineExceeded,
    NotReset,
    OutcomeUnknown,
    PolicyFailed,
    PolicyUnavailable,
    UnknownSession,
    VLAgentsError,
)
from vlagents_ray.interface import Act, Agent
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Priority, Reply
from vlagents_ray.serve.engine.admission import Admission
from vlagents_ray.serve.engine.metrics_buffer import MetricsBuffer
from vlagents_ray.serve.engine.observer import Observers
from vlagents_ray.serve.engine.pauses import PauseDetector
from vlagents_ray.serve.engine.responses import (
    build_reply,
    public_error,
    raised_at,
    require_serializable,
    timing,
)
from vlagents_ray.serve.models.checkpoints import Checkpoints
from vlagents_ray.serve.models.loaded_model import LoadedModel, Loader
from vlagents_ray.serve.models.model_manager import ModelManager, too_late
from vlagents_ray.serve.queue.batch_queue import BatchQueue, Taken
from vlagents_ray.serve.queue.call_limits import CallLimits, PolicyCall, PolicyCalls
from vlagents_ray.serve.queue.poller import Poller
from vlagents_ray.serve.queue.preparation import Preparations
from vlagents_ray.serve.requests import (
    NOWHERE,
    Answer,
    CheckpointChoice,
    Opening,
    Origin,
    PendingRequest,
    deliver,
)
from vlagents_ray.serve.sessions import DrainList, Session, SessionFinder, SessionTable
from vlagents_ray.serve.weights import Rest, WeightsVersion, WeightUpdates, follows

logger = logging.getLogger(__name__)

Acting = tuple[PendingRequest, Session[LoadedModel]]

# Share of a batch's time that the policy's thread computes, over which it is busy rather than
# waits.
_WORKING = 0.5


class Engine:
    """Serves an agent, or agents of several checkpoints, to many sessions, from `start` (which
    loads) to `close`.
    """

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
        """Create the engine, without loading the policy.

        Args:
            agent: The agent, or the checkpoints that sessions can choose from.
            max_batch_size: Maximum number of observations in a batch.
            patience: See `BatchQueue`.
            batch_sizes: Sizes to which batches are padded; the largest one is `max_batch_size`.
                Without them, a compiled policy that names no sizes is compiled for 1, 2, 4, …
                `max_batch_size`.
            session_limit: Maximum number of sessions.
            session_idle_s: Time without a request after which a session may be dropped, s.
            version: Version of the policy; sessions only move between replicas of equal version and
                settings.
            check: Raises an error if a policy with that contract cannot be served.
            limits: Time limits of the policy's calls, over which the engine is unhealthy.
            reply_bytes: Maximum size of a reply, bytes.
            in_flight_bytes: Maximum size of all messages in flight, bytes.
            clock: Clock, s; a simulated engine has simulated clocks.
            wall_clock: Wall clock, ns.
            poller: Poller of the queue; that of a simulated engine does not block.
            finder: Fetches sessions from other replicas.
        """
        self._source = agent if isinstance(agent, Checkpoints) else Checkpoints(lambda _: agent)
        self.clock, self.finder = clock, finder
        self.sessions: SessionTable[LoadedModel] = SessionTable(
            session_limit, session_idle_s, wall_clock
        )
        self.calls, self.pauses = PolicyCalls(limits, clock), PauseDetector(clock)
        loader = Loader(self._source, version, batch_sizes, max_batch_size, check, self.calls)
        self.models = ModelManager(self._source, loader, self.sessions)
        self.sessions.ended = self.models.release

        self.stats, self.admission = MetricsBuffer(), Admission(in_flight_bytes)
        loader.on_out_of_memory, loader.on_gpu_ms = self.stats.out_of_memory, self.stats.gpu
        self._batch_sizes, self._reply_bytes = batch_sizes, reply_bytes
        self._preparations: Preparations | None = None  # None if the engine has no threads

        self._loading = self.models.loading()
        self._unready: VLAgentsError | None = self._loading  # error for clients
        # Reason why the policy did not load, for the operator.
        self._failure: PolicyFailed | None = None
        self._hung: PolicyCall | None = None  # overdue call that `notice_hung` found

        # Whether the replica will stop, so that replies request reconnections.
        self.draining = False
        self.drain_list = DrainList()  # connections to move only because others hold fewer sessions
        self.queue = BatchQueue(
            max_batch_size,
            idle_s=session_idle_s / 10,
            patience=patience,
            is_open=self.sessions.__contains__,
            clock=clock,
            poller=poller,
        )

        self._thread = threading.Thread(target=self._serve, name="policy", daemon=True)
        # Done when loading the policy has succeeded or failed.
        self._started: Future[None] = Future()
        # Whether the policy's thread is the engine's own, and not the one that called `start`.
        self.threaded = True
        self.alive = False  # whether a thread takes batches from the queue

        # Answers that another thread sends while the next batch runs.
        self._unsent: list[Answer] = []
        self._answers = ThreadPoolExecutor(1, "policy-answers")
        # Held while the policy's thread runs a batch, and while the policy sleeps.
        self._acting = threading.Lock()
        self.weights = WeightUpdates(
            lambda: self.models.own_weights, self.sessions.all, self._acting
        )
        self.observers = Observers()

    def start(self, *, threaded: bool = True) -> None:
        """Load the policy on its thread, and return when it can act.

        Args:
            threaded: False if the calling thread is the policy's thread, and calls `queue.take` and
                `run` in turns.

        Raises:
            PolicyFailed: The policy does not load, or not within the time limit.
        """
        try:
            self.alive, self.threaded = True, threaded
            if threaded:
                self._thread.start()
                limit_s = self.calls.limits.load_s
                if not wait([self._started], limit_s).done:
                    raise TimeoutError(f"not loaded within {limit_s:g} s, its limit")
                self._started.result()
            else:
                self.models.start()
                self.queue.bind(driven=True)
        except Exception as error:
            failed = f"the policy did not load: {type(error).__name__}"
            self._unready = PolicyFailed(f"{failed}; the server's log says why")
            self._failure = PolicyFailed(f"{failed}: {error}{raised_at(error)}")
            raise self._failure from error

        if threaded:
            self._preparations = Preparations()
            self.pauses.start()
        self._unready = None

    def _serve(self) -> None:
        """Run the policy's thread, which loads the policy and runs its batches."""
        try:
            self.models.start()
        except BaseException as error:  # noqa: BLE001 - raised again by start(), on the caller's thread
            self.alive = False
            self.queue.poller.close()
            self._started.set_exception(error)
            return

        self.queue.bind()
        self._started.set_result(None)
        try:
            while (taken := self.queue.next()) is not None:
                if self._unsent:
                    unsent, self._unsent = self._unsent, []
                    self._answers.submit(deliver, unsent)

                if not self._acting.acquire(blocking=False):
                    self._acting.acquire()  # the policy has slept
                    taken = self._without_late(taken)
                try:
                    self.run(taken)
                finally:
                    self._acting.release()
                del taken  # their observations may be in the sender's memory

            deliver(self._unsent)
            self._answers.shutdown()
            self.queue.poller.close()
        finally:
            self.alive = False

    def _without_late(self, taken: Taken) -> Taken:
        """Return the work without the requests that have become useless since they were taken."""
        now = self.clock()
        late = [
            pending for pending in taken.batch if pending.loaded is None and pending.is_useless(now)
        ]
        for pending in late:
            pending.begun = False
        in_time = [pending for pending in taken.batch if pending not in late]
        return Taken(in_time, [*taken.expired, *late])

    @property
    def ready(self) -> bool:
        """Whether the policy is loaded and healthy."""
        try:
            self.check_health()
        except Exception:  # noqa: BLE001 - a policy's `check_health` may raise any error
            return False
        return True

    def require_ready(self) -> None:
        """Raise `PolicyUnavailable` while the policy loads, `PolicyFailed` if it did not load or
        its thread ended.
        """
        if self._unready is not None:
            raise self.models.loading() if self._unready is self._loading else self._unready
        if not self.alive:
            raise PolicyFailed("the policy's thread has ended")
        if self.calls.broken is not None:
            self.calls.require_device()

    def check_health(self) -> None:
        """Raise the full reason why the policy cannot act, including errors of the agents' own
        health checks.

        The error is meant for the operator, and for the controller that replaces unhealthy
        replicas.
        """
        if self._failure is not None:
            raise self._failure
        overdue = self.calls.overdue()
        if overdue is not None:
            raise PolicyUnavailable(overdue.describe())
        self.require_ready()
        self.calls.check_health()
        self.models.check_health()

    def notice_hung(self) -> None:
        """Refuse requests while a call of the policy exceeds its time limit, and answer the waiting
        ones with an error.

        This is called several times a second, on a thread that makes no calls of the policy.
        """
        call = self.calls.overdue()
        if call is None:
            if self._hung is not None:
                logger.warning("the policy has returned from %r after all", self._hung.op)
                self._hung = None
                if self._failure is None:
                    self._unready = None
            return

        description = call.describe()
        refusal = PolicyUnavailable(f"{description}; the session begins again at another replica")
        if self._hung is None:
            self._hung, self._unready = call, refusal
            logger.error(
                "%s. This replica is not healthy until it does. Its thread:\n%s",
                description,
                call.stack(),
            )
            self.stats.hung(call.op)

        # The policy may still act on the running batch, so its requests must not be sent again;
        # waiting requests may be. This is repeated at each call, since a request that was checked
        # before may be queued later.
        running, waiting = self.queue.clear()
        for pending in running:
            pending.fail(OutcomeUnknown(description))
        for pending in waiting:
            self._fail(pending, refusal)

    def drain(self) -> None:
        """Request all clients, in their next replies, to reconnect to other replicas, since this
        one will stop.
        """
        self.draining = True

    def close(self) -> None:
        """Answer waiting requests with 503, finish the running batch, and close the agents."""
        self.pauses.stop()
        self.admission.close()
        self.stop(timeout_s=30)
        if self._preparations is not None:
            self._preparations.close()
        self.models.close()

    def stop(self, timeout_s: float) -> None:
        """Refuse all requests except those of the running batch, and wait at most `timeout_s`
        for its end.
        """
        # This fails if the policy is loading, or if its GPU has too little memory for it to wake.
        with suppress(Exception):
            self.weights.rest(Rest("wake"))

        stopping = PolicyUnavailable("the replica is stopping; connect again")
        if self._failure is None:
            # Otherwise the end of the policy's thread would be taken for a failure.
            self._unready = stopping
        for pending in self.queue.close():
            self._fail(pending, stopping)
        if self._thread.ident is None:
            self.queue.poller.close()
        elif self._thread is not threading.current_thread():
            self._thread.join(timeout_s)

    @property
    def contract(self) -> Contract | None:
        """Contract of the deployment's own checkpoint; None until that is loaded, or if it has
        no contract.
        """
        return self.models.contract

    def submit(self, requests: Sequence[PendingRequest]) -> None:
        """Check requests, and queue them together; those that cannot be queued are finished with
        their errors.
        """
        ready: list[PendingRequest] = []
        for pending in requests:
            try:
                self.check(pending)
                ready.append(pending)
            except Exception as error:  # noqa: BLE001 - becomes the reply, and affects no other request
                public = public_error(error, pending)
                if not self._seek(pending, public):
                    self._fail(pending, public)

        try:
            if ready:
                self.queue.put(*ready)
        except VLAgentsError as error:
            for pending in ready:
                self._fail(pending, error)

    def check(self, pending: PendingRequest) -> None:
        """Check a request before it is queued, and record the server's decisions in it; raise if
        it is refused.
        """
        request, origin = pending.request, pending.origin
        if (
            request.op == "act"
            and origin.owner
            and not request.session
            and pending.session_id not in origin.sessions
        ):
            raise NotReset("act before reset: this connection has no session yet; reset first")
        self.require_ready()

        if request.op == "act":
            pending.session = session = self.sessions.get(pending.session_id)
            if session.agent is None:
                raise NotReset(
                    f"session {pending.session_id!r}: act before a successful reset; reset first"
                )
            step = request.step
            if step is not None and step > session.steps and step > session.expected:
                raise session.wrong_step(step)

            if pending.episode is None:
                known = origin.sessions.get(pending.session_id)
                pending.episode = self._latest_episode(pending, session) if known is None else known
            if (pending.episode if step is None else step) >= session.expected:
                # An act of an older episode, which will be refused, does not use the session.
                session.origin = origin

            model = session.model  # another thread may set it to None
            if model is not None:
                model.check(request)
                pending.model = model

            if self._preparations is not None and self.queue.window.overlaps:
                pending.preparation = self._preparations.begin(session.agent, request.obs)
        elif request.op == "reset":
            choice, kwargs = self._source.split_options(request.kwargs)
            opening = Opening(
                choice, kwargs, follows(kwargs, by_default=pending.priority is not Priority.ROBOT)
            )
            # If the checkpoint is not loaded, the request is checked after loading.
            model = self.models.loaded(choice)
            if model is not None:
                model.check(request)

            session = self.sessions.open(pending.session_id, origin)
            opening.first = self.sessions.begin(session, request.step)
            session.last_reset = pending.arrived
            pending.opening = opening

        if origin.owner and request.op != "close":
            self._bind(pending)

    def _latest_episode(self, pending: PendingRequest, session: Session[LoadedModel]) -> int:
        """Return the step at which the episode began that an act belongs to whose connection has
        none.

        That is the session's latest one; but an act without a step does not belong to an episode
        that has begun since the connection was opened, or over HTTP, since the act arrived, while
        it waited for a search of its session.
        """
        if pending.request.step is None and session.last_reset > pending.latest_begin:
            raise session.wrong_episode()
        return session.expected

    def _bind(self, pending: PendingRequest) -> None:
        """Record the session of a request as one of its connection's, with the episode that the
        request belongs to.
        """
        sessions, session_id = pending.origin.sessions, pending.session_id
        if pending.opening is not None:
            pending.episode = sessions.get(session_id)
            sessions[session_id] = pending.opening.first
        elif pending.request.op == "act":
            sessions[session_id] = pending.episode
        elif pending.request.op == "adopt":
            sessions[session_id] = None
        else:
            sessions.setdefault(session_id, None)

    def withdraw(self, *requests: PendingRequest) -> None:
        """End requests without an answer, as `BatchQueue.withdraw` does, and undo resets that
        have not begun.
        """
        self.queue.withdraw(*requests)
        for pending in requests:
            pending.drop_preparation()
            self._undo(pending)

    def _undo(self, pending: PendingRequest) -> None:
        if pending.opening is None or pending.begun:
            return
        self.sessions.undo(pending.session_id, pending.opening.first)
        sessions = pending.origin.sessions
        if sessions.get(pending.session_id) == pending.opening.first:
            sessions[pending.session_id] = pending.episode

    def _fail(self, pending: PendingRequest, error: VLAgentsError) -> None:
        """Finish a request with an error, and undo a reset that has not begun."""
        self._undo(pending)
        pending.fail(error)

    def _seek(self, pending: PendingRequest, error: VLAgentsError) -> bool:
        """Search for an act's session at other replicas, and queue the act again; return False if
        there is no search.

        If its session is not found, the act fails with the `error`.
        """
        if (
            self.finder is None
            or pending.sought
            or pending.request.op != "act"
            or pending.is_abandoned
        ):
            return False
        if not isinstance(error, UnknownSession):
            return False
        pending.sought, pending.begun = True, False

        def retry() -> None:
            """Queue the act again once the search has ended."""
            if pending.is_abandoned:
                pending.fail(error)
                return
            try:
                # The session stays elsewhere if its key has no room for it here.
                if pending.session_id not in self.sessions:
                    self.sessions.require_allowed(pending.origin)
                self.check(pending)
                self.queue.put(pending)
            except Exception as later:  # noqa: BLE001 - becomes the reply
                is_same = type(later) is type(error)
                pending.fail(error if is_same else public_error(later, pending))

        origin = pending.origin
        searcher = origin.owner if origin.caller is None else origin.caller.name
        if self.finder.fetch(pending.session_id, retry, searcher, partial(self._user_of, pending)):
            return True
        if self.draining:  # the replica has given its sessions to others
            pending.fail(
                PolicyUnavailable(
                    "the replica is stopping; connect again, or send the same request again"
                )
            )
            return True
        return False

    def _user_of(
        self, pending: PendingRequest, state: dict[str, Any], began: float
    ) -> Origin | None:
        """Return the origin of an act if it can be executed on a session in that state, at another
        replica, else None.

        If it cannot be, the session stays where it is. The session's episode `began` at that time,
        s.
        """
        if pending.is_abandoned:
            return None
        episode = pending.episode or pending.origin.sessions.get(pending.session_id)
        if pending.request.step is not None:
            fits = pending.request.step == state["steps"]
        elif episode is not None:
            fits = episode == state["first"]
        else:
            fits = began <= pending.latest_begin
        return pending.origin if fits else None

    def run(self, taken: Taken) -> None:
        """Answer the expired requests, and run the batch. Called on the policy's thread."""
        for pending in taken.expired:
            self._fail(pending, _not_taken(pending))
        if not taken.batch:
            self.sessions.drop_idle()
            return
        self.queue.begin(taken.batch)
        try:
            self._run(taken.batch)
        except BaseException as error:
            # A policy that calls sys.exit() must not end the replica's only thread. Where the
            # caller's thread runs the policy, Ctrl-C ends it.
            if not self.threaded and not isinstance(error, SystemExit):
                raise
            logger.exception("the batch failed")
            for pending in taken.batch:
                pending.fail(PolicyFailed(f"the policy raised {type(error).__name__}"))
        self.queue.end()

    def _run(self, batch: Sequence[PendingRequest]) -> None:
        acting: dict[tuple[LoadedModel, WeightsVersion], list[Acting]] = {}
        for pending in batch:
            try:
                if pending.request.op == "act":
                    session, model, weights = self._ready(pending)
                    acting.setdefault((model, weights), []).append((pending, session))
                elif pending.opening is not None:
                    deliver(self._reset(pending, pending.opening))
                else:
                    deliver([self._other(pending)])
            except Exception as error:  # noqa: BLE001 - becomes the reply
                public = public_error(error, pending)
                if pending.request.op == "act":
                    pending.begun = False  # the policy has not received it
                    if pending.session_id not in self.sessions and self._seek(pending, public):
                        continue
                self._fail(pending, public)

        for (model, weights), group in acting.items():
            prepared_s = 0.0
            if self.queue.window.slow:
                group, prepared_s = self._prepared(model, group)  # noqa: PLW2901 - without those that failed
            if group:
                deliver(self._act(model, weights, group, prepared_s))

    def _reset(self, pending: PendingRequest, opening: Opening) -> Sequence[Answer]:
        """Begin the episode of a reset, and return the answer to the reset, if it is due.

        A reset whose checkpoint is not loaded leaves the queue. It is queued again when the
        checkpoint is loaded, or answered with an error if loading fails. Meanwhile the session may
        be reset again or closed, or its client may stop waiting.
        """
        session_id = pending.session_id
        if pending.loaded is None:
            if self.sessions.is_past(session_id, opening.first):
                raise UnknownSession(
                    f"session {session_id!r}: reset elsewhere, or ended, while this reset waited"
                )

            session = self.sessions.open(session_id, pending.origin)
            session.agent, session.weights, session.follows = None, None, opening.follows
            session.steps, session.resetting = opening.first, pending
            session.first, session.moves = opening.first, 0
            session.expected = max(session.expected, opening.first)
            session.began = pending.arrived
            session.last_reset = max(session.last_reset, pending.arrived)

            is_abandoned = partial(self._is_abandoned, pending, session)
            requeue = partial(self._requeue, pending)
            if self.models.hold(session, opening.choice, requeue, is_abandoned) is None:
                # The policy does no work on it while its checkpoint is loaded.
                pending.begun = False
                return ()  # `_requeue` queues it again
        else:
            session = self.sessions.get(session_id)
            if session.resetting is not pending:
                raise UnknownSession(
                    f"session {session_id!r}: reset anew, or closed, while this reset waited"
                )
            if self._is_abandoned(pending, session):
                self.models.release_model(session)
                raise too_late(opening.choice)

        session.resetting = None
        try:
            return self._begin_episode(pending, opening, session)
        except BaseException:
            # The session must not hold the model without an episode.
            self.models.release_model(session)
            raise

    def _begin_episode(
        self, pending: PendingRequest, opening: Opening, session: Session[LoadedModel]
    ) -> Sequence[Answer]:
        """Begin an episode on the model that the session holds, and return the answer, if it is
        due now.
        """
        request, model = pending.request, session.model
        if model is None or request.obs is None:  # the decoder ensures the second condition
            raise UnknownSession(
                f"session {pending.session_id!r}: closed before its reset was over"
            )
        model.check(request)

        with model.busy, model.uncaptured, model.call("reset") as call:
            model.require_open()
            model.parameters.use(model.parameters.begin(session, follows=opening.follows))
            agent = model.copies.make()
            info = agent.reset(request.obs, request.instruction, **opening.kwargs)
            if not isinstance(info, dict):
                raise PolicyFailed(f"reset: the policy returned {type(info).__name__}, want a dict")
            for obs in request.history:
                agent.observe(obs)

        info = {**model.identity, **info}  # a session with an adapter returns both by itself
        spent = timing(pending, call.began, call.ended)
        require_serializable(info, self._reply_bytes)
        session.agent, session.instruction = agent, request.instruction or ""
        model.padding.record_reset(request, opening.kwargs)
        request.drop_observations()

        reply = Reply(request.request_id, info=info, step=session.steps, timing=spent)
        if session.announced or self.finder is None:
            return [(pending, reply)]
        session.announced = True
        # The session's acts come over the same connection, to this replica.
        if pending.origin.owner:
            self.finder.announce(session.id, session.steps)
            return [(pending, reply)]
        # The next act may come to a replica that still has an older episode.
        self.finder.announce(session.id, session.steps, (pending, reply))
        return ()

    def _requeue(self, pending: PendingRequest, error: VLAgentsError | None) -> None:
        """Queue a reset again whose checkpoint is loaded, or answer it with the error."""
        pending.loaded = self.clock()
        try:
            if error is not None:
                raise error
            self.queue.put(pending)
        except VLAgentsError as reason:
            pending.request.drop_observations()  # the session may still refer to the request
            pending.fail(reason)

    def _is_abandoned(self, pending: PendingRequest, session: Session[LoadedModel]) -> bool:
        """Return whether the caller of that reset no longer waits, or the session was reset
        again.
        """
        return (
            pending.is_abandoned
            or pending.expired(self.clock())
            or session.resetting is not pending
        )

    def _other(self, pending: PendingRequest) -> Answer:
        """Run a request that is neither an act nor a reset, and return the answer."""
        session_id, request = pending.session_id, pending.request
        info: dict[str, Any] = {}
        if request.op == "export":
            info = self.export(session_id)
        elif request.op == "release":
            info = {"released": self.sessions.release(session_id, request.kwargs["version"])}
        elif request.op == "adopt":
            # The replica of this process reuses names, for sessions that it compares.
            self.sessions.free(session_id)
            # That replica decides which version of the weights acts: the session's may be older, or
            # not held here.
            self.adopt(session_id, {**request.kwargs, "parameters": self.weights.acting()})
        elif request.op == "observe":
            self._observe(pending)
        elif request.op == "weights":
            self.weights.obey(**request.kwargs)
        else:
            self.sessions.close(session_id)
            pending.origin.sessions.pop(session_id, None)
        return pending, Reply(request.request_id, info=info)

    def _ready(
        self, pending: PendingRequest
    ) -> tuple[Session[LoadedModel], LoadedModel, WeightsVersion]:
        session: Session[LoadedModel] | None = pending.session
        # Since the lookup the session has ended, or arrived here from another replica.
        if session is None or session.over:
            session = self.sessions.get(pending.session_id)
        model, weights = session.model, session.weights
        # An earlier reset in the queue failed, or still waits for its checkpoint.
        if session.agent is None:
            raise NotReset(f"session {pending.session_id!r}: its last reset failed; reset again")
        step = pending.request.step
        if step is not None and step != session.steps:
            raise session.wrong_step(step)
        if step is None and pending.episode is not None and pending.episode != session.first:
            raise session.wrong_episode()
        if model is None or weights is None:
            raise UnknownSession(f"session {pending.session_id!r}: has just been closed; reset it")
        # A reset before it in the queue chose another model, or the session has arrived since.
        if model is not pending.model:
            model.check(pending.request)
        return session, model, weights

    def _observe(self, pending: PendingRequest) -> None:
        session, model, weights = self._ready(pending)
        # `_ready` and the decoder ensure both conditions.
        if session.agent is not None and pending.request.obs is not None:
            with model.busy, model.uncaptured, model.call("observe"):
                model.require_open()
                model.parameters.use(weights)
                session.agent.observe(pending.request.obs)
        pending.request.drop_observations()

    def _prepared(self, model: LoadedModel, acting: list[Acting]) -> tuple[list[Acting], float]:
        """Finish the preparations of observations, and answer the requests whose preparation
        failed.

        Returns:
            The remaining requests, and the duration, s, which counts as inference.
        """
        preparations = [(pending.preparation, session.agent) for pending, session in acting]
        if all(preparation is None for preparation, _ in preparations):
            return acting, 0.0
        with model.busy, model.uncaptured, model.call("act", "prepare") as call:
            errors = {} if model.closed else Preparations.finish(preparations)

        for index, error in errors.items():
            pending = acting[index][0]
            pending.request.drop_observations()
            pending.fail(public_error(error, pending))

        prepared = [pair for index, pair in enumerate(acting) if index not in errors]
        return prepared, call.ended - call.began

    def _act(
        self,
        model: LoadedModel,
        weights: WeightsVersion,
        acting: Sequence[Acting],
        prepared_s: float,
    ) -> list[Answer]:
        """Act in sessions with one version of one model's weights, and return the answers that are
        due now.
        """
        observations = [pending.request.obs for pending, _ in acting]
        agents = [session.agent for _, session in acting]
        padding = 0
        if self._batch_sizes:
            with model.busy, model.uncaptured:
                padding = model.pad(observations, agents)

        rows = len(observations)
        call = model.call("act", rows if self._batch_sizes else None)
        slow = self.queue.window.slow
        # The time is not measured for fast acts: two calls take a fiftieth of the fastest ones.
        worked_s = time.thread_time() if slow else 0.0
        try:
            with model.busy, model.uncaptured, call:
                model.require_open()
                model.parameters.use(weights)
                results: Sequence[Act | Exception] = model.agent.act_batch(observations, agents)  # type: ignore[arg-type]
            if len(results) != rows:
                raise PolicyFailed(
                    f"act_batch: got {rows} observations, returned {len(results)} actions"
                )
        except Exception as error:  # noqa: BLE001 - becomes the replies
            results = [error] * rows

        worked_s = time.thread_time() - worked_s if slow else 0.0
        # This is skipped for a lone act that succeeded like the one before: it would take a
        # hundredth of the act's time.
        if len(acting) > 1 or isinstance(results[0], Exception) or model.calls.failed_batches:
            model.calls.record_batch(results[: len(acting)])

        del observations  # they may be in the sender's memory
        for pending, _ in acting:
            pending.request.drop_observations()
        if padding:
            model.padding.check_results(results[len(acting) :])
            results = results[: len(acting)]

        # Replies to simulations are sent while the next full batch runs. After a full batch this
        # also applies to robots, if the policy leaves the interpreter to other threads while it
        # waits for a GPU or another process. If it computes in Python, the slowest robots would
        # wait longer.
        defer = self.queue.full_batch_waits()
        robots = len(acting) == self.queue.largest and worked_s < _WORKING * (
            call.ended - call.began
        )

        answers: list[Answer] = []
        for (pending, session), result in zip(acting, results, strict=True):
            reply = build_reply(
                pending, session, result, model.contract, self._reply_bytes, weights.info
            )
            if reply.error is None:
                reply.timing = timing(pending, call.began - prepared_s, call.ended)
                reply.timing["batch_size"] = len(acting)
            if defer and (robots or pending.priority is not Priority.ROBOT):
                self._unsent.append((pending, reply))
            else:
                answers.append((pending, reply))
        self.stats.batch(len(acting), rows)
        return answers

    # Sessions that move between replicas: their state is bytes and settings.

    def export(self, session_id: str) -> dict[str, Any]:
        """Return the state that another replica needs to continue the session after its release
        here.
        """
        session = self.sessions.get(session_id)
        model, weights = session.model, session.weights
        if session.agent is None or model is None or weights is None:
            raise UnknownSession(f"session {session_id!r}: not reset yet")
        with model.busy, model.uncaptured, model.call("export"):
            agent = model.copies.dump(session.agent)
        return {
            "agent": agent,
            "steps": session.steps,
            "first": session.first,
            "moves": session.moves,
            "began": session.began,
            "version": list(model.version),
            "choice": [model.choice.name, model.choice.step],
            "settings": model.settings,
            "parameters": [weights.number, weights.fingerprint],
            "follows": session.follows,
            "instruction": session.instruction,
        }

    def adopt(self, session_id: str, state: dict[str, Any], timeout_s: float = 0.0) -> None:
        """Continue a session that another replica has released.

        Args:
            session_id: Id of the session.
            state: The `info` of the other replica's reply to "export".
            timeout_s: Maximum time for loading the session's checkpoint, s; 0 if it must be loaded
                already.

        Raises:
            UnknownSession: The session has, or had, a newer state here, has begun a reset, or needs
                a checkpoint or a version of the policy that is not available here.
        """
        self.enter(self.prepare_adoption(session_id, state, timeout_s))

    def prepare_adoption(
        self,
        session_id: str,
        state: dict[str, Any],
        timeout_s: float = 0.0,
        began: float = 0.0,
        origin: Origin = NOWHERE,
        weights: Mapping[str, Any] | None = None,
    ) -> Session[LoadedModel]:
        """Create a copy of the session that cannot act before `enter`; if it is not needed, call
        `abandon`.

        Its episode `began` at that time, s, of this engine's clock, or later. From now on it counts
        for the key of the `origin`. `weights` are the values of its version of the weights, if that
        is not held here.
        """
        self.require_ready()
        self.sessions.require_room(session_id)

        first, moves = state["first"], state["moves"] + 1
        arriving: Session[LoadedModel] = Session(
            session_id,
            steps=state["steps"],
            first=first,
            expected=first,
            began=began,
            last_reset=began,
            moves=moves,
            announced=True,
            origin=origin,
        )
        self.sessions.expect(arriving)
        try:
            model = self.models.adopt(
                arriving, CheckpointChoice(*state["choice"]), state["settings"], timeout_s
            )
            if tuple(state["version"]) != model.version:
                raise UnknownSession(
                    f"session {session_id!r}: of another version of the policy; reset it"
                )

            number, fingerprint = state["parameters"]
            # The session holds the version until `find` returns it, or a newer one.
            if weights is not None:
                arriving.weights = model.parameters.restore(number, fingerprint, weights)
            arriving.weights = model.parameters.find(number, fingerprint, follows=state["follows"])
            with model.busy, model.uncaptured, model.call("adopt", threading.get_ident()):
                arriving.agent = model.copies.load(state["agent"])
            arriving.follows, arriving.instruction = state["follows"], state["instruction"]
        except BaseException:
            self.abandon(arriving)
            raise
        return arriving

    def enter(self, arriving: Session[LoadedModel]) -> None:
        """Add a prepared session to the table, so that it acts here from now on."""
        model = arriving.model
        try:
            self.sessions.enter(arriving)
        except BaseException:
            self.abandon(arriving)
            raise
        if model is not None:
            model.parameters.catch_up(arriving)

    def abandon(self, arriving: Session[LoadedModel]) -> None:
        """Drop a prepared session that is not needed."""
        self.sessions.forget_expected(arriving)
        self.models.release(arriving)


def _not_taken(pending: PendingRequest) -> VLAgentsError:
    """Return the error for a request that the policy has not received, and never will."""
    if pending.origin.ended:
        return ConnectionLost("its connection has ended: not acted on, and never will be")
    return DeadlineExceeded(
        f"no action within {pending.request.deadline_ms:g} ms: dropped before inference"
    )
