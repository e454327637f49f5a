"""Resets of sessions, whose checkpoints may have to be loaded first.

A reset whose checkpoint is not loaded leaves the queue. It is queued again when the checkpoint is loaded, and answered
with an error if that fails. Meanwhile the session may be reset again or closed, or its client may stop waiting.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from vlagents_ray.errors import PolicyFailed, UnknownSession, VLAgentsError
from vlagents_ray.protocol.messages import Reply
from vlagents_ray.serve.engine.responses import require_serializable, timing
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.models.model_manager import ModelManager, too_late
from vlagents_ray.serve.queue.batch_queue import BatchQueue
from vlagents_ray.serve.requests import Opening, PendingRequest
from vlagents_ray.serve.sessions import Session, SessionFinder, SessionTable


class Resets:
    """Runs the resets of one engine, on the policy's thread."""

    def __init__(
        self,
        sessions: SessionTable[LoadedModel],
        models: ModelManager,
        queue: BatchQueue,
        finder: SessionFinder | None,
        clock: Callable[[], float],
        reply_bytes: int,
    ) -> None:
        """Create the resets of one engine.

        Args:
            sessions: The engine's sessions.
            models: The engine's models.
            queue: The queue for a reset whose checkpoint was loaded.
            finder: Announces sessions that begin here to the other replicas, if there are any.
            clock: Time, s.
            reply_bytes: Largest size of a reply's info, bytes.
        """
        self._sessions = sessions
        self._models = models
        self._queue = queue
        self._finder = finder
        self._clock = clock
        self._reply_bytes = reply_bytes

    def run(self, pending: PendingRequest, opening: Opening) -> None:
        """Begin the episode that a reset asks for and finish it, or queue it again after its checkpoint was loaded."""
        session_id = pending.session_id
        if pending.loaded is None:
            if self._sessions.is_past(session_id, opening.first):
                raise UnknownSession(f"session {session_id!r}: reset elsewhere, or ended, while this reset waited")
            session = self._sessions.open(session_id, pending.origin)
            session.agent, session.weights, session.follows = None, None, opening.follows
            session.steps, session.resetting = opening.first, pending
            session.first, session.moves = opening.first, 0
            session.expected = max(session.expected, opening.first)
            is_abandoned = partial(self._is_abandoned, pending, session)
            pending.begun = False  # while its checkpoint is loaded, the policy is not at work on it
            if self._models.hold(session, opening.choice, partial(self._requeue, pending), is_abandoned) is None:
                return  # `_requeue` queues it again
            pending.begun = True
        else:
            session = self._sessions.get(session_id)
            if session.resetting is not pending:
                raise UnknownSession(f"session {session_id!r}: reset anew, or closed, while this reset waited")
            if self._is_abandoned(pending, session):
                self._models.release_model(session)
                raise too_late(opening.choice)
        session.resetting = None
        try:
            self._begin(pending, opening, session)
        except BaseException:
            self._models.release_model(session)  # else the session might hold the model for long without an episode
            raise

    def _begin(self, pending: PendingRequest, opening: Opening, session: Session[LoadedModel]) -> None:
        """Begin an episode on the model that the session holds, and answer the request."""
        request, model = pending.request, session.model
        if model is None or request.obs is None:  # the decoder ensures the second
            raise UnknownSession(f"session {pending.session_id!r}: closed before its reset was over")
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
        info = {**model.identity, **info}  # a session with an adapter states both by itself
        spent = timing(pending.arrived, call.began, call.ended)
        require_serializable(info, self._reply_bytes)
        session.agent, session.instruction = agent, request.instruction or ""
        model.padding.record_reset(request, opening.kwargs)
        request.drop_observations()
        if not session.announced and self._finder is not None:
            session.announced = True
            self._finder.announce(session.id, session.steps)
        pending.finish(Reply(request.request_id, info=info, step=session.steps, timing=spent))

    def _requeue(self, pending: PendingRequest, error: VLAgentsError | None) -> None:
        """Queue a reset again whose checkpoint was loaded, or answer it with the error."""
        pending.loaded = self._clock()
        try:
            if error is not None:
                raise error
            self._queue.put(pending)
        except VLAgentsError as reason:
            pending.request.drop_observations()  # the session may still refer to the request
            pending.fail(reason)

    def _is_abandoned(self, pending: PendingRequest, session: Session[LoadedModel]) -> bool:
        """Return whether the caller no longer waits for that reset, or the session was reset again."""
        return pending.over or pending.expired(self._clock()) or session.resetting is not pending
