"""The batch queue: all requests for the policy wait here, and only this queue starts batches.

The queue is work-conserving except for one short wait: as soon as the policy is free, it takes all waiting requests
up to the batch limit, so that batching never delays a lone request. `vlagents_ray.serve.queue.fair_queue` decides the
order. Expired and cancelled requests are dropped before inference, but only when the policy is next free; a caller
that must learn of its expired deadline sooner sets a timer.

The queue waits for the remaining requests of a group of simulations that were answered together and are about to send
their next requests. `vlagents_ray.serve.queue.batch_window` decides when and for how long. `patience=0` disables it.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

from vlagents_ray.errors import DeadlineExceeded, PolicyFailed, PolicyUnavailable, VLAgentsError
from vlagents_ray.protocol.messages import Reply
from vlagents_ray.serve.queue.batch_window import BatchWindow
from vlagents_ray.serve.queue.fair_queue import FairQueue, PendingRequest, Rank
from vlagents_ray.serve.queue.poller import HasFileno, Poller

__all__ = ["BatchQueue", "HasFileno", "PendingRequest", "Rank"]

logger = logging.getLogger(__name__)

_SPIN_S = 100e-6  # time for which the thread polls for a next request before it sleeps
_DENSE_S = 500e-6  # gap between two requests below which the next one is expected as soon


class BatchQueue:
    """Passes batches of tickets to `run`, one batch at a time, on the policy's thread.

    The thread waits on file descriptors, so that a local client's socket can be one of them (`watch`): its request
    then reaches the policy without a thread switch. While batches take milliseconds and are not all for one session,
    a second thread polls these files, so that the next batch is already decoded when the current one ends. If that
    next batch is full, a third thread sends the replies to simulations while it runs.

    Args:
        run: Runs a batch, and must `answer` each of its tickets.
        max_batch_size: Largest number of tickets in a batch.
        prepare: Called first on the policy's thread, to create what inference needs there (a CUDA context, a renderer).
        idle: Called when no request has arrived for `idle_s`.
        idle_s: Time without a request after which `idle` is called, s.
        patience: After a batch that took D s, the thread waits at most `patience` * D s for the sessions of that
            batch that are about to send their next requests.
        is_open: Returns whether a session still exists.
        clock: Time, s.
        poller: Poller for the watched files; by default the queue creates one.
    """

    def __init__(
        self,
        run: Callable[[Sequence[PendingRequest]], None],
        max_batch_size: int,
        *,
        prepare: Callable[[], None] = lambda: None,
        idle: Callable[[], None] = lambda: None,
        idle_s: float = 30.0,
        patience: float = 0.0,
        is_open: Callable[[str], bool] = lambda _: True,
        clock: Callable[[], float] = time.perf_counter,
        poller: Poller | None = None,
    ) -> None:
        self._run = run
        self._clock = clock
        self._prepare = prepare
        self._idle = idle
        self._idle_s = idle_s
        self._max = max_batch_size
        self._waiting = FairQueue()
        self._load_timer = LoadTimer()  # counts the time in which the policy loads as idle
        self._lock = threading.Lock()
        self._closed = False
        self._alive = False
        self._asleep = False
        self._driven = False  # whether a caller of `take` drives the queue; each new request wakes it up
        self._dense = False  # whether requests arrive in quick succession
        self._poller = poller or Poller()
        self.window = BatchWindow(patience, max_batch_size, is_open)
        self._gathering = False
        self._wait_over = threading.Event()
        self._unsent: list[tuple[PendingRequest, Reply]] = []
        self._running: Sequence[PendingRequest] = ()
        self._answers = ThreadPoolExecutor(1, "policy-answers")
        self._prepared = threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._loop, name="policy", daemon=True)

    def start(self, limit_s: float | None = None, *, threaded: bool = True) -> None:
        """Start the policy's thread, and return when `prepare` has returned.

        Args:
            limit_s: Longest time that `prepare` may take, s; no limit by default.
            threaded: False if the calling thread is the policy's thread, and calls `take` and `run_timed` in turns.

        Raises:
            TimeoutError: `prepare` took longer than `limit_s`.
            BaseException: Any error of `prepare`.
        """
        self._alive = True
        if not threaded:
            self._driven = self._asleep = True
            self._prepare()
            self._load_timer.mark_busy()
            return
        self._thread.start()
        if not self._prepared.wait(limit_s):
            raise TimeoutError(f"not loaded within {limit_s:g} s, its limit")
        if self._failure is not None:
            raise self._failure

    def put(self, *tickets: PendingRequest) -> None:
        """Queue requests; those of one call enter the same batch if it has room. `PolicyUnavailable` after `close`."""
        with self._lock:
            if self._closed:
                raise PolicyUnavailable("the replica is stopping; connect again")
            for ticket in tickets:
                self._load_timer.count(self._waiting.size, ticket.loaded or ticket.arrived)
                if self.window.slow:
                    self.window.record_arrival(ticket)
                self._waiting.add(ticket)
                if self._gathering and self.window.ends_wait(ticket, self._waiting):
                    self._wait_over.set()
            self._wake()

    def fail(self, running: VLAgentsError, waiting: VLAgentsError) -> None:
        """Answer the running batch with `running`, and all waiting requests with `waiting`.

        The replies that `run` produces later for the running batch are dropped. May be called on any thread.
        """
        with self._lock:
            self._load_timer.count(self._waiting.size, self._clock())
            left, batch = self._waiting.clear(), self._running
            if batch:
                self._poller.hand_to_reader()  # so that later requests can be refused while the batch hangs
        for tickets, error in ((batch, running), (left, waiting)):
            for ticket in tickets:
                ticket.answer(Reply(ticket.request.request_id, error=error))

    def withdraw(self, *tickets: PendingRequest) -> None:
        """Cancel requests. Their `begun` no longer changes: the policy only acts on those that have begun."""
        with self._lock:
            for ticket in tickets:
                ticket.cancelled = True

    def watch(self, file: HasFileno, ready: Callable[[], None]) -> None:
        """Call `ready` whenever `file` can be read; two such callbacks never run at once.

        Callbacks run on the queue's thread or, while a batch runs, on the reader thread. May only be called before
        `start` or in a callback.
        """
        self._poller.watch(file, ready)

    def unwatch(self, file: HasFileno) -> None:
        """Stop watching `file`. May only be called in a callback."""
        self._poller.unwatch(file)

    def call_soon(self, call: Callable[[], None]) -> None:
        """Schedule `call` to run as the callback of a watched file does. May be called on any thread."""
        self._poller.call_soon(call)

    def call_later(self, seconds: float, call: Callable[[], None]) -> None:
        """Schedule `call` as `call_soon` does, after `seconds`. May be called on any thread."""
        timer = threading.Timer(seconds, self._poller.call_soon, (call,))
        timer.daemon = True
        timer.start()

    def full_batch_waits(self) -> bool:
        """Return whether a full batch waits, so that replies to simulations can be sent while that one runs."""
        return self.window.slow and self._waiting.sessions >= self._max

    def answer_later(self, answers: Sequence[tuple[PendingRequest, Reply]]) -> None:
        """Send these replies from another thread once the next batch runs. Called in `run`, on the queue's thread."""
        self._unsent.extend(answers)

    def depth(self) -> int:
        """Return the number of requests that wait for the next batch."""
        return self._waiting.size

    def depth_by_rank(self) -> dict[Rank, int]:
        """Return the number of requests that wait for the next batch, by class."""
        return dict(zip(Rank, self._waiting.depth, strict=True))

    def waited_s(self) -> float:
        """Return the total time that all requests have waited so far, s; its growth rate is the mean queue length."""
        with self._lock:
            return self._load_timer.waited_s(self._waiting.size)

    def idle_time_s(self) -> float:
        """Return the total time for which the policy's thread has been idle, s; otherwise it was busy."""
        return self._load_timer.idle_time_s()

    def alive(self) -> bool:
        """Return whether a thread is running that takes queued requests."""
        return self._alive

    def close(self, timeout_s: float | None = None) -> None:
        """Answer waiting requests with `PolicyUnavailable`, and end the thread after the running batch.

        Waits at most `timeout_s` for the thread to end; without a limit by default.
        """
        with self._lock:
            again, self._closed = self._closed, True
            self._wait_over.set()
            self._wake()
        if self._thread.ident is None and not again:
            self._poller.close()
        if self._thread.ident is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout_s)

    def _wake(self) -> None:
        if self._asleep and threading.get_ident() != self._thread.ident:  # the policy's thread is awake if it calls
            self._asleep = False
            self._poller.wake()

    def _loop(self) -> None:
        try:
            self._prepare()
        except BaseException as error:  # noqa: BLE001 - raised again by start(), on the caller's thread
            self._failure = error
            self._alive = False
            self._poller.close()
            return
        finally:
            self._load_timer.mark_busy()
            self._prepared.set()
        try:
            self._serve()
        finally:
            self._alive = False

    def _serve(self) -> None:
        while (batch := self._next()) is not None:
            if self._unsent:
                unsent, self._unsent = self._unsent, []
                self._answers.submit(_send, unsent)
            if not batch:
                self._idle()
                continue
            self.run_timed(batch)
        _send(self._unsent)
        self._answers.shutdown()
        self._poller.close()

    def run_timed(self, batch: Sequence[PendingRequest]) -> None:
        """Run a batch that `take` returned, and measure its duration. Called on the policy's thread."""
        begun = self._clock()
        self._running = batch
        if self.window.overlaps:
            self._poller.hand_to_reader()
        try:
            self._run(batch)
        except BaseException as error:  # a policy that calls sys.exit() must not end the replica's only thread
            logger.exception("the batch failed")
            for ticket in batch:
                failed = PolicyFailed(f"the policy raised {type(error).__name__}")
                ticket.answer(Reply(ticket.request.request_id, error=failed))
        ended = self._clock()
        with self._lock:
            self._running = ()  # its observations may lie in memory that their sender needs back
            self.window.record_end(ended, ended - begun)
        self._poller.reclaim()

    def _next(self) -> list[PendingRequest] | None:
        """Return the next batch: [] if no request has arrived for `idle_s`, None when the queue is closed."""
        if not self._wait_for_request():
            return []
        if self.window.slow:
            self._gather()
        return self.take()

    def take(self) -> list[PendingRequest] | None:
        """Return the waiting requests as a batch for `run_timed`; None when the queue is closed.

        Called on the policy's thread. Expired requests are answered with `DeadlineExceeded`.
        """
        with self._lock:
            closed, now = self._closed, self._clock()
            self._asleep = self._driven
            self._load_timer.count(self._waiting.size, now)
            left = self._waiting.clear() if closed else []
            batch, expired = self._waiting.take(self._max, now)
            if batch:
                self.window.record_start(batch)
        for ticket in left:
            stopped = PolicyUnavailable("the replica is stopping; connect again")
            ticket.answer(Reply(ticket.request.request_id, error=stopped))
        for ticket in expired:
            late = DeadlineExceeded(f"no action within {ticket.request.deadline_ms:g} ms: dropped before inference")
            ticket.answer(Reply(ticket.request.request_id, error=late))
        return None if closed else batch

    def _wait_for_request(self) -> bool:
        """Poll the watched files until a request waits or the queue is closed; False after `idle_s` without events."""
        while True:
            with self._lock:
                ready = self._closed or self._waiting.size > 0
                self._asleep = not ready
            had_event = self._poller.poll(0.0) if ready else self._wait_for_event()
            self._asleep = False
            if ready or self._waiting.size > 0 or self._closed:
                return True
            if not had_event:
                return False

    def _wait_for_event(self) -> bool:
        """Wait for a watched file or a wake-up call; False if there was none within `idle_s`.

        If the last request came soon, the thread polls for `_SPIN_S` before it sleeps, since waking up takes as long
        as a fast policy. It yields the core to other processes meanwhile.
        """
        begun = self._load_timer.mark_idle()
        while self._dense and time.perf_counter() - begun < _SPIN_S:
            if self._poller.poll(0.0):
                self._load_timer.mark_busy()
                return True
            os.sched_yield()
        had_event = self._poller.poll(self._idle_s)
        self._dense = self._load_timer.mark_busy() - begun < _DENSE_S
        return had_event

    def _gather(self) -> None:
        """Wait for the remaining requests of a group, if `BatchWindow` finds that worthwhile."""
        with self._lock:
            wait_s = 0.0 if self._closed else self.window.wait_s(time.perf_counter(), self._waiting)
            if wait_s <= 0:
                return
            self._wait_over.clear()
            self._gathering = True
        self._poller.hand_to_reader()  # an epoll waits for whole milliseconds, the event below for exact times
        complete = self._wait_over.wait(wait_s)
        self._poller.reclaim()
        if not complete:
            self._poller.poll(0)
        with self._lock:
            self._gathering = False


def _send(answers: Sequence[tuple[PendingRequest, Reply]]) -> None:
    for ticket, reply in answers:
        ticket.answer(reply)


# The measured load: how long requests have waited for the policy, and how long its thread was idle.


class LoadTimer:
    """Adds up the waiting time of requests and the idle time of the policy's thread, which is idle at first.

    Callers of `count` and `waited_s` must hold one lock; `idle_time_s` may be called on any thread.
    """

    def __init__(self) -> None:
        now = time.perf_counter()
        self._waited = 0.0  # total waiting time of all requests, s
        self._counted = now  # time up to which `_waited` is complete
        self._idle: tuple[float, float | None] = (0.0, now)  # total idle time, s, and start of the current idle period

    def count(self, waiting: int, now: float) -> None:
        """Add the time that `waiting` requests have waited until `now`, s, before their number changes."""
        self._waited += waiting * (now - self._counted)
        self._counted = now

    def waited_s(self, waiting: int) -> float:
        """Return the total waiting time of all requests, s, including the `waiting` ones that wait now."""
        return self._waited + waiting * max(0.0, time.perf_counter() - self._counted)

    def mark_idle(self) -> float:
        """Mark the policy's thread idle, and return the current time, s."""
        now = time.perf_counter()
        self._idle = (self._idle[0], now)
        return now

    def mark_busy(self) -> float:
        """Mark the policy's thread busy, and return the current time, s."""
        now = time.perf_counter()
        idle, since = self._idle
        self._idle = (idle if since is None else idle + now - since, None)
        return now

    def idle_time_s(self) -> float:
        """Return the total idle time of the policy's thread, s, including the current idle period."""
        idle, since = self._idle
        return idle if since is None else idle + max(0.0, time.perf_counter() - since)
