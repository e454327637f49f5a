"""The batch queue: everything that wants the policy waits here, and nothing else calls it.

Work-conserving, but for one short wait: as soon as the policy is free it takes whatever waits, up to the
batch limit, so a lone request never pays for batching. Who goes first is up to `vlagents_ray.serve.waiting`.
Expired and cancelled requests are dropped before inference: when the policy is next free, so that a caller
who must know sooner keeps a timer of its own.

The wait is for the rest of a group of simulations that was answered together and is coming back; when, and
for how long at most, is up to `vlagents_ray.serve.returning`. `patience` 0 does without.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

from vlagents_ray.errors import DeadlineExceeded, PolicyFailed, PolicyUnavailable
from vlagents_ray.serve.ears import Ears, HasFileno
from vlagents_ray.serve.returning import Returning
from vlagents_ray.serve.tally import Tally
from vlagents_ray.serve.waiting import Rank, Ticket, Waiting
from vlagents_ray.wire.messages import Reply

__all__ = ["BatchQueue", "HasFileno", "Rank", "Ticket"]

logger = logging.getLogger(__name__)

_LOOK_S = 100e-6  # for a next request before going to sleep
_DENSE_S = 500e-6  # since the last one: the next is likely to come as soon


class BatchQueue:
    """Hands batches of tickets to `run`, one batch at a time, on a thread of its own.

    `prepare` runs first on that thread: what must live where inference runs (a CUDA context, a
    renderer) is made there. `run` must `answer` every ticket. `idle` is called when nothing
    came for `idle_s`.

    Before the batch after one of D s starts, the thread may wait `patience` * D s at most for sessions that
    were in that batch and are about to come back. `is_open` tells whether a session still is there.

    The thread waits on file descriptors, so that a local client's socket can be one of them
    (`watch`): its request then reaches the policy without a change of threads. While batches take
    milliseconds and are not all for one session, a second thread hears these files, so that the next batch is
    decoded when one is over; and where that one is full, a third sends the answers to simulations while it runs.
    """

    def __init__(
        self,
        run: Callable[[Sequence[Ticket]], None],
        max_batch_size: int,
        *,
        prepare: Callable[[], None] = lambda: None,
        idle: Callable[[], None] = lambda: None,
        idle_s: float = 30.0,
        patience: float = 0.0,
        is_open: Callable[[str], bool] = lambda _: True,
    ) -> None:
        self._run = run
        self._prepare = prepare
        self._idle = idle
        self._idle_s = idle_s
        self._max = max_batch_size
        self._waiting = Waiting()
        self._tally = Tally()  # loading the policy is no work for a session: as if the thread slept
        self._lock = threading.Lock()
        self._closed = False
        self._alive = False
        self._asleep = False
        self._dense = False  # do requests come one upon the other?
        self._ears = Ears()
        self._returning = Returning(patience, max_batch_size, is_open)
        self._gathering = False
        self._whole = threading.Event()
        self._unsent: list[tuple[Ticket, Reply]] = []
        self._answers = ThreadPoolExecutor(1, "policy-answers")
        self._prepared = threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._loop, name="policy", daemon=True)

    def start(self) -> None:
        """Start the thread, and return when `prepare` has; what it raised is raised here."""
        self._alive = True
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
                self._tally.count(self._waiting.size, ticket.loaded or ticket.arrived)
                if self._returning.slow:
                    self._returning.came(ticket)
                self._waiting.add(ticket)
                if self._gathering and self._returning.whole(ticket, self._waiting):
                    self._whole.set()
            self._wake()

    def watch(self, file: HasFileno, ready: Callable[[], None]) -> None:
        """Call `ready` whenever `file` can be read; before `start`, or in such a call. Never two calls at once.

        Calls come on the queue's thread, or beside a batch that runs, on another one.
        """
        self._ears.watch(file, ready)

    def unwatch(self, file: HasFileno) -> None:
        """The end of `watch`, in such a call."""
        self._ears.unwatch(file)

    def later(self, call: Callable[[], None]) -> None:
        """Have `call` called as if a watched file were ready. Any thread."""
        self._ears.later(call)

    def hurries(self) -> bool:
        """Does a full batch wait for the policy, so that answers to simulations can be sent while it runs?"""
        return self._returning.slow and self._waiting.sessions >= self._max

    def answer_later(self, answers: Sequence[tuple[Ticket, Reply]]) -> None:
        """Send them as soon as the next batch runs, from another thread; on the queue's thread, in `run`."""
        self._unsent.extend(answers)

    def depth(self) -> int:
        """Requests that wait for the next batch."""
        return self._waiting.size

    def depth_by_rank(self) -> dict[Rank, int]:
        """The same, by class."""
        return dict(zip(Rank, self._waiting.depth, strict=True))

    def waited_s(self) -> float:
        """How long all requests together have waited so far; its growth is the mean number that wait."""
        with self._lock:
            return self._tally.waited_s(self._waiting.size)

    def slept_s(self) -> float:
        """How long the policy's thread has had nothing to do so far; the rest of the time it was busy."""
        return self._tally.slept_s()

    def alive(self) -> bool:
        """Is there a thread to take what is put?"""
        return self._alive

    def close(self, timeout_s: float | None = None) -> None:
        """Answer what waits with `PolicyUnavailable`, end the thread after the batch under way."""
        with self._lock:
            again, self._closed = self._closed, True
            self._whole.set()
            self._wake()
        if self._thread.ident is None and not again:
            self._ears.close()
        if self._thread.ident is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout_s)

    def _wake(self) -> None:
        if self._asleep and threading.get_ident() != self._thread.ident:  # which is awake if it is here itself
            self._asleep = False
            self._ears.wake()

    def _loop(self) -> None:
        try:
            self._prepare()
        except BaseException as error:  # noqa: BLE001 - raised again by start(), on the caller's thread
            self._failure = error
            self._alive = False
            self._ears.close()
            return
        finally:
            self._tally.wakes()
            self._prepared.set()
        try:
            self._serve()
        finally:
            self._alive = False

    def _serve(self) -> None:
        while (batch := self._take()) is not None:
            if self._unsent:
                unsent, self._unsent = self._unsent, []
                self._answers.submit(_send, unsent)
            if not batch:
                self._idle()
                continue
            self._run_timed(batch)
        _send(self._unsent)
        self._answers.shutdown()
        self._ears.close()

    def _run_timed(self, batch: Sequence[Ticket]) -> None:
        begun = time.perf_counter()
        if self._returning.slow and not self._returning.alone:
            self._ears.lend()
        try:
            self._run(batch)
        except BaseException as error:  # a policy that calls sys.exit() must not end the replica's only thread
            logger.exception("the batch failed")
            for ticket in batch:
                failed = PolicyFailed(f"the policy raised {type(error).__name__}")
                ticket.answer(Reply(ticket.request.request_id, error=failed))
        self._ears.take_back()
        ended = time.perf_counter()
        with self._lock:
            self._returning.ended(ended, ended - begun)

    def _take(self) -> list[Ticket] | None:
        """The next batch; [] if nothing came for a while, None when the queue is closed."""
        if not self._listen():
            return []
        if self._returning.slow:
            self._gather()
        with self._lock:
            closed, now = self._closed, time.perf_counter()
            self._tally.count(self._waiting.size, now)
            left = self._waiting.clear() if closed else []
            batch, expired = self._waiting.take(self._max, now)
            if batch:
                self._returning.taken(batch)
        for ticket in left:
            stopped = PolicyUnavailable("the replica is stopping; connect again")
            ticket.answer(Reply(ticket.request.request_id, error=stopped))
        for ticket in expired:
            late = DeadlineExceeded(f"no action within {ticket.request.deadline_ms:g} ms: dropped before inference")
            ticket.answer(Reply(ticket.request.request_id, error=late))
        return None if closed else batch

    def _listen(self) -> bool:
        """Until something waits, or the queue is closed; also hear all watched files that are ready now."""
        while True:
            with self._lock:
                here = self._closed or self._waiting.size > 0
                self._asleep = not here
            if not here:
                self._tally.sleeps()
            heard = self._ears.hear(0.0) if here else self._nap()
            if not here:
                self._tally.wakes()
            self._asleep = False
            if here or self._waiting.size > 0 or self._closed:
                return True
            if not heard:
                return False

    def _nap(self) -> bool:
        """Wait for something to hear.

        Where the last request came at once, look for the next one before going to sleep: waking up takes
        as long as a fast policy does. Other processes get the core meanwhile if they want it.
        """
        begun = time.perf_counter()
        while self._dense and time.perf_counter() - begun < _LOOK_S:
            if self._ears.hear(0.0):
                return True
            os.sched_yield()
        heard = self._ears.hear(self._idle_s)
        self._dense = time.perf_counter() - begun < _DENSE_S
        return heard

    def _gather(self) -> None:
        """Wait for the rest of a group, where that is worth it."""
        with self._lock:
            wait_s = 0.0 if self._closed else self._returning.wait_s(time.perf_counter(), self._waiting)
            if wait_s <= 0:
                return
            self._whole.clear()
            self._gathering = True
        self._ears.lend()  # a selector waits for whole milliseconds, this for what is asked
        came = self._whole.wait(wait_s)
        self._ears.take_back()
        if not came:
            self._ears.hear(0)
        with self._lock:
            self._gathering = False


def _send(answers: Sequence[tuple[Ticket, Reply]]) -> None:
    for ticket, reply in answers:
        ticket.answer(reply)
