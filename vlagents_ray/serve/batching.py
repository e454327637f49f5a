"""The batch queue: everything that wants the policy waits here, and nothing else calls it.

Work-conserving: as soon as the policy is free it takes whatever waits, up to the batch limit, so a
lone request never pays for batching. Robots go before simulations. A session has at most one
request in a batch, in the order they came. Expired and cancelled requests are dropped before
inference.
"""

from __future__ import annotations

import contextlib
import logging
import os
import selectors
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Protocol

from vlagents_ray.errors import DeadlineExceeded, PolicyFailed, PolicyUnavailable
from vlagents_ray.wire.messages import Reply, Request

logger = logging.getLogger(__name__)


class HasFileno(Protocol):
    """A socket, a pipe: whatever a selector can wait for."""

    def fileno(self) -> int:
        """Its descriptor."""
        ...


class Rank(IntEnum):
    """Classes of requests, the more urgent first."""

    ROBOT = 0
    SIMULATION = 1


@dataclass(slots=True)
class Ticket:
    """A request on its way through the queue. `done` is called once, on the queue's thread."""

    session_id: str
    request: Request
    done: Callable[[Reply], None]
    rank: Rank = Rank.ROBOT
    owner: str = ""  # the connection that it came by
    arrived: float = field(default_factory=time.perf_counter)  # s
    cancelled: bool = False  # answered, or nobody waits for the answer any more

    def answer(self, reply: Reply) -> None:
        """Deliver the reply, once; a caller that is gone gets none."""
        if self.cancelled:
            return
        self.cancelled = True
        try:
            self.done(reply)
        except Exception:
            logger.exception("request %s: its caller could not take the reply", self.request.request_id)

    def expired(self, now: float) -> bool:
        """Is the deadline over?"""
        deadline_ms = self.request.deadline_ms
        return deadline_ms is not None and (now - self.arrived) * 1e3 > deadline_ms


class BatchQueue:
    """Hands batches of tickets to `run`, one batch at a time, on a thread of its own.

    `prepare` runs first on that thread: what must live where inference runs (a CUDA context, a
    renderer) is made there. `run` must `answer` every ticket. `idle` is called when nothing
    came for `idle_s`.

    The thread waits on file descriptors, so that a local client's socket can be one of them
    (`watch`): its request then reaches the policy without a change of threads.
    """

    def __init__(
        self,
        run: Callable[[Sequence[Ticket]], None],
        max_batch_size: int,
        *,
        prepare: Callable[[], None] = lambda: None,
        idle: Callable[[], None] = lambda: None,
        idle_s: float = 30.0,
    ) -> None:
        self._run = run
        self._prepare = prepare
        self._idle = idle
        self._idle_s = idle_s
        self._max = max_batch_size
        self._waiting: dict[Rank, deque[Ticket]] = {rank: deque() for rank in Rank}
        self._lock = threading.Lock()
        self._closed = False
        self._asleep = False
        self._selector = selectors.DefaultSelector()
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_read, False)
        os.set_blocking(self._wake_write, False)
        self._selector.register(self._wake_read, selectors.EVENT_READ)
        self._prepared = threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._loop, name="policy", daemon=True)

    def start(self) -> None:
        """Start the thread, and return when `prepare` has; what it raised is raised here."""
        self._thread.start()
        self._prepared.wait()
        if self._failure is not None:
            raise self._failure

    def put(self, *tickets: Ticket) -> None:
        """Queue requests, those put together for one batch if there is room. `PolicyUnavailable` after `close`."""
        with self._lock:
            if self._closed:
                raise PolicyUnavailable("the replica is stopping; connect again")
            for ticket in tickets:
                self._waiting[ticket.rank].append(ticket)
            self._wake()

    def watch(self, file: HasFileno, ready: Callable[[], None]) -> None:
        """Call `ready` on the queue's thread whenever `file` can be read; before `start`, or on that thread."""
        self._selector.register(file, selectors.EVENT_READ, ready)

    def unwatch(self, file: HasFileno) -> None:
        """The end of `watch`, on the queue's thread."""
        self._selector.unregister(file)

    def depth(self) -> int:
        """Requests that wait for the next batch."""
        return sum(map(len, self._waiting.values()))

    def alive(self) -> bool:
        """Is there a thread to take what is put?"""
        return self._thread.is_alive()

    def close(self, timeout_s: float | None = None) -> None:
        """Answer what waits with `PolicyUnavailable`, end the thread after the batch under way."""
        with self._lock:
            again, self._closed = self._closed, True
            self._wake()
        if self._thread.ident is None and not again:
            self._release()
        if self._thread.ident is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout_s)

    def _wake(self) -> None:
        if self._asleep:
            self._asleep = False
            os.write(self._wake_write, b"x")

    def _loop(self) -> None:
        try:
            self._prepare()
        except BaseException as error:  # noqa: BLE001 - raised again by start(), on the caller's thread
            self._failure = error
            self._release()
            return
        finally:
            self._prepared.set()
        while (batch := self._take()) is not None:
            if not batch:
                self._idle()
                continue
            try:
                self._run(batch)
            except BaseException as error:  # a policy that calls sys.exit() must not end the replica's only thread
                logger.exception("the batch failed")
                for ticket in batch:
                    failed = PolicyFailed(f"the policy raised {type(error).__name__}")
                    ticket.answer(Reply(ticket.request.request_id, error=failed))
        self._release()

    def _release(self) -> None:
        self._selector.close()
        os.close(self._wake_read)
        os.close(self._wake_write)

    def _take(self) -> list[Ticket] | None:
        """The next batch; [] if nothing came for a while, None when the queue is closed."""
        if not self._listen():
            return []
        batch: list[Ticket] | None
        with self._lock:
            if self._closed:
                left = [ticket for waiting in self._waiting.values() for ticket in waiting]
                for waiting in self._waiting.values():
                    waiting.clear()
                expired: list[Ticket] = []
                batch = None
            else:
                left = []
                expired, batch = self._collect()
        for ticket in left:
            stopped = PolicyUnavailable("the replica is stopping; connect again")
            ticket.answer(Reply(ticket.request.request_id, error=stopped))
        for ticket in expired:
            late = DeadlineExceeded(f"no action within {ticket.request.deadline_ms:g} ms: dropped before inference")
            ticket.answer(Reply(ticket.request.request_id, error=late))
        return batch

    def _listen(self) -> bool:
        """Until something waits, or the queue is closed; also hear all watched files that are ready now."""
        while True:
            with self._lock:
                here = self._closed or self.depth() > 0
                self._asleep = not here
            events = self._selector.select(0 if here else self._idle_s)
            self._asleep = False
            for key, _ in events:
                if key.data is None:
                    with contextlib.suppress(BlockingIOError):
                        os.read(self._wake_read, 4096)
                    continue
                try:
                    key.data()
                except Exception:
                    logger.exception("a local client's door failed")
                    with contextlib.suppress(KeyError, ValueError):  # it may have been unwatched, or closed, already
                        self._selector.unregister(key.fileobj)
            if here or self.depth() > 0 or self._closed:
                return True
            if not events:
                return False

    def _collect(self) -> tuple[list[Ticket], list[Ticket]]:
        now = time.perf_counter()
        batch: list[Ticket] = []
        expired: list[Ticket] = []
        sessions: set[str] = set()
        for waiting in self._waiting.values():
            later: list[Ticket] = []
            while waiting and len(batch) < self._max:
                ticket = waiting.popleft()
                if ticket.cancelled:
                    continue
                if ticket.expired(now):
                    expired.append(ticket)
                elif ticket.session_id in sessions:
                    later.append(ticket)
                else:
                    sessions.add(ticket.session_id)
                    batch.append(ticket)
            waiting.extendleft(reversed(later))
        return expired, batch
