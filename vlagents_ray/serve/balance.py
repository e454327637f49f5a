"""Sessions spread over the replicas: new ones go to the least loaded, and an uneven rest is sent on.

A connection of shared memory, plasma, a WebSocket or a Serve handle stays at its replica for as long as
it lasts, so that a replica that joins would help nobody who is there. Hence each replica compares its
sessions with the others' every few seconds, and tells some connections to connect anew if it holds
clearly more than its share; their sessions follow as they do when a replica stops (`vlagents_ray.serve.moving`).
HTTP sessions go where the load balancer's hash sends them.
"""

from __future__ import annotations

import logging
import random
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Protocol

from vlagents_ray.serve.engine import Engine
from vlagents_ray.serve.spread import Load, Place, choose, pick, surplus

logger = logging.getLogger(__name__)

PERIOD_S = 3.0  # between two comparisons
MOVABLE = ("shm", "plasma", "websocket", "handle")
_EXPECTED_S = 3.0  # a client that was sent here and has not come since does not come
_SETTLE_S = 6.0  # a connection that was told counts as leaving for so long
_REST_S = 20.0  # a connection is told at most once in this time
_ACTIVE_S = 30.0  # only a session that asks can be told
_AT_ONCE = 32  # sessions to send away after one comparison, at most


class Neighbours(Protocol):
    """The other replicas of the application: `vlagents_ray.serve.peers.Peers`."""

    def loads(self) -> list[Load]:
        """Of those that answer at once."""
        ...

    def invite(self, replica: str) -> Any:
        """Tell one of them that a client is sent there. Does not wait; returns what is to be waited for."""
        ...


class Balance:
    """One replica's part in it."""

    def __init__(self, engine: Engine, neighbours: Neighbours, own: Callable[[int], Load]) -> None:
        """`own` makes this replica's `Load` of its number of sessions."""
        self._engine = engine
        self._neighbours = neighbours
        self._own = own
        self._expected: deque[float] = deque()  # when a client was sent here that has opened no session yet
        self._opened = 0
        self._others: list[Load] = []
        self._asked = float("-inf")
        self._uneven = False  # the last time, too
        self._lock = threading.Lock()
        self._one = ThreadPoolExecutor(1, thread_name_prefix="balance")  # so that clients that come at once wait
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._loop, name="rebalance", daemon=True)

    def start(self) -> None:
        """Compare from now on."""
        self._thread.start()

    def close(self) -> None:
        """End the comparisons."""
        self._stop.set()
        self._one.shutdown(wait=False, cancel_futures=True)

    def load(self) -> Load:
        """Of this replica, at this moment."""
        with self._lock:
            opened = self._engine.sessions.opened
            came, self._opened = opened - self._opened, opened
            oldest = time.monotonic() - _EXPECTED_S
            while self._expected and (came > 0 or self._expected[0] < oldest):
                self._expected.popleft()
                came -= 1
            return self._own(len(self._engine.sessions) + len(self._expected))

    def expect(self) -> None:
        """A client was sent here."""
        self.load()
        with self._lock:
            self._expected.append(time.monotonic())

    def place(self, place: Place) -> Future[Any]:
        """What `Neighbours.invite` returned of the replica that suits a client best; None if that is this one."""
        return self._one.submit(self._place, place, time.monotonic())

    def _place(self, place: Place, came: float) -> Any:
        if came > self._asked:  # clients that came while the others were asked cost no question more
            try:
                self._others = self._neighbours.loads()
            except Exception:  # a client connects whatever is wrong with the others
                logger.exception("the other replicas could not be asked")
                self._others = []
            self._asked = time.monotonic()
        mine = self.load()
        loads = [mine, *self._others]
        random.shuffle(loads)  # of equally loaded ones each client of each replica takes any
        chosen = choose(loads, place)
        if chosen is None:
            return None
        if chosen is mine:
            self.expect()
            return None
        chosen.sessions += 1  # until it is asked again
        return self._neighbours.invite(chosen.replica)

    def _loop(self) -> None:
        while not self._stop.wait(random.uniform(0.8, 1.2) * PERIOD_S):
            try:
                self.compare()
            except Exception:
                logger.exception("sessions were not compared")

    def compare(self) -> None:
        """With the others; mark what shall go, if there were too many the last time, too."""
        leavers, sessions = self._engine.leavers, self._engine.sessions
        leavers.forget_older(_REST_S)
        sessions.drop_idle()
        mine = self.load()
        too_many = 0
        active = sessions.by_connection(MOVABLE, _ACTIVE_S)
        told = leavers.told_within(_SETTLE_S)
        if mine.sessions > 1 and mine.accepts:  # nobody has one too many
            others = [load for load in self._neighbours.loads() if load.accepts]
            if others and all(load.version == mine.version for load in others):
                gone = sum(count for group, count in active.items() if group in told)
                too_many = surplus(mine.sessions, [load.sessions for load in others], gone)
        if too_many <= 0 or not self._uneven:
            leavers.mark(set())
        else:
            lately = leavers.told_within(_REST_S)
            groups = [group for group in active if group not in lately]
            chosen = pick([active[group] for group in groups], min(too_many, _AT_ONCE))
            leavers.mark({groups[index] for index in chosen})
            logger.info("%d sessions, %d more than a fair share: sending some away", mine.sessions, too_many)
        self._uneven = too_many > 0
