"""The poller of the policy's thread: the files that it watches, and the thread that polls while the
policy runs.

The policy's thread waits on file descriptors, so that a local client's socket can be one of them. A
request then reaches the policy without a thread switch. While a batch that takes milliseconds is
running, a reader thread polls instead, and decodes the next batch. Callbacks run on either of these
threads, but never on both at the same time.
"""

from __future__ import annotations

import contextlib
import heapq
import itertools
import logging
import math
import os
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable

logger = logging.getLogger(__name__)


class Poller:
    """Watches files and a wake-up pipe. One thread owns the poller, and sometimes lends it to a
    reader thread.
    """

    def __init__(self) -> None:
        # `selectors` is not used, since its event objects cost as much as the transport of a
        # request.
        self._poll = select.epoll()
        self._ready: dict[int, Callable[[], None]] = {}  # callbacks by descriptor
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_read, False)
        os.set_blocking(self._wake_write, False)
        self._watch(self._wake_read, self._run_scheduled)
        self._reader: threading.Thread | None = None  # started for slow policies only
        self._lent = threading.Event()  # set while the reader thread may poll
        self._callback_lock = threading.Lock()  # held while the reader runs callbacks
        self._closed = False
        self._waking = threading.Lock()
        self._released = False  # whether the descriptors are closed
        self._scheduled: deque[Callable[[], None]] = deque()
        # A heap of times (s), numbers and callbacks.
        self._timers: list[tuple[float, int, Callable[[], None]]] = []
        # Makes entries differ, so that the heap compares no callbacks.
        self._timer_numbers = itertools.count()

    def watch(self, file: socket.socket, ready: Callable[[], None]) -> None:
        """Call `ready` whenever `file` can be read. Called before the owner's first `poll`, or
        in a callback.
        """
        self._watch(file.fileno(), ready)

    def unwatch(self, file: socket.socket) -> None:
        """Stop watching `file`. Called in a callback, before the file is closed."""
        del self._ready[file.fileno()]
        self._poll.unregister(file)

    def call_soon(self, call: Callable[[], None]) -> None:
        """Schedule `call` to run as a callback; ignored after `close`. May be called on any
        thread.
        """
        if not self._closed:
            self._scheduled.append(call)
            self.wake()

    def call_later(self, seconds: float, call: Callable[[], None]) -> None:
        """Schedule `call` to run as a callback after `seconds`. Called in a callback.

        No thread is started for the wait, since in a flood many connections wait at the same time.
        """
        heapq.heappush(self._timers, (time.monotonic() + seconds, next(self._timer_numbers), call))

    def wake(self) -> None:
        """End the current `poll`, or the next one. May be called on any thread."""
        # If the pipe is full, a wake-up is already pending.
        with self._waking, contextlib.suppress(BlockingIOError):
            if not self._released:
                os.write(self._wake_write, b"x")

    def poll(self, timeout_s: float) -> bool:
        """Wait at most `timeout_s` for watched files, timers or a wake-up call, and run the
        callbacks that are due.

        Returns:
            False if there was no event.
        """
        events = self._poll.poll(min(timeout_s, self._timer_s()) if self._timers else timeout_s)
        if events:
            self._call(events)
        return (bool(self._timers) and self._run_timers()) or bool(events)

    def hand_to_reader(self) -> None:
        """Let the reader thread poll until `reclaim`; until then the owner must not poll."""
        if self._reader is None:
            self._reader = threading.Thread(target=self._read, name="policy-reader", daemon=True)
            self._reader.start()
        self._lent.set()
        if self._timers:
            self.wake()  # the reader may have begun to wait before the timers were set

    def reclaim(self) -> None:
        """Take the poller back from the reader thread, after the callback that it is running."""
        if self._lent.is_set():
            self._lent.clear()
            with self._callback_lock:
                pass

    def close(self) -> None:
        """End the reader thread and close all descriptors. Called when the owner has ended, or
        by the owner itself.
        """
        self._closed = True
        if self._reader is not None:
            self.wake()
            self._lent.set()
            self._reader.join()
        self._poll.close()
        with self._waking:  # the descriptor of the pipe may soon belong to another file
            self._released = True
            os.close(self._wake_read)
            os.close(self._wake_write)

    def _read(self) -> None:
        # The reader polls the epoll's own descriptor: two threads inside one epoll would take each
        # other's wake-ups. Events that occur after the owner's `reclaim` are left to the owner: the
        # reader waits until the poller is lent to it again.
        outside = select.poll()
        outside.register(self._poll, select.POLLIN)
        while True:
            self._lent.wait()
            if self._closed:
                return
            wait_s = self._timer_s()
            outside.poll(None if wait_s == math.inf else math.ceil(wait_s * 1e3))
            with self._callback_lock:
                if self._lent.is_set() and not self._closed:
                    self._call(self._poll.poll(0), lent=True)
                    self._run_timers()

    def _watch(self, descriptor: int, ready: Callable[[], None]) -> None:
        self._poll.register(descriptor, select.EPOLLIN)
        self._ready[descriptor] = ready

    def _call(self, events: list[tuple[int, int]], lent: bool = False) -> None:
        for descriptor, _ in events:
            if lent and not self._lent.is_set():
                # The epoll is level-triggered: the owner's next poll reports the remaining events.
                return
            ready = self._ready.get(descriptor)
            if ready is None:
                continue  # an earlier callback in this loop has stopped watching the file
            try:
                ready()
            except Exception:
                logger.exception("the callback of a watched file failed")
                if self._ready.pop(descriptor, None) is not None:
                    with contextlib.suppress(OSError):  # the file may already be closed
                        self._poll.unregister(descriptor)

    def _run_scheduled(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.read(self._wake_read, 4096)
        while self._scheduled:
            _run(self._scheduled.popleft())

    def _timer_s(self) -> float:
        """Return the time until the next timer, s."""
        first = self._timers[:1]  # a copy, since the owner may take the poller back from the reader
        return max(0.0, first[0][0] - time.monotonic()) if first else math.inf

    def _run_timers(self) -> bool:
        """Run the timers that are due; return whether there were any."""
        if self._timer_s() > 0:
            return False
        now = time.monotonic()
        while self._timers and self._timers[0][0] <= now:
            _run(heapq.heappop(self._timers)[2])
        return True


def _run(call: Callable[[], None]) -> None:
    try:
        call()
    except Exception:
        logger.exception("a scheduled callback failed")
