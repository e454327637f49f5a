"""The policy's thread, which takes batches from the queue and runs them.

Each call of the policy returns the answers as values, which are delivered after the call. Answers
to simulations may be delivered on another thread, while the next batch runs.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, InvalidStateError, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

from vlagents_ray.abilities import Observes, ability
from vlagents_ray.errors import (
    ConnectionLost,
    DeadlineExceeded,
    NotReset,
    PolicyFailed,
    PolicyUnavailable,
    UnknownSession,
    VLAgentsError,
)
from vlagents_ray.interface import REPLAN, Act
from vlagents_ray.policies.wrapper import unwrapped
from vlagents_ray.protocol.messages import Priority, Reply
from vlagents_ray.serve.engine.ability_call import AbilityCall
from vlagents_ray.serve.engine.intake import Intake
from vlagents_ray.serve.engine.moves import SessionMoves
from vlagents_ray.serve.engine.parts import EngineParts
from vlagents_ray.serve.engine.responses import (
    build_reply,
    public_error,
    require_serializable,
    timing,
)
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.queue.batch_queue import Taken
from vlagents_ray.serve.queue.preparation import Preparations
from vlagents_ray.serve.requests import Answer, Opening, PendingRequest, ReservedAct, deliver
from vlagents_ray.serve.sessions import Session, SessionState
from vlagents_ray.serve.weights import WeightsVersion
from vlagents_ray.validation import check_options

logger = logging.getLogger(__name__)

Acting = tuple[PendingRequest, Session[LoadedModel]]

# Share of a batch's time in which the policy's thread computes, above which the thread counts as
# busy rather than waiting.
_WORKING = 0.5


@dataclass(frozen=True, slots=True)
class Swap:
    """The task to load the policy with other settings, in place of the loaded one."""

    config: Mapping[str, Any]
    done: Future[None] = field(default_factory=Future)


class Runner:
    """Loads the policy, and runs its batches, on one thread: the policy's thread.

    Only `start`, `swap` and `join` may be called on another thread.
    """

    def __init__(self, parts: EngineParts, intake: Intake, moves: SessionMoves) -> None:
        self._intake = intake
        self._moves = moves
        self._health = parts.health
        self._sessions = parts.sessions
        self._model = parts.model
        self._weights = parts.weights
        self._queue = parts.queue
        self._pace = parts.pace
        self._stats = parts.stats
        self._finder = parts.finder
        self._clock = parts.clock
        self._batch_sizes = parts.settings.padded_sizes
        self._reply_bytes = parts.settings.reply_bytes
        self._load_s = parts.settings.limits.load_s

        # Whether the engine has a separate thread for the policy. If not, the thread that calls
        # `start` is the policy's thread.
        self.threaded = parts.settings.threaded
        self._thread = threading.Thread(target=self._serve, name="policy", daemon=True)
        # Future that is done when loading the policy has succeeded or failed.
        self._started: Future[None] = Future()
        self._next_swap: Swap | None = None  # the swap that follows the running batch
        # Answers that another thread delivers while the next batch runs.
        self._unsent: list[Answer] = []
        self._answers = ThreadPoolExecutor(1, "policy-answers")

    def start(self) -> None:
        """Load the policy on its thread, and return when it can act.

        Raises:
            BaseException: Any error of the policy's initialization.
            TimeoutError: The policy does not load within the time limit.
        """
        self._health.begin_thread()
        if not self.threaded:
            self._model.load()
            self._queue.bind(driven=True)
            return

        self._thread.start()
        if not wait([self._started], self._load_s).done:
            raise TimeoutError(f"not loaded within {self._load_s:g} s, its limit")
        self._started.result()

    def swap(self, config: Mapping[str, Any]) -> None:
        """Load the policy with other settings, in place of the loaded one, on the policy's thread
        after its running batch; return when the policy can act. One call at a time.

        Raises:
            BaseException: Any error of the policy's initialization.
            TimeoutError: The policy does not load within the time limit.
        """
        swap = Swap(config)
        if not self.threaded:
            self._swap(swap)
            return swap.done.result()

        self._next_swap = swap
        self._queue.interrupt()
        if not self._health.alive:
            self._end_swap()
        if not wait([swap.done], self._load_s).done:
            raise TimeoutError(f"not loaded within {self._load_s:g} s, its limit")
        return swap.done.result()

    def _swap(self, swap: Swap) -> None:
        """Load the policy with other settings. No request may be left, since it would refer to the
        model, whose memory must be freed.
        """
        self._reject_waiting()
        try:
            self._model.load(swap.config)
        except BaseException as error:  # noqa: BLE001 - raised again by swap(), on the caller's thread
            swap.done.set_exception(error)
        else:
            swap.done.set_result(None)

    def _reject_waiting(self) -> None:
        """Deliver the answers of the last batch, and answer the waiting requests with an error."""
        deliver(self._unsent)
        self._unsent = []
        _, waiting = self._queue.clear()
        for pending in waiting:
            self._intake.fail(pending, self._model.loading())

    def join(self, timeout_s: float) -> None:
        """Wait at most `timeout_s` for the end of the thread. The queue must be closed."""
        if self._thread.ident is None:
            self._queue.poller.close()
        elif self._thread is not threading.current_thread():
            self._thread.join(timeout_s)

    def _serve(self) -> None:
        """Load the policy, and run its batches until the queue is closed."""
        try:
            self._model.load()
        except BaseException as error:  # noqa: BLE001 - raised again by start(), on the caller's thread
            self._health.end_thread()
            self._queue.poller.close()
            self._started.set_exception(error)
            return

        self._queue.bind()
        self._started.set_result(None)
        acting = self._weights.acting_lock
        try:
            while (taken := self._queue.next()) is not None:
                if self._unsent:
                    unsent, self._unsent = self._unsent, []
                    self._answers.submit(deliver, unsent)
                    # The sessions of these answers may end before the next answers are deferred.
                    del unsent

                if not acting.acquire(blocking=False):
                    # The policy sleeps; clients' pings are still answered.
                    self._queue.poller.hand_to_reader()
                    acting.acquire()
                    self._queue.poller.reclaim()
                    taken = self._without_late(taken)
                try:
                    self.run(taken)
                finally:
                    acting.release()
                del taken  # the observations may be in the sender's memory

                if self._next_swap is not None:
                    swap, self._next_swap = self._next_swap, None
                    self._queue.poller.hand_to_reader()  # later requests are rejected at once
                    self._swap(swap)
                    self._queue.poller.reclaim()

            deliver(self._unsent)
            self._answers.shutdown()
            self._queue.poller.close()
        finally:
            self._health.end_thread()
            self._end_swap()

    def _end_swap(self) -> None:
        """End a swap that the policy's thread will not begin, since the thread ends; called on
        either thread, and perhaps on both.
        """
        swap, self._next_swap = self._next_swap, None
        if swap is not None:
            with suppress(InvalidStateError):
                swap.done.set_exception(PolicyUnavailable("the replica is stopping; connect again"))

    def _without_late(self, taken: Taken) -> Taken:
        """Return the work without requests that have become useless since they left the queue."""
        now = self._clock()
        late = [pending for pending in taken.batch if pending.is_useless(now)]
        self._queue.give_back(late)
        in_time = [pending for pending in taken.batch if pending not in late]
        return Taken(in_time, [*taken.expired, *late])

    def run(self, taken: Taken) -> None:
        """Answer the expired requests, and run the batch. Called on the policy's thread."""
        for pending in taken.expired:
            self._intake.fail(pending, _not_taken(pending, self._clock()))
        if not taken.batch:
            self._sessions.drop_idle()
            if self._pace.robots:
                self._pace.load()
            return
        self._queue.begin(taken.batch)
        try:
            self._run(taken.batch)
        except BaseException as error:
            # A policy that calls sys.exit() must not end the replica's only thread. If the caller's
            # thread runs the policy, Ctrl-C ends that thread.
            if not self.threaded and not isinstance(error, SystemExit):
                raise
            logger.exception("the batch failed")
            for pending in taken.batch:
                failed = PolicyFailed(f"the policy raised {type(error).__name__}")
                self._intake.fail(pending, failed)
        self._queue.end()
        if self._pace.robots:
            self._pace.load()

    def _run(self, batch: Sequence[PendingRequest]) -> None:
        acting: dict[tuple[LoadedModel, WeightsVersion], list[Acting]] = {}
        for pending in batch:
            try:
                if pending.request.op == "act":
                    session, model, weights = self._ready(pending)
                    acting.setdefault((model, weights), []).append((pending, session))
                elif isinstance(pending.reserved, Opening):
                    deliver(self._reset(pending, pending.reserved))
                else:
                    deliver([self._other(pending)])
            except Exception as error:  # noqa: BLE001 - becomes the reply
                public = public_error(error, pending)
                if pending.request.op in ("act", "close"):
                    self._queue.give_back([pending])
                    is_elsewhere = pending.session_id not in self._sessions
                    if is_elsewhere and self._intake.search(pending, public):
                        continue
                self._intake.fail(pending, public)

        for (model, weights), group in acting.items():
            prepared_s = 0.0
            if self._queue.window.slow:
                group, prepared_s = self._prepared(model, group)  # noqa: PLW2901 - only the prepared ones
            if group:
                deliver(self._act(model, weights, group, prepared_s))

    def _reset(self, pending: PendingRequest, opening: Opening) -> Sequence[Answer]:
        """Begin the episode of a reset, and return the answer to the reset, if it is due now."""
        request = pending.request
        model = self._model.require_loaded()
        if request.obs is None:  # the decoder ensures that a reset has an observation
            raise PolicyFailed("reset: expected an observation, got none")
        model.check(request)
        check_options(unwrapped(model.agent), opening.kwargs)

        session = self._sessions.begin(pending.session_id, opening)
        previous = session.model  # another thread may set the attribute to None
        if previous is not None:
            previous.parameters.end(session)
        session.model = model

        with model.busy, model.uncaptured, model.call("reset") as call:
            model.require_open()
            model.parameters.use(model.parameters.begin(session, follows=opening.follows))
            agent = model.copies.make()
            info = agent.reset(request.obs, request.instruction, **opening.kwargs)
            if not isinstance(info, dict):
                raise PolicyFailed(
                    f"reset: expected a dict from the policy, got {type(info).__name__}"
                )
            observes = ability(agent, Observes) if request.history else None
            if observes is not None:
                for obs in request.history:
                    observes.observe(obs)

        info = {**model.identity, **info}
        spent = timing(pending, call.began, call.ended)
        require_serializable(info, self._reply_bytes)
        session.set_agent(agent)
        session.instruction = request.instruction or ""
        model.padding.record_reset(request, opening.kwargs)
        request.drop_observations()

        reply = Reply(request.request_id, info=info, step=session.steps, timing=spent)
        if session.announced or self._finder is None:
            return [(pending, reply)]
        # The next act may arrive at a replica that still has an older episode.
        self._finder.announce(session, (pending, reply))
        return ()

    def _other(self, pending: PendingRequest) -> Answer:
        """Run a request that is neither an act nor a reset, and return the answer."""
        session_id, request = pending.session_id, pending.request
        info: dict[str, Any] = {}
        if request.op == "export":
            asked = request.kwargs.get("asked", self._clock())
            info = self._moves.export(session_id, asked).info()
        elif request.op == "release":
            info = {"released": self._sessions.release(session_id, request.kwargs["version"])}
        elif request.op == "raise_step":
            info = {"step": self._sessions.raise_step(session_id, **request.kwargs)}
        elif request.op == "adopt":
            # The replica of this process uses the same session id again for sessions that it
            # compares.
            self._sessions.free(session_id)
            # That replica decides which version of the weights is used: the session's own version
            # may be older, or may not exist in this process.
            state = SessionState.from_info(request.kwargs)
            state = replace(state, weights=self._weights.acting())
            self._moves.adopt(session_id, state)
            if pending.origin.owner:
                pending.origin.sessions[session_id] = None
        elif request.op == "call":
            info = {"result": self._call(pending)}
            require_serializable(info, self._reply_bytes)
        elif request.op == "weights":
            self._weights.obey(**request.kwargs)
        else:
            self._sessions.close_for(pending)
        return pending, Reply(request.request_id, info=info)

    def _ready(
        self, pending: PendingRequest
    ) -> tuple[Session[LoadedModel], LoadedModel, WeightsVersion]:
        """Return the session of an act or an observation, with its model and its version of the
        weights; raise an error if it is not the session for which the request was sent.
        """
        reserved = pending.reserved if isinstance(pending.reserved, ReservedAct) else None
        # The session has ended since it was looked up, or has arrived here from another replica.
        if reserved is None or reserved.session.over:
            session = self._sessions.get(pending.session_id)
        else:
            session = reserved.session
        model, weights = session.model, session.weights
        if session.agent is None:
            raise NotReset(f"session {session.id!r}: its last reset failed; reset again")
        if model is None or weights is None:
            raise UnknownSession(f"session {pending.session_id!r}: has just been closed; reset it")
        # The session has arrived since the act was compared with the contract.
        if reserved is None or model is not reserved.model:
            model.check(pending.request)
        self._sessions.use(session, pending)
        if pending.message.reports and pending.index in pending.message.reports:
            # The measured success is that of the loaded checkpoint.
            tolerated_age_ms = None if weights.number else model.tolerated_age_ms
            pending.message.reports[pending.index].executed_by(session, tolerated_age_ms)
        return session, model, weights

    def _call(self, pending: PendingRequest) -> Any:
        """Use an ability of a session's agent, for the replica of this child process."""
        session, model, weights = self._ready(pending)
        if session.agent is None:  # `_ready` ensures that there is an agent
            raise NotReset(f"session {pending.session_id!r}: has no agent; reset it")
        call = AbilityCall(**pending.request.kwargs)
        with model.busy, model.uncaptured, model.call(call.member):
            model.require_open()
            model.parameters.use(weights)
            result = call.execute(session.agent, pending.request.obs)
        pending.request.drop_observations()
        return result

    def _prepared(self, model: LoadedModel, acting: list[Acting]) -> tuple[list[Acting], float]:
        """Finish the preparations of observations, and answer the requests whose preparation
        failed.

        Returns:
            The remaining requests, and the duration, s, which counts as inference.
        """
        preparations = []
        for pending, session in acting:
            reserved = pending.reserved
            preparation = reserved.preparation if isinstance(reserved, ReservedAct) else None
            preparations.append((preparation, session.prepares))
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
        """Compute the acts of sessions that use the same model and version of its weights, and
        return the answers that are due now.
        """
        observations, agents = [], []
        for pending, session in acting:
            observations.append(pending.request.obs)
            agents.append(session.agent)
        padding = 0
        if self._batch_sizes:
            with model.busy, model.uncaptured:
                padding = model.pad(observations, agents)

        rows = len(observations)
        call = model.call("act", rows if self._batch_sizes else None)
        slow = self._queue.window.slow
        # The time is not measured for fast acts: its two calls take a fiftieth of the time of the
        # fastest act.
        worked_s = time.thread_time() if slow else 0.0
        try:
            with model.busy, model.uncaptured, call:
                model.require_open()
                model.parameters.use(weights)
                results: Sequence[Act | Exception] = model.agent.act_batch(observations, agents)  # type: ignore[arg-type]
            if len(results) != rows:
                raise PolicyFailed(
                    f"act_batch: expected {rows} actions, one for each observation, got "
                    f"{len(results)}"
                )
        except Exception as error:  # noqa: BLE001 - becomes the replies
            results = [error] * rows

        worked_s = time.thread_time() - worked_s if slow else 0.0
        # This is skipped for a single act that succeeded like the act before it: the call would
        # take a hundredth of the act's time.
        if len(acting) > 1 or isinstance(results[0], Exception) or model.calls.failed_batches:
            model.calls.record_batch(results[: len(acting)])

        del observations  # the observations may be in the sender's memory
        for pending, _ in acting:
            pending.request.drop_observations()
        if padding:
            model.padding.check_results(results[len(acting) :])
            results = results[: len(acting)]

        # Replies to simulations are sent while the next full batch runs. After a full batch this
        # also applies to robots, if the policy leaves the interpreter to other threads while it
        # waits for a GPU or another process. If it computes in Python, the slowest robots would
        # wait longer.
        defer = self._queue.full_batch_waits()
        robots = len(acting) == self._queue.largest and worked_s < _WORKING * (
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
                if pending.needed or session.plan.need is not None:
                    self._set_pace(pending, session, reply)
            if defer and (robots or pending.priority is not Priority.ROBOT):
                self._unsent.append((pending, reply))
            else:
                answers.append((pending, reply))
        self._stats.batch(len(acting), rows)
        return answers

    def _set_pace(
        self, pending: PendingRequest, session: Session[LoadedModel], reply: Reply
    ) -> None:
        """Update the needs of an act's robot. If the robot has sent its slack, add the time after
        which it should replan to the answer.
        """
        act, plan = reply.act, session.plan
        if act is None:
            return
        plan.observe(len(act.rows()), pending.arrived, pending.needed, self._clock())
        if pending.needed:
            replan_s = self._pace.replan_s(plan)
            if replan_s > 0:
                act.info[REPLAN] = replan_s * 1e3


def _not_taken(pending: PendingRequest, now: float) -> VLAgentsError:
    """Return the error for a request that the policy has not received at `now`, s, and never
    will.
    """
    if pending.origin.ended or not pending.expired(now):
        return ConnectionLost("the request's connection has ended: not acted on, and never will be")
    return DeadlineExceeded(
        f"no action within {pending.request.deadline_ms:g} ms: dropped before inference"
    )
