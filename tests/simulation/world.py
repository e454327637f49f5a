"""Replicas, a network and clients in one thread under a virtual clock, with faults drawn from a
seed.

The queue, the sessions, the engine, the moves between replicas and `Sender` are the real ones. A
replica's thread, its event loop and Ray's calls between replicas are simulated. The duration of a
batch is random. A message is late, arrives twice or out of order, or waits until a partition heals.
A replica starts late, stops, or is killed or frozen. Clocks differ, and are changed.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from in_flight import ask, send

from tests.simulation.virtual_time import Clock, Loop
from vlagents_ray import Act, Agent, Obs
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.protocol.messages import Op, Reply, Request
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import Sender
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.queue.batch_queue import Taken
from vlagents_ray.serve.scaling.session_migration import Peer, PeerEnded, SessionMigrator

LENGTH_S = 60.0  # maximum length of a world
_EPOCH_NS = 1_700_000_000 * 10**9


class Log:
    """The policy's acts: their ids in order, the instruction of the session, and the instruction
    that the client meant.
    """

    def __init__(self) -> None:
        self.acts: list[tuple[str, str, str | None]] = []


class Remembering(Agent):
    """A policy that answers each act with the ids of all acts of its session since the reset."""

    shared = ("log",)

    def __init__(self, log: Log) -> None:
        self.log = log

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.instruction, self.ids = instruction or "", ()
        return {}

    def act(self, obs: Obs) -> Act:
        self.ids = (*self.ids, obs.info["id"])
        self.log.acts.append((obs.info["id"], self.instruction, obs.info["of"]))
        return Act(_ACTION, info={"obeys": self.instruction, "ids": self.ids})


_ACTION = np.zeros(1, np.float32)


class _NoFiles:
    """Replaces the poller on which the queue's thread waits: when a request waits, the replica runs
    its next batch.
    """

    def __init__(self, wake: Callable[[], None]) -> None:
        self.wake = wake

    def hand_to_reader(self) -> None:
        pass

    reclaim = close = hand_to_reader


class Replica:
    """A process with a policy."""

    def __init__(self, world: World, number: int) -> None:
        self.world = world
        self.name = f"replica {number}"
        self.loop = Loop(world.clock)
        self.clock_error_s = world.draw.choice(world.plan.clock_errors_s)
        # Time before which neither clients nor other replicas know the replica. The first replica
        # starts with the world.
        self.starts = world.draw.choice(world.plan.starts) if number else 0.0
        self.slowness = world.draw.choice(world.plan.slowness)
        self.draining = False
        self.cut_off_until = 0.0
        self._busy = False
        self.migrator = SessionMigrator(self.name, self._others, self.loop, _at_once)
        self.engine = Engine(
            Remembering(world.log),
            EngineSettings(max_batch_size=4, threaded=False),
            clock=lambda: world.clock.now,
            wall_clock=lambda: _EPOCH_NS + int((world.clock.now + self.clock_error_s) * 1e9),
            poller=_NoFiles(self._wake),  # type: ignore[arg-type]
            finder=self.migrator,
        )
        self.migrator.start(self.engine)
        self.engine.start()

    @property
    def alive(self) -> bool:
        """Whether the process is alive, although it may be frozen."""
        return not self.loop.ended

    @property
    def is_known(self) -> bool:
        """Whether the other replicas know this replica."""
        return self.alive and self.world.clock.now >= self.starts

    @property
    def is_ready(self) -> bool:
        """Whether the replica accepts clients."""
        return self.is_known and not self.draining

    async def _others(self) -> Sequence[Peer]:
        return [
            _Peer(self, other)
            for other in self.world.replicas
            if other is not self and other.is_known
        ]

    def _wake(self) -> None:
        self.loop.call_soon(self._turn)

    def _turn(self) -> None:
        """Run one turn of the policy's thread."""
        if self._busy:
            return
        batch, expired = self.engine.queue.take() or Taken([], [])
        self.engine.runner.run(Taken([], expired))
        if batch:
            self._busy = True
            draw = self.world.draw
            self.loop.call_later(
                self.slowness * draw.random() ** 4 + 0.001, self._finish, Taken(batch, [])
            )
        elif self.engine.queue.depth():
            self._wake()

    def _finish(self, taken: Taken) -> None:
        self.engine.runner.run(taken)
        self._busy = False
        self._turn()

    def receive(
        self, request: Request, session_id: str, answer: Callable[[list[Reply]], None], timed: bool
    ) -> Callable[[], Any]:
        """Receive a client's request: with `timed` like over HTTP, otherwise like over a
        connection, where only the queue checks deadlines.

        Returns the function that is called when the connection ends.
        """
        sender = Sender(
            self.engine, "http", session_id, connected=False, caller=NoKey.OPEN, has_left=None
        )
        if timed:
            task = self.loop.create_task(ask(sender, [request]))
            task.add_done_callback(lambda done: None if done.cancelled() else answer(done.result()))
            return task.cancel
        send(sender, [request], answer)
        return lambda: None


class Link:
    """A client's connection to one replica. Messages arrive in order, and the end of the connection
    arrives last.
    """

    def __init__(self, world: World, replica: Replica) -> None:
        self.replica = replica
        self._world = world
        self._sender = Sender(replica.engine, "websocket", caller=NoKey.OPEN, has_left=None)
        self._latest = 0.0  # time at which the last message arrives

    def carry(self, deliver: Callable[[], None]) -> None:
        """Deliver to the replica if it is still alive."""
        self._latest = max(self._latest + 1e-6, self._world.arrival(None, self.replica))
        loop = self.replica.loop if self.replica.alive else self._world.outside
        loop.call_at(self._latest, lambda: deliver() if self.replica.alive else None)

    def send(self, request: Request, answer: Callable[[list[Reply]], None]) -> None:
        """Send a request of one of its sessions."""
        self.carry(lambda: send(self._sender, [request], answer) and None)

    def end(self) -> None:
        """Close the connection."""
        self.carry(self._sender.release)


class _Peer(Peer):
    """One replica as another replica sees it: through messages."""

    def __init__(self, me: Replica, other: Replica) -> None:
        self.name = other.name
        self._me = me
        self._other = other

    async def ask(self, method: Any, *args: Any, **kwargs: Any) -> Any:
        me, other, world = self._me, self._other, self._me.world
        answer: asyncio.Future[Any] = me.loop.create_future()

        def deliver() -> None:
            if not other.alive:
                world.transport(other, me, partial(_settle, answer, None, PeerEnded(other.name)))
                return
            task = other.loop.create_task(getattr(other.migrator.sessions, method.__name__)(*args))
            task.add_done_callback(
                lambda done: world.transport(other, me, partial(_settle, answer, done.result()))
            )

        world.transport(me, other, deliver)
        if world.draw.random() < world.plan.twice:
            world.transport(me, other, deliver)
        world.watch(other, me, answer)
        return await answer


def _settle(answer: asyncio.Future[Any], result: Any, error: Exception | None = None) -> None:
    if not answer.done():
        if error is None:
            answer.set_result(result)
        else:
            answer.set_exception(error)


async def _at_once(call: Callable[..., Any], *args: Any) -> Any:
    return call(*args)


class Plan:
    """The faults that may occur in a world."""

    def __init__(self, draw: random.Random) -> None:
        self.rough = draw.random() < 0.4  # whether faults may end a session
        # Possible durations of a replica's batches in s.
        self.slowness = draw.choice([(0.02,), (0.02, 4.0), (0.02, 30.0)])
        self.late = draw.choice([0.0, 0.1, 0.3])  # share of late messages
        self.latest_s = draw.choice([0.2, 1.0])
        self.twice = draw.choice([0.0, 0.2])
        self.replicas = draw.choice([2, 2, 3])
        # Possible errors of a replica's clock at its start, and times at which it starts, s.
        self.clock_errors_s = draw.choice([(0.0,), (0.0, 1.0, 60.0, -3600.0)])
        self.starts = draw.choice([(0.0,), (0.0, 1.0, 2.0, 4.0)])
        # Share of requests that the load balancer sends to another replica.
        self.stray = draw.choice([0.0, 0.2])
        names = ["drain", "drain", "clock"] + (
            ["kill", "freeze", "partition"] if self.rough else []
        )
        self.faults = [
            (draw.uniform(0.0, 6.0), draw.choice(names)) for _ in range(draw.randint(1, 3))
        ]


class World:
    """The complete world of one seed. `spoil` may undo a fix in each replica."""

    def __init__(self, seed: int, spoil: Callable[[Replica], None] = lambda _: None) -> None:
        self.draw = random.Random(seed)
        self.clock = Clock()
        self.plan = Plan(self.draw)
        self.log = Log()
        self.outside = Loop(self.clock)  # the event loop of clients and network
        self.replicas = [Replica(self, number) for number in range(self.plan.replicas)]
        self.faults: list[str] = []  # the faults that occurred
        for replica in self.replicas:
            spoil(replica)
        for when, name in self.plan.faults:
            self.outside.call_at(when, self._fault, name)

    def delay_s(self) -> float:
        """Return the delay of a message in s."""
        if self.draw.random() < self.plan.late:
            return self.draw.random() * self.plan.latest_s
        return 0.0005 + 0.004 * self.draw.random()

    def transport(
        self, source: Replica | None, target: Replica | None, deliver: Callable[[], None]
    ) -> None:
        """Carry a message. A message from or to a replica that is cut off waits until the replica
        can be reached again.
        """
        if source is not None and not source.alive:
            return
        when = self.arrival(source, target)
        (self.outside if target is None or not target.alive else target.loop).call_at(when, deliver)

    def connect(self) -> Link:
        """Return a client's connection to any replica that accepts it."""
        ready = [replica for replica in self.replicas if replica.is_ready] or self.replicas
        return Link(self, self.draw.choice(ready))

    def arrival(self, source: Replica | None, target: Replica | None) -> float:
        """Return the arrival time of a message that is sent now."""
        when = self.clock.now + self.delay_s()
        for end in (source, target):
            if end is not None and end.cut_off_until > when:
                when = end.cut_off_until + self.delay_s()
        return when

    def watch(self, other: Replica, me: Replica, answer: asyncio.Future[Any]) -> None:
        """Notify the caller of a replica's end a moment later, even if the replica had received the
        message.
        """

        def look() -> None:
            if not other.alive:  # earlier answers may still arrive
                me.loop.call_later(
                    2 * self.plan.latest_s, _settle, answer, None, PeerEnded(other.name)
                )
            elif not answer.done():
                me.loop.call_later(0.5, look)

        me.loop.call_later(0.5, look)

    def route(self, session_id: str, steady: bool) -> Replica:
        """Return the replica to which the load balancer sends a request: by its session, and
        sometimes another one unless `steady`.
        """
        ready = [one for one in self.replicas if one.is_ready] or self.replicas
        if not steady and self.draw.random() < self.plan.stray:
            return self.draw.choice(ready)
        return ready[sum(session_id.encode()) % len(ready)]

    def _fault(self, name: str) -> None:
        ready = [one for one in self.replicas if one.is_ready]
        if not ready:
            return
        replica = self.draw.choice(ready)
        if name == "drain" and len(ready) > 1:
            replica.draining = True
            replica.engine.drain_list.drain()
            replica.loop.call_later(self.draw.uniform(0.1, 0.5), self._stop, replica)
        elif name == "clock":
            replica.clock_error_s += self.draw.choice([-3600.0, -1.0, 1.0, 3600.0])
        elif name == "kill" and len(ready) > 1:
            replica.loop.close()
        elif name == "freeze":
            replica.loop.frozen_until = self.clock.now + self.draw.uniform(0.5, 8.0)
        elif name == "partition":
            replica.cut_off_until = self.clock.now + self.draw.uniform(0.5, 8.0)
        else:
            return
        self.faults.append(name)

    def _stop(self, replica: Replica) -> None:
        async def stop() -> None:
            await replica.migrator.hand_over()
            await asyncio.sleep(2.0)  # time for its last answers
            replica.loop.close()

        replica.loop.create_task(stop())

    def send(
        self,
        op: Op,
        session_id: str,
        obs: Obs,
        *,
        link: Link | None,
        steady: bool,
        timed: bool,
        **fields: Any,
    ) -> asyncio.Future[Reply]:
        """Send a client's request and return its answer, which may never arrive. A client that
        cancels the wait closes its connection.
        """
        answer: asyncio.Future[Reply] = self.outside.create_future()
        replica = self.route(session_id, steady) if link is None else link.replica

        def answered(replies: list[Reply]) -> None:
            self.transport(replica, None, partial(_settle, answer, replies[0]))

        def deliver() -> None:
            if replica.alive:
                end = replica.receive(Request(op, obs, **fields), session_id, answered, timed)
                answer.add_done_callback(
                    lambda done: self.transport(None, replica, end) if done.cancelled() else None
                )

        if link is None:
            self.transport(None, replica, deliver)
        else:
            link.send(Request(op, obs, session=session_id, **fields), answered)
        return answer

    def close(self) -> None:
        """End all processes."""
        for replica in self.replicas:
            replica.loop.close()
        self.outside.close()


def code(reply: Reply | None) -> str:
    """Return the outcome of a request: "ok", an error's code, or "silence"."""
    if reply is None:
        return "silence"
    error: VLAgentsError | None = reply.error
    return "ok" if error is None else error.code
