"""Decides whether a batch waits briefly for sessions about to send their next request; uses no
threads or clocks.

The simulations of a group that was answered together send their next requests within about a
millisecond. Without a wait, the first request would start a batch alone, and the others would wait
for it. From then on, the group would be split into two batches, each of which waits for the other
batch. Therefore the first request waits for the other requests, under these conditions:

- The queue only waits for sessions of the last batch whose recent return time is about the time
  that has passed since that batch. After a session was late, the queue does not wait for it again
  until it has returned in time once.
- The wait is at most `patience` times the duration of the last batch. It is also at most the time
  that one batch saves compared with two: the fixed cost of a batch, estimated from the durations of
  the last batches.
- No robot waits for simulations, the wait endangers no deadline, and the waiting requests do not
  fill the batch.

Robots that send the next request as soon as they are answered, such as robots that are behind their
rate, are split in the same way, and each of their acts then takes two batches. Therefore they wait
for one another for at most the time that one batch saves compared with two, and at most half of the
last batch. Robots whose usual return time is longer than this limit act at their own rate: they do
not wait, and other robots do not wait for them. A single session never waits.
"""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from typing import Any

from vlagents_ray.protocol.messages import Priority
from vlagents_ray.serve.queue.fair_queue import FairQueue
from vlagents_ray.serve.queue.robots_load import CostCurve
from vlagents_ray.serve.requests import PendingRequest

_KEPT = 0.95  # factor by which the weight of a batch decreases with each later batch
_SPREAD = 0.01  # variance of the batch sizes below which the fixed cost cannot be estimated
_NEWEST = 0.25  # weight of the last batch in the mean duration of batches
_NEWEST_OF_SIZE = 0.1  # weight of the last batch in the mean duration of the batches of one size
# Number of batches after which the curve of durations is computed again, unless a batch has a new
# size.
_CURVE_BATCHES = 32
# Longest wait of robots for one another, as a share of the last batch's duration. One batch usually
# saves less than that; the limit matters while the fixed cost is not known. It is larger than
# `patience`, since eight robots of one process return within 30 ms.
_ROBOTS = 0.5
SLOW_S = 0.002  # a shorter batch ends before a wait could pay off, or another thread could wake up


class _AnsweredBatch:
    """The sessions of a batch by priority, and the recent return time of each, s; None if it is
    unknown.

    The return time of a session is the time from an answer to its next request.
    """

    def __init__(self, batch: Sequence[PendingRequest]) -> None:
        self.returns: dict[Priority, dict[str, float | None]] = {
            priority: {} for priority in Priority
        }
        for pending in batch:
            if pending.request.op in ("act", "reset"):
                self.returns[pending.priority][pending.session_id] = pending.return_s
        self.lone = batch[0].session_id if len(batch) == 1 else ""
        self.acts = len(batch) if all(pending.request.op == "act" for pending in batch) else 0
        self.ended = math.inf  # s


class BatchCost:
    """The measured durations of batches over their sizes; older batches have less weight.

    They consist of a weighted linear fit and of the mean for each size, since a compiled policy
    pads a batch to the next size for which it is compiled.
    """

    def __init__(self) -> None:
        self._sums = (0.0, 0.0, 0.0, 0.0, 0.0)
        self._means_s: dict[int, float] = {}  # mean duration by size, s

    def add(self, size: int, duration: float) -> bool:
        """Add a batch of `size` observations that took `duration` s; return whether it is the first
        one of its size.
        """
        new = (1.0, size, duration, size * size, size * duration)
        self._sums = tuple(  # type: ignore[assignment]
            _KEPT * total + term for total, term in zip(self._sums, new, strict=True)
        )
        is_new = size not in self._means_s
        mean_s = self._means_s.get(size, duration)
        self._means_s[size] = mean_s + _NEWEST_OF_SIZE * (duration - mean_s)
        return is_new

    def fixed_s(self) -> float:
        """Return the fixed cost of a batch, s; `inf` until batches of different sizes were
        added.
        """
        line = self.line()
        return math.inf if line is None else line[0]

    def curve(self, largest: int) -> CostCurve | None:
        """Return the durations up to batches of size `largest`; None if no batch was added.

        Until a batch of the largest size, or of one row, has run, its duration is computed from the
        line. If all batches had one size, further rows count as free, and fewer rows as
        proportionally faster, until batches of other sizes show their cost.
        """
        if not self._means_s:
            return None
        durations_s = dict(self._means_s)
        line = self.line()
        if line is not None and largest not in durations_s:
            fixed_s, row_s = line
            durations_s[largest] = fixed_s + row_s * largest
        if 1 not in durations_s:
            smallest = min(self._means_s)
            most_s = durations_s[smallest]
            one_s = 0.0 if line is None else line[0] + line[1]
            durations_s[1] = min(max(most_s / smallest, one_s), most_s)

        table: list[tuple[int, float]] = []
        longest_s = 0.0
        for size, duration_s in sorted(durations_s.items()):
            # A larger batch never takes less time. If its mean is lower, there were too few batches
            # of its size.
            longest_s = max(longest_s, duration_s)
            table.append((size, longest_s))
        return CostCurve(table=tuple(table)) if table[0][1] > 0 else None

    def line(self) -> tuple[float, float] | None:
        """Return the fixed duration of a batch and the duration of a row, s; None until batches of
        different sizes were added.
        """
        count, size, duration, squares, products = self._sums
        spread = count * squares - size * size
        if spread <= _SPREAD * count * count:
            return None
        fixed_s = (duration * squares - size * products) / spread
        row_s = (count * products - size * duration) / spread
        return fixed_s, row_s


class BatchWindow:
    """Decides on the wait from the last two batches. Not thread-safe: its callers must hold a
    common lock.

    Args:
        patience: Longest wait, as a multiple of the duration of the last batch.
        size: Largest number of requests in a batch.
        sessions: Contains the ids of the sessions that exist.
    """

    def __init__(self, patience: float, size: int, sessions: Container[str]) -> None:
        self._patience, self._size, self._sessions = patience, size, sessions
        self._no_batch = _AnsweredBatch(())
        self._last = self._previous = self._no_batch
        self._duration = 0.0  # duration of the last batch, s
        self._mean_s = 0.0  # mean duration of recent batches, s
        # Whether batches take longer than `SLOW_S`; otherwise the window keeps no records.
        self.slow = False
        # Whether other threads should work on the next requests while a batch runs: batches are
        # slow, and the last two batches were not both for the same single session. If only one
        # batch is known, it must be for several sessions.
        self.overlaps = False
        self._cost = BatchCost()
        self._until_curve = 0  # number of batches until the curve is computed again
        self._curve: CostCurve | None = None  # the measured durations of slow batches
        # Durations by size, from 0 to the largest size, for `FairQueue`; empty if there is no
        # curve.
        self.costs_s: Sequence[float] = ()
        self._missing: set[str] = set()
        self._priority = Priority.SIMULATION  # priority of the missing sessions
        self._bound = self._until = 0.0  # the longest wait, s, and the time at which it ends, s

    def record_start(self, batch: Sequence[PendingRequest]) -> None:
        """Record that a batch begins."""
        last = _AnsweredBatch(batch) if self.slow else self._no_batch
        previous = self._last
        self._previous, self._last = previous, last

        is_one_session = last.lone != "" and (
            previous is self._no_batch or previous.lone == last.lone
        )
        self.overlaps = self.slow and not is_one_session

    def record_end(self, now: float, duration: float) -> None:
        """Record that the batch ended at `now`, s, after `duration` s."""
        self._mean_s += _NEWEST * (duration - self._mean_s)
        self.slow = self._mean_s > SLOW_S
        self._last.ended, self._duration = now, duration
        if self._last.acts:
            is_new = self._cost.add(self._last.acts, duration)
            self._until_curve -= 1
            if is_new or self._until_curve < 0:
                self._draw_curve()

    def curve(self) -> CostCurve | None:
        """Return the measured durations of batches; None if there were no batches.

        A policy whose batches are not slow has one duration for all sizes.
        """
        if self._curve is None and self._mean_s > 0:
            return CostCurve(fixed_s=self._mean_s)
        return self._curve

    def describe_costs(self) -> dict[str, Any] | None:
        """Return the measured durations for the metadata, ms by batch size, with the fixed duration
        and the duration of a row; None if there were no slow batches.
        """
        if self._curve is None:
            return None
        line = self._cost.line()
        fixed_ms, row_ms = (None, None) if line is None else (1e3 * line[0], 1e3 * line[1])
        table = {str(size): 1e3 * duration_s for size, duration_s in self._curve.table}
        return {"fixed_ms": fixed_ms, "row_ms": row_ms, "ms_by_size": table}

    def _draw_curve(self) -> None:
        """Compute the curve of durations again."""
        self._curve = self._cost.curve(self._size)
        if self._curve is None:
            return
        self._until_curve = _CURVE_BATCHES
        self.costs_s = [0.0, *(self._curve.cost_s(size) for size in range(1, self._size + 1))]

    def record_arrival(self, pending: PendingRequest) -> None:
        """Estimate the return time of the session that sent the request.

        A longer time replaces the estimate immediately; a shorter time reduces the estimate by half
        the difference.
        """
        for answered in (self._last, self._previous):
            returns = answered.returns[pending.priority]
            if pending.session_id in returns:
                usual = returns.pop(pending.session_id)
                took = max(0.0, pending.arrived - answered.ended)
                pending.return_s = took if usual is None or took > usual else (took + usual) / 2
                return

    def wait_s(self, now: float, waiting: FairQueue) -> float:
        """Return how long the free policy may wait for further requests, s; every `put` then
        calls `ends_wait`.
        """
        self._priority = Priority.ROBOT if waiting.depth[Priority.ROBOT] else Priority.SIMULATION
        robots = self._priority is Priority.ROBOT
        patience = max(_ROBOTS, self._patience) if robots and self._patience else self._patience
        bound = self._bound = min(patience * self._duration, self._cost.fixed_s())
        if bound <= 0 or not self.slow or waiting.sessions >= self._size:
            return 0.0

        self._missing = {
            session_id
            for session_id, return_s in self._last.returns[self._priority].items()
            if return_s is not None
            and abs(self._last.ended + return_s - now) <= bound
            and not (robots and return_s > bound)
            and session_id not in waiting
            and session_id in self._sessions
        }

        self._until = now + bound
        if not self._missing or any(self._must_not_wait(pending) for pending in waiting.heads()):
            return 0.0
        return bound

    def ends_wait(self, pending: PendingRequest, waiting: FairQueue) -> bool:
        """Return whether the arrival of this request ends the wait."""
        self._missing.discard(pending.session_id)
        return not self._missing or waiting.sessions >= self._size or self._must_not_wait(pending)

    def _must_not_wait(self, pending: PendingRequest) -> bool:
        """Return whether a request prevents the wait, because of its robot or its deadline. A
        deadline prevents the wait if it would pass during the wait and a following batch as long as
        the last batch.
        """
        if pending.priority is Priority.ROBOT:
            at_once = pending.return_s is not None and pending.return_s <= self._bound
            if self._priority is not Priority.ROBOT or not at_once:
                return True
        return pending.deadline < self._until + self._duration
