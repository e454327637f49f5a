"""Whether a batch is worth a short wait for sessions that are about to come back. No threads, no clocks.

A group of simulations that was answered together comes back within a millisecond or so. Whoever is first
would start a batch alone, the others would wait for it, and from then on the group goes in two halves,
each of which waits for the other. So the first one waits for the others, but only

- for sessions of the batch before that lately took about as long to come back as it is now: one that
  was late is not waited for again before it has come back in time once more;
- for at most `patience` times as long as the batch before took, and not for longer than one batch in the
  place of two saves: the time that a batch takes whatever its size, by the durations of the last ones;
- while no robot waits, no slot of the batch is left empty by it, and no deadline is in danger.

So a lone session waits for nobody, and a robot never waits. Robots are not waited for.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from vlagents_ray.serve.waiting import Rank, Ticket, Waiting

_KEPT = 0.95  # of its weight a batch keeps with each that follows
_SPREAD = 0.01  # a smaller variance of the sizes tells nothing
_NEWEST = 0.25  # weight of the last batch in the mean of their durations
SLOW_S = 0.002  # a batch that takes less is over before anybody could be waited for, or another thread be awake


class _Answered:
    """The simulations of a batch, and how long each took to come back lately, s; None where that is not known."""

    def __init__(self, batch: Sequence[Ticket]) -> None:
        self.returns = {
            ticket.session_id: ticket.return_s
            for ticket in batch
            if ticket.rank is Rank.SIMULATION and ticket.request.op in ("act", "reset")
        }
        self.lone = batch[0].session_id if len(batch) == 1 else ""
        self.acts = len(batch) if all(ticket.request.op == "act" for ticket in batch) else 0
        self.ended = math.inf  # s


class Cost:
    """A line through the durations of the last batches over their sizes; what is older counts ever less."""

    def __init__(self) -> None:
        self._sums = (0.0, 0.0, 0.0, 0.0, 0.0)

    def add(self, size: int, duration: float) -> None:
        """A batch of `size` took so long, s."""
        new = (1.0, size, duration, size * size, size * duration)
        self._sums = tuple(_KEPT * old + one for old, one in zip(self._sums, new, strict=True))  # type: ignore[assignment]

    def fixed_s(self) -> float:
        """What a batch takes whatever its size; all the time in the world while all had the same."""
        count, size, duration, squares, products = self._sums
        spread = count * squares - size * size
        if spread <= _SPREAD * count * count:
            return math.inf
        return (duration * squares - size * products) / spread


class Returning:
    """What the queue knows of the last two batches. The caller sees to it that one thread at a time is in here."""

    def __init__(self, patience: float, size: int, is_open: Callable[[str], bool]) -> None:
        self._patience = patience
        self._size = size
        self._is_open = is_open
        self._nobody = _Answered(())
        self._last = self._before = self._nobody
        self._duration = 0.0  # s, of the last batch
        self._usual = 0.0  # s, lately
        self.slow = False  # do batches take long enough for anything to be done meanwhile? If not, this costs nothing
        self._cost = Cost()
        self._missing: set[str] = set()
        self._until = 0.0

    def taken(self, batch: Sequence[Ticket]) -> None:
        """A batch begins."""
        self._before, self._last = self._last, _Answered(batch) if self.slow else self._nobody

    def ended(self, now: float, duration: float) -> None:
        """It is over, after `duration` s."""
        self._usual += _NEWEST * (duration - self._usual)
        self.slow = self._usual > SLOW_S
        self._last.ended, self._duration = now, duration
        if self._last.acts:
            self._cost.add(self._last.acts, duration)

    @property
    def alone(self) -> bool:
        """Is the batch that was taken last for a single session, and was the one before for the same?"""
        return self._last.lone != "" and (self._before is self._nobody or self._before.lone == self._last.lone)

    def came(self, ticket: Ticket) -> None:
        """A request comes in: how long did its session take? A long time is believed at once, a short one by halves."""
        for answered in (self._last, self._before):
            if ticket.session_id in answered.returns:
                usual = answered.returns.pop(ticket.session_id)
                took = max(0.0, ticket.arrived - answered.ended)
                ticket.return_s = took if usual is None or took > usual else (took + usual) / 2
                return

    def wait_s(self, now: float, waiting: Waiting) -> float:
        """How long the policy, which is free, may wait for more than what waits; then every `put` asks `whole`."""
        bound = min(self._patience * self._duration, self._cost.fixed_s())
        if bound <= 0 or not self.slow or waiting.depth[Rank.ROBOT] or waiting.sessions >= self._size:
            return 0.0
        self._missing = {
            session_id
            for session_id, return_s in self._last.returns.items()
            if return_s is not None
            and abs(self._last.ended + return_s - now) <= bound
            and session_id not in waiting
            and self._is_open(session_id)
        }
        self._until = now + bound
        if not self._missing or any(self._endangered(ticket) for ticket in waiting.heads()):
            return 0.0
        return bound

    def whole(self, ticket: Ticket, waiting: Waiting) -> bool:
        """Is the wait over, now that this one came?"""
        self._missing.discard(ticket.session_id)
        return (
            not self._missing or ticket.rank is Rank.ROBOT or waiting.sessions >= self._size or self._endangered(ticket)
        )

    def _endangered(self, ticket: Ticket) -> bool:
        """May the deadline pass if the policy waits, and then takes as long as it took last?"""
        deadline_ms = ticket.request.deadline_ms
        return deadline_ms is not None and ticket.arrived + deadline_ms / 1e3 < self._until + self._duration
