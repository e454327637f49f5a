"""The threads of observers."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable
from contextlib import suppress
from queue import SimpleQueue

logger = logging.getLogger(__name__)

NICE = 5  # the threads of observers run after the policy's


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
