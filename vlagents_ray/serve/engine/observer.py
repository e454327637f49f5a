"""The interface of observers, the only access to the requests and the answers of an engine.

An observer is called on the threads that requests and answers take: it copies or passes on references, and leaves the
rest to its own thread. What it retains is bounded: beyond a limit in bytes or entries it drops data. Requests that
could not be decoded reach no observer. `vlagents_ray.serve.observers` has the observers.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from vlagents_ray.protocol.messages import Reply
from vlagents_ray.serve.requests import PendingRequest

logger = logging.getLogger(__name__)


class Observer:
    """Sees requests that could be decoded, and their answers. A class overrides the methods that it needs."""

    def on_request(self, pending: PendingRequest) -> None:
        """See a request before it is queued. Arrays of the observation may lie in memory that the client reuses."""

    def before_answer(self, pending: PendingRequest, reply: Reply) -> None:
        """Add to the info of an answer that is about to be sent, as the live page does to reach a robot."""

    def on_answer(self, pending: PendingRequest, reply: Reply) -> None:
        """See an answer that was sent, with its complete `timing`. The request has lost its observation."""

    def close(self) -> None:
        """Write or export what is kept, and end."""


class Observers(Observer):
    """The observers of an engine, which are themselves one. Thread-safe."""

    def __init__(self) -> None:
        self.any = False  # whether there are any: without, a request costs one look at this
        self._all: tuple[Observer, ...] = ()
        self._lock = threading.Lock()

    def add(self, observer: Observer) -> None:
        """Add an observer of the requests from now on."""
        with self._lock:
            self._all = (*self._all, observer)
            self.any = True

    def remove(self, observer: Observer) -> None:
        """Remove an observer; does nothing if it was not added."""
        with self._lock:
            self._all = tuple(one for one in self._all if one is not observer)
            self.any = bool(self._all)

    def on_request(self, pending: PendingRequest) -> None:
        """Call all observers with a request; their errors are logged, and affect no answer."""
        for observer in self._all:
            with _logged(observer):
                observer.on_request(pending)

    def before_answer(self, pending: PendingRequest, reply: Reply) -> None:
        """Call all observers before an answer is sent; their errors are logged."""
        for observer in self._all:
            with _logged(observer):
                observer.before_answer(pending, reply)

    def on_answer(self, pending: PendingRequest, reply: Reply) -> None:
        """Call all observers with an answer; their errors are logged."""
        for observer in self._all:
            with _logged(observer):
                observer.on_answer(pending, reply)


@contextmanager
def _logged(observer: Observer) -> Iterator[None]:
    try:
        yield
    except Exception:
        logger.exception("%s: a request is left out", type(observer).__name__)
