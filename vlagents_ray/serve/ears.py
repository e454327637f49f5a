"""What the policy's thread hears while it waits, and who hears it while the policy runs.

The thread waits on file descriptors, so that a local client's socket can be one of them: a request
then reaches the policy without a change of threads. While a batch runs that takes milliseconds, the
ears are lent to a reader thread, which decodes the next batch meanwhile. Callbacks run on either
thread, never on both at once.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import selectors
import threading
from collections import deque
from collections.abc import Callable
from typing import Protocol

logger = logging.getLogger(__name__)


class HasFileno(Protocol):
    """A socket, a pipe: whatever a selector can wait for."""

    def fileno(self) -> int:
        """Its descriptor."""
        ...


class Ears:
    """Watched files and a wake-up call. One thread owns them, and lends them out now and then."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_read, False)
        os.set_blocking(self._wake_write, False)
        self._selector.register(self._wake_read, selectors.EVENT_READ)
        self._reader: threading.Thread | None = None  # only a policy that is slow enough needs it
        self._lent = threading.Event()
        self._turn = threading.Lock()  # held while the reader runs callbacks
        self._closed = False
        self._calls: deque[Callable[[], None]] = deque()

    def watch(self, file: HasFileno, ready: Callable[[], None]) -> None:
        """Call `ready` whenever `file` can be read. Before the owner's first `hear`, or in a callback."""
        self._selector.register(file, selectors.EVENT_READ, ready)

    def unwatch(self, file: HasFileno) -> None:
        """The end of `watch`, in a callback."""
        self._selector.unregister(file)

    def later(self, call: Callable[[], None]) -> None:
        """Have `call` called as a callback is; after `close`, not any more. Any thread."""
        if not self._closed:
            self._calls.append(call)
            self.wake()

    def wake(self) -> None:
        """End the `hear` that is under way, or the next one. Any thread."""
        with contextlib.suppress(BlockingIOError):  # enough calls are on their way
            os.write(self._wake_write, b"x")

    def hear(self, timeout_s: float) -> bool:
        """Wait for a watched file or a wake-up call, run the callbacks of all that is there. False: nothing came."""
        events = self._selector.select(timeout_s)
        self._call(events)
        return bool(events)

    def lend(self) -> None:
        """Until `take_back`, another thread hears; the owner may not."""
        if self._reader is None:
            self._reader = threading.Thread(target=self._read, name="policy-reader", daemon=True)
            self._reader.start()
        self._lent.set()

    def take_back(self) -> None:
        """The end of `lend`; returns after the callback that is under way."""
        if self._lent.is_set():
            self._lent.clear()
            with self._turn:
                pass

    def close(self) -> None:
        """Give everything back; by the owner, when it has ended or has nothing lent."""
        self._closed = True
        if self._reader is not None:
            self.wake()
            self._lent.set()
            self._reader.join()
        self._selector.close()
        os.close(self._wake_read)
        os.close(self._wake_write)

    def _read(self) -> None:
        # Polls the selector from outside: two threads inside one epoll would take each other's wake-ups. What this
        # hears when the ears are no longer lent is the owner's: it only goes back to wait for the next loan.
        outside = select.poll()
        outside.register(self._selector.fileno(), select.POLLIN)
        while True:
            self._lent.wait()
            if self._closed:
                return
            outside.poll()
            with self._turn:
                if self._lent.is_set() and not self._closed:
                    self._call(self._selector.select(0), lent=True)

    def _call(self, events: list[tuple[selectors.SelectorKey, int]], lent: bool = False) -> None:
        for key, _ in events:
            if lent and not self._lent.is_set():
                return  # the owner is told of the rest again
            if key.data is None:
                with contextlib.suppress(BlockingIOError):
                    os.read(self._wake_read, 4096)
                self._call_back()
                continue
            try:
                key.data()
            except Exception:
                logger.exception("a local client's door failed")
                with contextlib.suppress(KeyError, ValueError):  # it may have been unwatched, or closed, already
                    self._selector.unregister(key.fileobj)

    def _call_back(self) -> None:
        while self._calls:
            try:
                self._calls.popleft()()
            except Exception:
                logger.exception("what was to be called later failed")
