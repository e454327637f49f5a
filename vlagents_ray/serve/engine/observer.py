"""The interface of observers, the only access to the requests and the answers of an engine.

An observer is called on the threads that process requests and answers: it copies data or keeps
references, and does all other work on its own thread. Its memory is bounded: beyond a limit in
bytes or entries it drops data. Requests that could not be decoded reach no observer. Parts of a
replica add observers.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from vlagents_ray.protocol.messages import Reply
from vlagents_ray.serve.requests import PendingRequest

logger = logging.getLogger(__name__)


class Observer:
    """Observes decoded requests and their answers; a class overrides the methods that it needs."""

    def on_request(self, pending: PendingRequest) -> None:
        """Observe a request before it is queued; the observation may be in memory that the client
        reuses.
        """

    def before_answer(self, pending: PendingRequest, reply: Reply) -> None:
        """Add entries to the info of an answer before it is sent; the live page sends commands to a
        robot this way.
        """

    def on_answer(self, pending: PendingRequest, reply: Reply) -> None:
        """Observe an answer that was sent, with its complete `timing`; the request's observation
        has been dropped.
        """

    def close(self) -> None:
        """Write or export the stored data, and end."""


class Observers(Observer):
    """All observers of an engine, which are called like a single observer. Thread-safe."""

    def __init__(self) -> None:
        # Whether there are observers. Without observers, each request costs only this check.
        self.any = False
        self._all: tuple[Observer, ...] = ()
        self._lock = threading.Lock()

    def add(self, observer: Observer) -> None:
        """Add an observer for all requests from now on."""
        with self._lock:
            self._all = (*self._all, observer)
            self.any = True

    def remove(self, observer: Observer) -> None:
        """Remove an observer; does nothing if it was not added."""
        with self._lock:
            self._all = tuple(other for other in self._all if other is not observer)
            self.any = bool(self._all)

    def on_request(self, pending: PendingRequest) -> None:
        """Call all observers with a request; their errors are logged, and do not affect the
        answer.
        """
        self._each(lambda observer: observer.on_request(pending))

    def before_answer(self, pending: PendingRequest, reply: Reply) -> None:
        """Call all observers before an answer is sent; their errors are logged."""
        self._each(lambda observer: observer.before_answer(pending, reply))

    def on_answer(self, pending: PendingRequest, reply: Reply) -> None:
        """Call all observers with an answer; their errors are logged."""
        self._each(lambda observer: observer.on_answer(pending, reply))

    def _each(self, call: Callable[[Observer], None]) -> None:
        for observer in self._all:
            try:
                call(observer)
            except Exception:
                logger.exception(
                    "%s: the observer has failed and left out a request", type(observer).__name__
                )
