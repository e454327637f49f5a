"""The interface of observers, which are the only way to see the requests and the answers of an engine.

An observer is called on the threads that requests and answers take: it copies or passes on references, and leaves the
rest to a thread of its own. It retains nothing unbounded: beyond a limit in bytes or entries it drops.
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from queue import SimpleQueue
from typing import Any, Protocol

from vlagents_ray.images.codecs import DecodedFiles
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.responses import Done, Watchers

logger = logging.getLogger(__name__)

NICE = 5  # the threads of observers run after the policy's


class Pending(Protocol):
    """A request in flight."""

    session_id: str  # as the engine names it
    request: Request  # its observation is there in `on_request` only: the engine drops it once the policy has acted
    files: DecodedFiles | None  # the files of its images, for `on_request` as well
    kept: dict[Any, Any]  # what observers keep for the answer, by observer; gone with a request that is given up


class Observer:
    """Sees requests that could be decoded, and their answers. A class overrides the methods that it needs."""

    def on_request(self, pending: Pending) -> None:
        """See a request before it is queued. Arrays of the observation may lie in memory that the client reuses."""

    def before_answer(self, pending: Pending, reply: Reply) -> None:
        """Add to the info of an answer that is about to be sent, as the live page does to reach a robot."""

    def on_answer(self, pending: Pending, reply: Reply) -> None:
        """See an answer that was sent; its `timing` is completed later."""

    def close(self) -> None:
        """Write or export what is kept, and end."""


class Observers(Observer):
    """The observers of an engine, which are themselves one. Thread-safe.

    Without an observer it is no watcher of the engine, and a message costs one comparison.
    """

    def __init__(self, watchers: Watchers) -> None:
        self._watchers = watchers
        self._all: tuple[Observer, ...] = ()
        self._lock = threading.Lock()

    def add(self, observer: Observer) -> None:
        """Let an observer see the requests from now on."""
        with self._lock:
            if not self._all:
                self._watchers.add(self)
            self._all = (*self._all, observer)

    def remove(self, observer: Observer) -> None:
        """Let it see no further requests; does nothing if it was not added."""
        with self._lock:
            self._all = tuple(one for one in self._all if one is not observer)
            if not self._all:
                self._watchers.remove(self)

    def on_request(self, pending: Pending) -> None:
        """See `Observer`."""
        for observer in self._all:
            observer.on_request(pending)

    def before_answer(self, pending: Pending, reply: Reply) -> None:
        """See `Observer`."""
        for observer in self._all:
            observer.before_answer(pending, reply)

    def on_answer(self, pending: Pending, reply: Reply) -> None:
        """See `Observer`."""
        for observer in self._all:
            observer.on_answer(pending, reply)

    def note(self, sessions: Sequence[str], items: Sequence[Request | Reply], files: DecodedFiles, done: Done) -> Done:
        """Adapt the engine's `Watcher` to observers: return `done`, around which they see the answers."""
        pending = {
            place: _Pending(session, item, files)
            for place, (session, item) in enumerate(zip(sessions, items, strict=True))
            if isinstance(item, Request)
        }
        for one in pending.values():
            self.on_request(one)

        def answer(replies: list[Reply]) -> None:
            for place, one in pending.items():
                self.before_answer(one, replies[place])
            done(replies)
            for place, one in pending.items():
                self.on_answer(one, replies[place])

        return answer


@dataclass(slots=True, eq=False)
class _Pending:
    session_id: str
    request: Request
    files: DecodedFiles | None
    kept: dict[Any, Any] = field(default_factory=dict)


class Worker:
    """A thread of an observer, which makes calls one after the other; the observer bounds those that wait."""

    def __init__(self, name: str) -> None:
        """Start the thread of that name."""
        self._calls: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, call: Callable[[], None]) -> None:
        """Call `call` on the thread; an error is logged, and ends nothing."""
        self._calls.put(call)

    def close(self, timeout_s: float | None = None) -> None:
        """End after the calls that wait, and wait for that; 0 does not wait."""
        self._calls.put(None)
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while self._made(self._calls.get()):
            pass

    def _made(self, call: Callable[[], None] | None) -> bool:
        """Make a call, to which nothing refers afterwards; False at the end."""
        if call is None:
            return False
        try:
            call()
        except Exception:
            logger.exception("%s: a request is left out", self._thread.name)
        return True


def be_nice() -> None:
    """Let this thread run after the policy's."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)
