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
        self._poll = select.epoll()  # itself: what `selectors` makes of its events takes as long as a request's way
        self._ready: dict[int, Callable[[], None]] = {}  # by descriptor
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_read, False)
        os.set_blocking(self._wake_write, False)
        self._watch(self._wake_read, self._woken)
        self._reader: threading.Thread | None = None  # only a policy that is slow enough needs it
        self._lent = threading.Event()
        self._turn = threading.Lock()  # held while the reader runs callbacks
        self._closed = False
        self._calls: deque[Callable[[], None]] = deque()

    def watch(self, file: HasFileno, ready: Callable[[], None]) -> None:
        """Call `ready` whenever `file` can be read. Before the owner's first `hear`, or in a callback."""
        self._watch(file.fileno(), ready)

    def unwatch(self, file: HasFileno) -> None:
        """The end of `watch`, in a callback, before the file is closed."""
        del self._ready[file.fileno()]
        self._poll.unregister(file)

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
        events = self._poll.poll(timeout_s)
        if events:
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
        self._poll.close()
        os.close(self._wake_read)
        os.close(self._wake_write)

    def _read(self) -> None:
        # Polls the epoll from outside: two threads inside one epoll would take each other's wake-ups. What this
        # hears when the ears are no longer lent is the owner's: it only goes back to wait for the next loan.
        outside = select.poll()
        outside.register(self._poll, select.POLLIN)
        while True:
            self._lent.wait()
            if self._closed:
                return
            outside.poll()
            with self._turn:
                if self._lent.is_set() and not self._closed:
                    self._call(self._poll.poll(0), lent=True)

    def _watch(self, descriptor: int, ready: Callable[[], None]) -> None:
        self._poll.register(descriptor, select.EPOLLIN)
        self._ready[descriptor] = ready

    def _call(self, events: list[tuple[int, int]], lent: bool = False) -> None:
        for descriptor, _ in events:
            if lent and not self._lent.is_set():
                return  # the owner is told of the rest again
            ready = self._ready.get(descriptor)
            if ready is None:
                continue  # unwatched by one before it
            try:
                ready()
            except Exception:
                logger.exception("a local client's door failed")
                if self._ready.pop(descriptor, None) is not None:
                    with contextlib.suppress(OSError):  # it may be closed already
                        self._poll.unregister(descriptor)

    def _woken(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.read(self._wake_read, 4096)
        while self._calls:
            try:
                self._calls.popleft()()
            except Exception:
                logger.exception("what was to be called later failed")
