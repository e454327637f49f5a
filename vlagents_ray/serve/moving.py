"""Sessions on the move: a replica stops, or the load balancer sends a session's request elsewhere.

The replica that gets a request for a session it does not know asks the others, and goes on with the
session exactly where it was: instruction, history, random generator and all. A replica that stops
hands over what nobody fetched.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

from vlagents_ray.errors import VLAgentsError
from vlagents_ray.serve.engine import Engine
from vlagents_ray.wire.messages import Reply, Request

logger = logging.getLogger(__name__)

_THREADS = 16  # each for one search, and for as long as a checkpoint takes to load
_PENDING = 256  # searches under way; whoever asks beyond that is told at once that the session is unknown
_EXPORT_S = 10.0
_ON_ITS_WAY_S = 0.1
_LOAD_S = 60.0  # that the checkpoint of a session which was fetched may take


class Others(Protocol):
    """The other replicas of the application."""

    def take(self, session_id: str) -> dict[str, Any] | None:
        """The state of a session that one of them had, and has no more; None if none of them had it."""
        ...

    def give(self, session_id: str, state: dict[str, Any]) -> bool:
        """Hand a session over to one of them; False if none took it."""
        ...


class Strays:
    """Finds sessions that are at another replica, and takes them over."""

    def __init__(self, engine: Engine, others: Others) -> None:
        self._engine = engine
        self._others = others
        self._threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="strays")
        self._pending = 0
        self._lock = threading.Lock()

    def fetch(self, session_id: str, then: Callable[[], None]) -> bool:
        """Call `then` once the session is here or was not found; False, and nothing, if too many are wanted."""
        with self._lock:
            if self._pending >= _PENDING:
                return False
            self._pending += 1
        self._threads.submit(self._fetch, session_id, then)
        return True

    def hand_over(self) -> int:
        """Give all sessions to other replicas, since this one stops; returns how many they took."""
        taken = 0
        for session_id in self._engine.sessions.ids():
            state = export(self._engine, session_id)
            try:
                taken += state is not None and self._others.give(session_id, state)
            except Exception:
                logger.exception("session %s: could not be handed over", session_id)
        return taken

    def close(self) -> None:
        """Let the searches under way end, and start no more."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    def _fetch(self, session_id: str, then: Callable[[], None]) -> None:
        try:
            state = self._others.take(session_id)
            if state is None:  # or it is on its way from one to another
                time.sleep(_ON_ITS_WAY_S)
                state = self._others.take(session_id)
            if state is not None:
                self._engine.adopt(session_id, state, _LOAD_S)
                logger.info("session %s: fetched from another replica, after %d acts", session_id, state["steps"])
        except VLAgentsError as error:
            logger.warning("session %s: %s", session_id, error)
        except Exception:
            logger.exception("session %s: could not be fetched", session_id)
        finally:
            with self._lock:
                self._pending -= 1
            then()


def export(engine: Engine, session_id: str) -> dict[str, Any] | None:
    """Take a session out of this replica, after the acts that wait for it; None if there is none to take.

    A session whose state cannot be pickled stays, and its client has to begin again elsewhere.
    """
    answered = threading.Event()
    answer: list[Reply] = []

    def done(reply: Reply) -> None:
        answer.append(reply)
        answered.set()

    try:
        engine.submit(session_id, Request("export"), done)
    except VLAgentsError:
        return None
    if not answered.wait(_EXPORT_S) or answer[0].error is not None:
        if answer:
            logger.info("session %s: not given up: %s", session_id, answer[0].error)
        return None
    return answer[0].info
