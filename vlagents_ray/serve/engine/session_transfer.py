"""Sessions that move between replicas: export, release and adoption of their state, which is bytes and settings."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from vlagents_ray.errors import UnknownSession
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.models.model_manager import ModelManager
from vlagents_ray.serve.requests import CheckpointChoice
from vlagents_ray.serve.sessions import Session, SessionTable


class SessionTransfer:
    """Exports, releases and adopts the sessions of one engine."""

    def __init__(
        self, sessions: SessionTable[LoadedModel], models: ModelManager, require_ready: Callable[[], None]
    ) -> None:
        """Transfer the `sessions` of one engine; `require_ready` raises an error while the policy cannot act."""
        self._sessions, self._models, self._require_ready = sessions, models, require_ready

    def adopt(self, session_id: str, state: dict[str, Any], timeout_s: float = 0.0) -> None:
        """Continue a session that another replica has released.

        Args:
            session_id: Id of the session.
            state: The `info` of the other replica's reply to "export".
            timeout_s: Maximum time for loading the session's checkpoint, s; 0 if it must be loaded already.

        Raises:
            UnknownSession: The session has, or had, a newer state here, has begun a reset, or needs a checkpoint or a
                version of the policy that is not available here.
        """
        self.enter(self.prepare(session_id, state, timeout_s))

    def prepare(self, session_id: str, state: dict[str, Any], timeout_s: float = 0.0) -> Session[LoadedModel]:
        """Create a copy of the session that cannot act before `enter`; if it is not needed, release its model."""
        self._require_ready()
        self._sessions.require_room(session_id)
        arriving: Session[LoadedModel] = Session(
            session_id, steps=state["steps"], first=state["first"], expected=state["first"]
        )
        arriving.moves, arriving.announced = state["moves"] + 1, True
        try:
            model = self._models.adopt(arriving, CheckpointChoice(*state["choice"]), state["settings"], timeout_s)
            if tuple(state["version"]) != model.version:
                raise UnknownSession(f"session {session_id!r}: of another version of the policy; reset it")
            with model.call("adopt", threading.get_ident()):
                arriving.agent = model.copies.load(state["agent"])
            arriving.weights = model.parameters.find(*state["parameters"])
            arriving.follows, arriving.instruction = state["follows"], state["instruction"]
        except BaseException:
            self._models.release(arriving)
            raise
        return arriving

    def enter(self, arriving: Session[LoadedModel]) -> None:
        """Add a prepared session to the table, so that it acts here from now on."""
        try:
            self._sessions.enter(arriving)
        except BaseException:
            self._models.release(arriving)
            raise

    def export(self, session_id: str) -> dict[str, Any]:
        """Return the state that another replica needs to continue the session after its release here."""
        session = self._sessions.get(session_id)
        model, weights = session.model, session.weights
        if session.agent is None or model is None or weights is None:
            raise UnknownSession(f"session {session_id!r}: not reset yet")
        with model.call("export"):
            agent = model.copies.dump(session.agent)
        return {
            "agent": agent,
            "steps": session.steps,
            "first": session.first,
            "moves": session.moves,
            "version": list(model.version),
            "choice": [model.choice.name, model.choice.step],
            "settings": model.settings,
            "parameters": [weights.number, weights.fingerprint],
            "follows": session.follows,
            "instruction": session.instruction,
        }
