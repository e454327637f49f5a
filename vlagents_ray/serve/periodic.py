"""Periodic calls, on one thread for the whole process."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

logger = logging.getLogger(__name__)


class Periodic:
    """Calls the added functions every `period_s` seconds. Its thread runs while there is a function
    to call.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._calls: list[Callable[[], None]] = []
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def add(self, call: Callable[[], None]) -> None:
        """Begin to call `call` periodically. Its errors are logged, and do not end the calls."""
        with self._lock:
            self._calls = [*self._calls, call]
            if self._thread is None:
                self._stop = threading.Event()
                self._thread = threading.Thread(
                    target=self._loop, args=(self._stop,), name="periodic", daemon=True
                )
                self._thread.start()

    def remove(self, call: Callable[[], None]) -> None:
        """Stop calling `call`. This does nothing if `call` was not added.

        If `call` was the last function, this method waits for a running call, unless the periodic
        thread itself calls `remove`.
        """
        with self._lock:
            self._calls = [added for added in self._calls if added != call]
            thread = self._thread
            was_last = not self._calls
            if was_last and thread is not None:
                self._stop.set()
                self._thread = None

        if was_last and thread is not None and thread is not threading.current_thread():
            thread.join()

    def _loop(self, stop: threading.Event) -> None:
        while not stop.wait(self._period_s):
            for call in self._calls:
                try:
                    call()
                except Exception:
                    logger.exception("a periodic call failed")


each_half_second = Periodic(0.5)
