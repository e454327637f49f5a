"""Replicas, a network and clients in one thread under a virtual clock, and the faults that a seed
has for them.

The queue, the sessions, the engine, the moves between replicas and `Sender` are the real ones. What
a replica's thread, its event loop and Ray's calls between replicas do is run here: a batch takes
a time that is drawn, a message is late, comes twice or out of order, or waits until a partition
heals; a replica stops, is killed or frozen; clocks are set.
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

LENGTH_S = 60.0  # length of a world, at most
_EPOCH_NS = 1_700_000_000 * 10**9


class Log:
    """What the policy did: the ids of the acts, in order, with what the session obeyed, and what
    the client meant.
    """

    def __init__(self) -> None:
        self.acts: list[tuple[str, str, str | None]] = []


class Remembering(Agent):
    """Answers each act with all that its session has acted on since its reset."""

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
    """In place of what the queue's thread waits on: has the replica take its turn when something
    waits.
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
        self.clock_error_s = 0.0
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
        """Is it there, if perhaps frozen?"""
        return not self.loop.ended

    async def _others(self) -> Sequence[Peer]:
        return [
            _Peer(self, other) for other in self.world.replicas if other is not self and other.alive
        ]

    def _wake(self) -> None:
        self.loop.call_soon(self._turn)

    def _turn(self) -> None:
        """Of the policy's thread."""
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
        """A client's request: `timed` as over HTTP, else as over a connection, where only the queue
        knows deadlines.

        Returns what the end of its connection does.
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
    """A client's connection to one replica: what is sent arrives in order, and last that it has
    ended.
    """

    def __init__(self, world: World, replica: Replica) -> None:
        self.replica = replica
        self._world = world
        self._sender = Sender(replica.engine, "websocket", caller=NoKey.OPEN, has_left=None)
        self._latest = 0.0  # time at which the last message arrives

    def carry(self, deliver: Callable[[], None]) -> None:
        """To the replica, if it still lives."""
        self._latest = max(self._latest + 1e-6, self._world.arrival(None, self.replica))
        loop = self.replica.loop if self.replica.alive else self._world.outside
        loop.call_at(self._latest, lambda: deliver() if self.replica.alive else None)

    def send(self, request: Request, answer: Callable[[list[Reply]], None]) -> None:
        """A request of one of its sessions."""
        self.carry(lambda: send(self._sender, [request], answer) and None)

    def end(self) -> None:
        """Close it."""
        self.carry(self._sender.release)


class _Peer(Peer):
    """One replica as another one sees it: by messages."""

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
    """What may happen in a world."""

    def __init__(self, draw: random.Random) -> None:
        self.rough = draw.random() < 0.4  # with faults that may end a session
        # S that a batch may take, of a replica.
        self.slowness = draw.choice([(0.02,), (0.02, 4.0), (0.02, 30.0)])
        self.late = draw.choice([0.0, 0.1, 0.3])  # share of messages
        self.latest_s = draw.choice([0.2, 1.0])
        self.twice = draw.choice([0.0, 0.2])
        self.replicas = draw.choice([2, 2, 3])
        # Share of requests that the load balancer sends elsewhere.
        self.stray = draw.choice([0.0, 0.2])
        names = ["drain", "drain", "clock"] + (
            ["kill", "freeze", "partition"] if self.rough else []
        )
        self.faults = [
            (draw.uniform(0.0, 6.0), draw.choice(names)) for _ in range(draw.randint(1, 3))
        ]


class World:
    """All of it, for one seed. `spoil` may undo a fix in each replica."""

    def __init__(self, seed: int, spoil: Callable[[Replica], None] = lambda _: None) -> None:
        self.draw = random.Random(seed)
        self.clock = Clock()
        self.plan = Plan(self.draw)
        self.log = Log()
        self.outside = Loop(self.clock)  # of clients and network
        self.replicas = [Replica(self, number) for number in range(self.plan.replicas)]
        self.faults: list[str] = []  # that happened
        for replica in self.replicas:
            spoil(replica)
        for when, name in self.plan.faults:
            self.outside.call_at(when, self._fault, name)

    @property
    def clocks_agree(self) -> bool:
        """Has no replica's clock been set?"""
        return not any(replica.clock_error_s for replica in self.replicas)

    def delay_s(self) -> float:
        """Of a message."""
        if self.draw.random() < self.plan.late:
            return self.draw.random() * self.plan.latest_s
        return 0.0005 + 0.004 * self.draw.random()

    def transport(
        self, source: Replica | None, target: Replica | None, deliver: Callable[[], None]
    ) -> None:
        """Carry a message. What leaves a replica that is cut off, or is for one, waits until it
        is not.
        """
        if source is not None and not source.alive:
            return
        when = self.arrival(source, target)
        (self.outside if target is None or not target.alive else target.loop).call_at(when, deliver)

    def connect(self) -> Link:
        """A client's connection to any replica that accepts one."""
        ready = [
            replica for replica in self.replicas if replica.alive and not replica.draining
        ] or self.replicas
        return Link(self, self.draw.choice(ready))

    def arrival(self, source: Replica | None, target: Replica | None) -> float:
        """When a message arrives that is sent now."""
        when = self.clock.now + self.delay_s()
        for end in (source, target):
            if end is not None and end.cut_off_until > when:
                when = end.cut_off_until + self.delay_s()
        return when

    def watch(self, other: Replica, me: Replica, answer: asyncio.Future[Any]) -> None:
        """The caller hears of a replica's end a moment later, even if that had its message."""

        def look() -> None:
            if not other.alive:  # what it said before may still come
                me.loop.call_later(
                    2 * self.plan.latest_s, _settle, answer, None, PeerEnded(other.name)
                )
            elif not answer.done():
                me.loop.call_later(0.5, look)

        me.loop.call_later(0.5, look)

    def route(self, session_id: str, steady: bool) -> Replica:
        """Where the load balancer sends a request: by its session, and now and then elsewhere
        unless `steady`.
        """
        ready = [one for one in self.replicas if one.alive and not one.draining] or self.replicas
        if not steady and self.draw.random() < self.plan.stray:
            return self.draw.choice(ready)
        return ready[sum(session_id.encode()) % len(ready)]

    def _fault(self, name: str) -> None:
        ready = [one for one in self.replicas if one.alive and not one.draining]
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
            await asyncio.sleep(2.0)  # its last answers
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
        """A client's request; its answer may never come. A client that cancels the answer closes
        its connection.
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
        """End everything."""
        for replica in self.replicas:
            replica.loop.close()
        self.outside.close()


def code(reply: Reply | None) -> str:
    """What came of a request: "ok", an error's code, or "silence"."""
    if reply is None:
        return "silence"
    error: VLAgentsError | None = reply.error
    return "ok" if error is None else error.code
