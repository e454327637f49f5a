"""The path of requests into the queue: each request is checked, and makes its reservations.

A reset reserves the step of an episode, and room for its session. An act reserves its session, and
the preparation of its observation. A reservation is a value in its request, and is dropped if the
policy never receives the request; no session changes before its request is executed. If the session
of an act or a close is not at this replica, the request reserves again after a search at other
replicas.
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from vlagents_ray.errors import (
    InvalidInput,
    NotReset,
    PolicyUnavailable,
    UnknownSession,
    VLAgentsError,
)
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.messages import (
    BACKGROUND_OPS,
    IMMEDIATE_OPS,
    Priority,
    Reply,
    Request,
)
from vlagents_ray.serve.engine.background_calls import BackgroundCalls
from vlagents_ray.serve.engine.metrics_buffer import MetricsBuffer
from vlagents_ray.serve.engine.parts import EngineParts
from vlagents_ray.serve.engine.responses import public_error
from vlagents_ray.serve.in_time import RobotReport
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.queue.preparation import Preparation, Preparations
from vlagents_ray.serve.queue.replica_pace import stated_slack_s
from vlagents_ray.serve.requests import Opening, PendingRequest, ReservedAct
from vlagents_ray.serve.sessions import Session, SessionState, SessionUse
from vlagents_ray.serve.weights import follows

# Operations whose session may be at another replica.
_SEARCHED = ("act", "close")


@dataclass(slots=True)
class ReceivedReport:
    """The report of a robot in a request that is not answered yet."""

    report: RobotReport
    priority: str
    stats: MetricsBuffer
    clock: Callable[[], float]
    session: Session[Any] | None = None  # the session that has executed the request

    def executed_by(self, session: Session[Any], tolerated_age_ms: float | None) -> None:
        """Record which session has executed the request.

        Args:
            session: The session.
            tolerated_age_ms: The largest age of an action that its policy tolerates, ms; None if
                it is not known.
        """
        self.session = session
        self.report = self.report.compared(tolerated_age_ms)

    def count(self) -> None:
        """Add the report to the metrics, and to the session if it has executed the request."""
        self.stats.report(self.priority, self.report)
        if self.session is not None:
            self.session.add_report(self.report, self.clock())


class Intake:
    """Checks requests, and queues them. Thread-safe."""

    def __init__(self, parts: EngineParts, background: BackgroundCalls) -> None:
        self._background = background
        self._health = parts.health
        self._sessions = parts.sessions
        self._model = parts.model
        self._queue = parts.queue
        self._finder = parts.finder
        self._drain_list = parts.drain_list
        self._stats = parts.stats
        self._clock = parts.clock
        # None if the engine has no threads.
        self._preparations = Preparations() if parts.settings.threaded else None

    def submit(self, requests: Sequence[PendingRequest]) -> None:
        """Check requests, and queue them together; those that cannot be queued are finished with
        their errors. The operations in `BACKGROUND_OPS` are started immediately, and those in
        `IMMEDIATE_OPS` are executed immediately.
        """
        ready: list[PendingRequest] = []
        for pending in requests:
            try:
                if pending.request.op in IMMEDIATE_OPS:
                    info = self._execute(pending)
                    pending.finish(Reply(pending.request.request_id, info=info))
                    continue
                if pending.origin.owner:
                    pending.episode = self._sessions.episode_of(pending.session_id, pending.origin)
                reserved = pending.reserved = self.reserve(pending)
                if reserved is None and pending.request.op in BACKGROUND_OPS:
                    self._background.submit(pending)
                else:
                    ready.append(pending)
            except Exception as error:  # noqa: BLE001 - becomes the reply, and affects no other request
                public = public_error(error, pending)
                if not self.search(pending, public):
                    self.fail(pending, public)

        try:
            if ready:
                self._queue.put(*ready)
        except VLAgentsError as error:
            for pending in ready:
                self.fail(pending, error)

    def _execute(self, pending: PendingRequest) -> dict[str, Any]:
        """Execute one of `IMMEDIATE_OPS`, and return the info of the reply."""
        request = pending.request
        if request.op == "gpu_memory":
            return {"bytes": self._model.gpu_memory()}
        if request.op == "gpu_work":
            return asdict(self._stats.collect_gpu_work())
        self._store(pending.session_id, request)
        return {}

    def _store(self, session_id: str, request: Request) -> None:
        """Store an observation until an act refers to it, and begin to prepare it. Without an
        observation, drop the stored observation, which no act will use.
        """
        number = request.kwargs["number"]
        if request.obs is None:
            # The observations were dropped with the session.
            with contextlib.suppress(UnknownSession):
                _, preparation = self._sessions.get(session_id).stored.pop(number, (None, None))
                if preparation is not None:
                    preparation.future.cancel()
            return

        self._health.require_ready()
        session = self._sessions.get(session_id)
        obs = copy.deepcopy(request.obs)  # the original may be in the sender's memory
        session.stored[number] = (obs, self._prepare(session, obs))

    def _prepare(self, session: Session[LoadedModel], obs: Obs | None) -> Preparation | None:
        """Begin to prepare an observation of a session; return None if there is nothing to do."""
        if self._preparations is None:
            return None
        model = session.model  # another thread may set the attribute to None
        acts = None if model is None else model.acts
        return self._preparations.begin(session.prepares, obs, acts)

    def reserve(self, pending: PendingRequest) -> ReservedAct | Opening | None:
        """Check a request before it is queued, and return its reservation; raise an error if it is
        rejected.
        """
        request, origin, session_id = pending.request, pending.origin, pending.session_id
        is_act = request.op == "act"
        is_unnamed = bool(origin.owner) and not request.session
        if is_act and is_unnamed and pending.episode is None and session_id not in origin.sessions:
            raise NotReset("act before reset: this connection has no session yet; reset first")
        self._health.require_ready()

        if is_act:
            session = self._sessions.get(session_id)
            # Only acts for a policy in a child process refer to a stored observation.
            is_stored = bool(request.prepared)
            preparation = _take_stored(session, pending) if is_stored else None
            request = pending.request
            step = request.step
            if step is not None and step > session.steps:  # another replica may have this state
                raise session.wrong_step(step)

            model = session.model  # another thread may set the attribute to None
            if model is not None:
                model.check(request)
            if request.obs is not None and request.obs.info:
                self._record_report(pending, request.obs.info)
            pending.waits_behind_others = session.plan.waits_behind_others
            if preparation is None and self._queue.window.overlaps:
                preparation = self._prepare(session, request.obs)
            return ReservedAct(session, model, preparation)

        if request.op == "reset":
            return self._open(pending)
        if request.op == "close" and session_id not in self._sessions:
            raise self._sessions.unknown(session_id)
        return None

    def _record_report(self, pending: PendingRequest, info: Mapping[str, Any]) -> None:
        """Read the slack of an act's robot, and its report, which is counted with the answer."""
        slack_s = stated_slack_s(info)
        # A simulation gets what robots leave, whether or not it executes chunks in real time.
        if slack_s is not None and pending.priority is Priority.ROBOT:
            pending.needed = min(pending.arrived + slack_s, pending.deadline)
        report = RobotReport.of(info)
        if report is not None:
            pending.message.reports[pending.index] = ReceivedReport(
                report, pending.priority.name.lower(), self._stats, self._clock
            )

    def _open(self, pending: PendingRequest) -> Opening:
        """Check a reset, and reserve an episode of its session."""
        kwargs = dict(pending.request.kwargs)
        follows_newest = follows(kwargs, by_default=pending.priority is not Priority.ROBOT)
        self._model.require_loaded().check(pending.request)
        return self._sessions.reserve(pending, kwargs, follows_newest)

    def withdraw(self, *requests: PendingRequest) -> None:
        """End requests without an answer, as `BatchQueue.withdraw` does, and undo resets that
        have not begun.
        """
        self._queue.withdraw(*requests)
        for pending in requests:
            pending.drop_preparation()
            if not pending.begun:
                self._undo(pending)

    def _undo(self, pending: PendingRequest) -> None:
        """Undo the reservation of a reset, unless the reset has been executed."""
        if isinstance(pending.reserved, Opening):
            self._sessions.undo(pending.session_id, pending.reserved)

    def fail(self, pending: PendingRequest, error: VLAgentsError) -> None:
        """Finish a request with an error, and undo the reservation of a reset. A close succeeds if
        no replica has its session.
        """
        self._undo(pending)
        if pending.request.op == "close" and isinstance(error, UnknownSession):
            pending.origin.sessions.pop(pending.session_id, None)
            error.__traceback__ = None  # its frames would keep the message in memory
            pending.finish(Reply(pending.request.request_id, info={}))
        else:
            pending.fail(error)

    def search(self, pending: PendingRequest, error: VLAgentsError) -> bool:
        """Search for the session of an act or a close at other replicas, and queue the request
        again; return False if there is no search.

        If the search does not find the session, the request fails with `error`.
        """
        if (
            self._finder is None
            or pending.sought
            or pending.request.op not in _SEARCHED
            or pending.is_abandoned
            or not isinstance(error, UnknownSession)
        ):
            return False

        pending.sought = True
        origin = pending.origin
        searcher = origin.owner if origin.caller is None else origin.caller.name
        search = SessionSearch(self, pending, error)
        if self._finder.fetch(pending.session_id, search.end, searcher, search.use_of):
            return True
        if self._drain_list.draining:  # the replica has given its sessions to other replicas
            pending.fail(
                PolicyUnavailable(
                    "the replica is stopping; connect again, or send the same request again"
                )
            )
            return True
        return False

    def retry(self, pending: PendingRequest) -> None:
        """Queue an act or a close again after a search for its session; raise an error if it is
        rejected.
        """
        # The session stays at the other replica if its key may hold no further session here.
        if pending.request.op == "act" and pending.session_id not in self._sessions:
            self._sessions.require_allowed(pending.origin)
        pending.reserved = self.reserve(pending)
        self._queue.put(pending)

    def close(self) -> None:
        """End the threads that prepare observations."""
        if self._preparations is not None:
            self._preparations.close()


class SessionSearch:
    """A search of other replicas for the session of an act or a close."""

    def __init__(self, intake: Intake, pending: PendingRequest, error: VLAgentsError) -> None:
        self._intake = intake
        self._pending = pending
        self._error = error  # error of the request if its session is not found

    def end(self) -> None:
        """Queue the request again, or finish it with its error, once the search has ended."""
        pending = self._pending
        if pending.is_abandoned:
            pending.fail(self._error)
            return
        try:
            self._intake.retry(pending)
        except Exception as error:  # noqa: BLE001 - becomes the reply
            is_same = type(error) is type(self._error)
            self._intake.fail(pending, self._error if is_same else public_error(error, pending))

    def use_of(self, state: SessionState, began: float) -> SessionUse | None:
        """Return the use of a session in the given state at another replica, if the request can be
        executed on it. If not, return None, and the session stays there. `began` is the time at
        which the session's episode began, s.
        """
        pending = self._pending
        if pending.is_abandoned or not pending.belongs_to(state.first, state.steps, began):
            return None
        return SessionUse(pending.origin, ends=pending.request.op == "close")


def _take_stored(session: Session[LoadedModel], pending: PendingRequest) -> Preparation | None:
    """Add the stored observation to the act that refers to it, and return the observation's
    preparation; raise `InvalidInput` if there is no such observation.
    """
    number = pending.request.prepared
    stored = session.stored.pop(number, None)
    if stored is None:
        raise InvalidInput(
            f"act: expected the number of a stored observation, got {number}; send the observation"
        )
    obs, preparation = stored
    pending.request = replace(pending.request, obs=obs)
    return preparation
