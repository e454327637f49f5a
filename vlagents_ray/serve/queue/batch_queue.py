"""The batch queue: it holds all requests for the policy until the policy's thread takes them in
batches.

The queue is work-conserving except for one short wait: as soon as the policy is free, it takes all
waiting requests up to the batch limit, so that batching never delays a single request.
`vlagents_ray.serve.queue.fair_queue` defines the order. Expired and finished requests never reach
the policy, but they are only dropped when the policy is free again. A caller that needs to know
earlier that its deadline has expired sets a timer.

The queue waits for the remaining requests of a group of sessions that were answered together and
are about to send their next requests. `vlagents_ray.serve.queue.batch_window` decides when and for
how long. `patience=0` disables this.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Container, Iterable, Sequence
from typing import NamedTuple

from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.polling import Polling
from vlagents_ray.protocol.messages import Priority
from vlagents_ray.serve.queue.batch_window import BatchWindow
from vlagents_ray.serve.queue.fair_queue import FairQueue
from vlagents_ray.serve.queue.poller import Poller
from vlagents_ray.serve.queue.robots_load import CostCurve, Room
from vlagents_ray.serve.requests import PendingRequest

_POLLING_S = 100e-6  # time for which the thread polls for the next request before it sleeps
_LONG_BATCH_S = 0.5  # duration of a batch after which another thread always polls, s
# Time for which the thread sleeps while requests are held, s. Then the needs of robots are read
# again, since a robot may have left.
_HELD_S = 0.5
# Interval between two requests below which the next request is expected after the same interval.
_DENSE_S = 500e-6


class Taken(NamedTuple):
    """The requests that the policy's thread takes from the queue together; both lists are empty
    after a long time without requests.
    """

    batch: list[PendingRequest]
    # Requests whose deadlines have passed, or whose clients have left: they are not in the batch,
    # and still unanswered.
    expired: list[PendingRequest]


class BatchQueue:
    """The waiting requests, and the watched files that deliver new ones.

    One thread, the policy's thread, calls `bind`, then repeatedly `next`, `begin` and `end`, and
    finally `poller.close`. This thread waits on file descriptors. Among them are the sockets of
    local clients, whose requests therefore reach the policy without a thread switch. While batches
    take milliseconds and are not all for one session, a second thread polls these files, so that
    the next batch is already decoded when the current one ends.

    Args:
        idle_s: Time without a request after which `next` returns nothing, s.
        patience: After a batch that took D s, the thread waits at most `patience` * D s for the
            sessions of that batch that are about to send their next requests.
        sessions: Contains the ids of the sessions that exist.
        poller: Poller for the watched files; by default the queue creates one.
    """

    def __init__(
        self,
        max_batch_size: int,
        *,
        sessions: Container[str],
        idle_s: float = 30.0,
        patience: float = 0.0,
        clock: Callable[[], float] = time.perf_counter,
        poller: Poller | None = None,
    ) -> None:
        self._clock, self._idle_s = clock, idle_s
        self.largest = max_batch_size
        self._waiting = FairQueue()

        self._load_timer = LoadTimer()  # the time until the policy is loaded counts as idle
        self._lock = threading.Lock()
        self._closed = False
        self._thread = 0  # id of the policy's thread
        self._asleep = False
        self._interrupted = False  # whether `next` must return without a request
        # Whether a caller of `take` drives the queue; each new request then wakes that caller.
        self._driven = False
        self._polling = Polling(_POLLING_S)
        self._dense = False  # whether requests arrive in quick succession

        self.poller = poller or Poller()
        self.window = BatchWindow(patience, max_batch_size, sessions)
        self._gathering = False
        self._wait_over = threading.Event()
        self._running: Sequence[PendingRequest] = ()
        self._begun = 0.0  # start of the running batch, s

    def bind(self, *, driven: bool = False) -> None:
        """Make the calling thread the policy's thread. If the queue is `driven`, the poller's
        `wake` signals when to call `take`.
        """
        self._thread = 0 if driven else threading.get_ident()
        self._driven = self._asleep = driven
        self._load_timer.mark_busy()

    def put(self, *requests: PendingRequest) -> None:
        """Queue requests, for the same batch if that has room for all; raise `PolicyUnavailable`
        after `close`.
        """
        with self._lock:
            if self._closed:
                raise PolicyUnavailable("the replica is stopping; connect again")
            for pending in requests:
                if self.window.slow:
                    self.window.record_arrival(pending)
                self._waiting.add(pending)
                if self._gathering and self.window.ends_wait(pending, self._waiting):
                    self._wait_over.set()
            self._wake()

    def withdraw(self, *requests: PendingRequest) -> None:
        """End requests without an answer; no batch contains them later."""
        with self._lock:
            for pending in requests:
                pending.over = True

    def give_back(self, requests: Iterable[PendingRequest]) -> None:
        """Record that the policy has not received these requests, although they are in a batch."""
        with self._lock:
            for pending in requests:
                pending.begun = False

    def cancel(self, pending: PendingRequest) -> bool:
        """End a request without an answer, unless it is in a batch; return whether it was ended."""
        with self._lock:
            if pending.begun:
                return False
            pending.over = True
            return True

    def interrupt(self) -> None:
        """Make `next` return now, even if no request waits. May be called on any thread."""
        with self._lock:
            self._interrupted = True
            self._wake()

    def next(self) -> Taken | None:
        """Wait for requests, and return the next batch; it is empty after `idle_s` and after
        `interrupt`, and None after `close`.
        """
        if not self._wait_for_request():
            return Taken([], [])
        if self.window.slow:
            self._gather()
        return self.take()

    def take(self) -> Taken | None:
        """Return the waiting requests, as `next` does, without waiting for more."""
        with self._lock:
            now = self._clock()
            self._asleep = self._driven
            self._interrupted = False
            if self._closed:
                return None
            batch, expired = self._waiting.take(self.largest, now)
            if batch:
                self.window.record_start(batch)
        return Taken(batch, expired)

    def begin(self, batch: Sequence[PendingRequest]) -> None:
        """Record that the policy begins a batch; another thread polls during the batch, if
        worthwhile.
        """
        self._begun = self._clock()
        self._running = batch
        if self.window.overlaps:
            self.poller.hand_to_reader()

    def lend_poller(self) -> None:
        """Let another thread poll if the running batch takes long, so that clients' pings are
        answered meanwhile; called periodically, on another thread.
        """
        with self._lock:
            if self._running and self._clock() - self._begun > _LONG_BATCH_S:
                self.poller.hand_to_reader()

    def end(self) -> None:
        """Record that the batch has ended."""
        ended = self._clock()
        duration = ended - self._begun
        with self._lock:
            self._load_timer.count_batch(self._running, duration)
            self._running = ()  # the observations in the batch may be in the sender's memory
            self.window.record_end(ended, duration)
            self._waiting.costs_s = self.window.costs_s
        self.poller.reclaim()

    def clear(self) -> tuple[Sequence[PendingRequest], list[PendingRequest]]:
        """Return the running batch, and the waiting requests, which are removed. May be called on
        any thread.

        Another thread reads later requests until the batch ends, so that they can be rejected while
        the batch hangs.
        """
        with self._lock:
            if self._running:
                self.poller.hand_to_reader()
            return self._running, self._waiting.clear()

    def full_batch_waits(self) -> bool:
        """Return whether a full batch waits, so that replies to simulations can be sent while it
        runs.
        """
        return self.window.slow and self._waiting.sessions >= self.largest

    @property
    def room(self) -> Room | None:
        """The room that robots leave in batches to other requests, see `FairQueue`."""
        return self._waiting.room

    @room.setter
    def room(self, room: Room | None) -> None:
        with self._lock:
            self._waiting.room = room

    def had_others(self) -> bool:
        """Return whether requests waited behind robots since the last call, see `FairQueue`."""
        with self._lock:
            return self._waiting.had_others()

    def curve(self) -> CostCurve | None:
        """Return the measured durations of batches; None before the first batch."""
        return self.window.curve()

    def depth_first(self) -> int:
        """Return the number of sessions whose requests wait behind no other class of requests."""
        with self._lock:
            return self._waiting.first

    def depth(self) -> int:
        """Return the number of requests that wait for the next batch."""
        return self._waiting.size

    def depth_of(self, priority: Priority) -> int:
        """Return the number of requests of a priority that wait for the next batch."""
        return self._waiting.depth[priority]

    def waiting_sessions(self) -> set[str]:
        """Return the ids of the sessions whose requests wait for the next batch."""
        with self._lock:
            return {pending.session_id for pending in self._waiting.heads()}

    def depth_by_priority(self) -> dict[Priority, int]:
        """Return the number of requests that wait for the next batch, by priority."""
        return dict(zip(Priority, self._waiting.depth, strict=True))

    def load_s(self) -> tuple[float, float]:
        """Return the total idle time of the policy's thread so far, and the total time in which it
        computed for robots with slack, s.
        """
        return self._load_timer.idle_time_s(), self._load_timer.paced_s

    def close(self) -> list[PendingRequest]:
        """Reject further requests, make `next` return None after the running batch, and return
        the waiting requests.
        """
        with self._lock:
            self._closed = True
            self._wait_over.set()
            self._wake()
            return self._waiting.clear()

    def _wake(self) -> None:
        # The policy's thread need not be woken if it calls this method itself.
        if self._asleep and threading.get_ident() != self._thread:
            self._asleep = False
            self.poller.wake()

    def _wait_for_request(self) -> bool:
        """Poll the watched files until a request waits that is not held, or the queue is closed;
        return False after `idle_s` without events, or soon if requests are held.
        """
        had_event: bool | None = None  # None before the first wait
        while True:
            with self._lock:
                # Without robots, nothing is held; each function call here delays every act.
                waiting = self._waiting
                is_held = waiting.room is not None and waiting.is_held(self._clock())
                must_return = self._closed or self._interrupted
                is_ready = must_return or (waiting.size > 0 and not is_held)
                self._asleep = not is_ready and had_event is not False
            if is_ready:
                if had_event is None:
                    self.poller.poll(0.0)  # for requests that belong in the same batch
                return True
            if had_event is False:
                return False
            had_event = self._wait_for_event(is_held)
            self._asleep = False

    def _wait_for_event(self, is_held: bool) -> bool:
        """Wait for a watched file or a wake-up call; return False if there was none within
        `idle_s`, or soon if the waiting requests are held. The thread does not count as idle then.

        If the last request followed quickly, the thread polls before it sleeps, since waking up
        takes as long as a fast policy.
        """
        begun = time.perf_counter() if is_held else self._load_timer.mark_idle()
        if self._dense and self._polling.receives(self.poller.poll):
            self._load_timer.mark_busy()
            return True
        had_event = self.poller.poll(min(self._idle_s, _HELD_S) if is_held else self._idle_s)
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
        # Epoll waits for whole milliseconds; the wait for the event below is more precise.
        self.poller.hand_to_reader()
        complete = self._wait_over.wait(wait_s)
        self.poller.reclaim()
        if not complete:
            self.poller.poll(0)
        with self._lock:
            self._gathering = False


# The measured load: the waiting time of requests, and the idle time of the policy's thread.


class LoadTimer:
    """Adds up the idle time of the policy's thread, which is idle at first, and the time in which
    it computes for robots with slack. `idle_time_s` may be called on any thread.
    """

    def __init__(self) -> None:
        # Total idle time, s, and start of the current idle period.
        self._idle: tuple[float, float | None] = (0.0, time.perf_counter())
        self.paced_s = 0.0  # total time in which the policy computed for robots with slack, s

    def count_batch(self, batch: Sequence[PendingRequest], duration: float) -> None:
        """Count a batch that took `duration`, s."""
        paced = 0
        for pending in batch:  # `sum` would call a function for each request
            if pending.needed:
                paced += 1
        if paced:
            self.paced_s += duration * paced / len(batch)

    def mark_idle(self) -> float:
        """Mark the policy's thread as idle, and return the current time, s."""
        now = time.perf_counter()
        self._idle = (self._idle[0], now)
        return now

    def mark_busy(self) -> float:
        """Mark the policy's thread as busy, and return the current time, s."""
        now = time.perf_counter()
        idle, since = self._idle
        self._idle = (idle if since is None else idle + now - since, None)
        return now

    def idle_time_s(self) -> float:
        """Return the total idle time of the policy's thread, s, including the current idle
        period.
        """
        idle, since = self._idle
        return idle if since is None else idle + max(0.0, time.perf_counter() - since)


class QueueLoad(NamedTuple):
    """Mean load of a queue since the last reading."""

    utilisation: float  # share of the time in which the policy's thread was busy, in [0, 1]
    paced: float  # share of the time in which it computed for robots with slack, in [0, 1]

    def needed(self, robots_need: float) -> float:
        """Return the share of the time that the clients need the policy's thread, in [0, 1]. Robots
        with slack also use the remaining time, for fresher actions.

        Args:
            robots_need: The share that the robots with slack need.
        """
        return self.utilisation - self.paced + min(self.paced, robots_need)


class LoadMeter:
    """Measures the load of a queue between two readings; each reader needs a meter."""

    def __init__(self, queue: BatchQueue) -> None:
        self._queue = queue
        self._last = (time.perf_counter(), *queue.load_s())

    def read(self) -> QueueLoad:
        """Return the mean load since the last call, or since the meter was created."""
        now = (time.perf_counter(), *self._queue.load_s())
        elapsed_s, idle_s, paced_s = (
            current - last for last, current in zip(self._last, now, strict=True)
        )
        self._last = now
        if elapsed_s <= 0:
            return QueueLoad(0.0, 0.0)

        utilisation = min(1.0, max(0.0, 1.0 - idle_s / elapsed_s))
        return QueueLoad(utilisation, min(utilisation, paced_s / elapsed_s))
