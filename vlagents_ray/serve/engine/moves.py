"""Moves of sessions between replicas. The state of a session consists of bytes and settings."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

from vlagents_ray.errors import UnknownSession
from vlagents_ray.serve.engine.parts import EngineParts
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.queue.replica_pace import RobotPlan
from vlagents_ray.serve.requests import NOWHERE, Origin
from vlagents_ray.serve.sessions import Session, SessionState


class SessionMoves:
    """Exports the sessions of an engine, and continues sessions of other replicas. Thread-safe."""

    def __init__(self, parts: EngineParts) -> None:
        self._sessions = parts.sessions
        self._model = parts.model
        self._health = parts.health
        self._clock = parts.clock

    def export(self, session_id: str, asked: float) -> SessionState:
        """Return the state that another replica needs to continue the session after its release
        here; called on the policy's thread.

        `asked` is the time at which the state was requested, s, of the engine's clock.
        """
        session = self._sessions.get(session_id)
        model, weights = session.model, session.weights
        if session.agent is None or model is None or weights is None:
            raise UnknownSession(f"session {session_id!r}: not reset yet")
        with model.busy, model.uncaptured, model.call("export"):
            agent = model.copies.dump(session.agent)
        return SessionState(
            agent=agent,
            steps=session.steps,
            first=session.first,
            moves=session.moves,
            age_s=asked - session.began,
            policy=list(model.version),
            weights=[weights.number, weights.fingerprint],
            follows=session.follows,
            instruction=session.instruction,
            robot=session.plan.to_list(),
        )

    def adopt(self, session_id: str, state: SessionState) -> None:
        """Continue a session that another replica has released.

        Args:
            session_id: Id of the session.
            state: Its state at the other replica.

        Raises:
            UnknownSession: The session has, or had, a newer state here, has begun a reset, or
                belongs to another version of the policy.
        """
        self.enter(self.prepare(session_id, state))

    def prepare(
        self,
        session_id: str,
        state: SessionState,
        began: float = 0.0,
        origin: Origin = NOWHERE,
        weights: Mapping[str, Any] | None = None,
    ) -> Session[LoadedModel]:
        """Create a copy of the session that cannot act before `enter`; if it is not needed, call
        `abandon`.

        `began` is the earliest time at which its episode may have begun, s, of this engine's clock.
        From now on, the session counts for the key of `origin`, the origin of the request that
        needs it. `weights` are the values of its version of the weights, if this replica does not
        hold that version.
        """
        self._health.require_ready()
        self._sessions.require_room([session_id])

        first, moves = state.first, state.moves + 1
        arriving: Session[LoadedModel] = Session(
            session_id,
            steps=state.steps,
            first=first,
            began=began,
            moves=moves,
            announced=True,
            plan=RobotPlan.from_list(state.robot, began, began + state.age_s),
        )
        self._sessions.expect(arriving, origin)
        try:
            model = arriving.model = self._model.require_loaded()
            if tuple(state.policy) != model.version:
                raise UnknownSession(
                    f"session {session_id!r}: belongs to another version of the policy; reset it"
                )

            number, fingerprint = state.weights
            # The session holds the version until `find` returns that version or a newer one.
            if weights is not None:
                arriving.weights = model.parameters.restore(number, fingerprint, weights)
            arriving.weights = model.parameters.find(number, fingerprint, follows=state.follows)
            with model.busy, model.uncaptured, model.call("adopt", threading.get_ident()):
                model.require_open()
                arriving.set_agent(model.copies.load(state.agent))
            arriving.follows, arriving.instruction = state.follows, state.instruction
        except BaseException:
            self.abandon(arriving)
            raise
        return arriving

    def enter(self, arriving: Session[LoadedModel]) -> None:
        """Add a prepared session to the table, so that it acts here from now on."""
        model = arriving.model
        try:
            self._sessions.enter(arriving)
        except BaseException:
            self.abandon(arriving)
            raise
        if model is not None and model.closed:  # the model was closed since `prepare`
            self._sessions.close(arriving.id)
            raise model.replaced()
        if model is not None:
            model.parameters.catch_up(arriving)

    def abandon(self, arriving: Session[LoadedModel]) -> None:
        """Drop a prepared session that is not needed."""
        self._sessions.abandon(arriving)
