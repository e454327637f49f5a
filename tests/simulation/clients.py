"""Robots of the simulation: what each asked, what it was told, and whether that can be true."""

from __future__ import annotations

import asyncio

from tests.simulation.world import LENGTH_S, World, code
from vlagents_ray import Obs
from vlagents_ray.protocol.messages import Reply
from vlagents_ray.serve.scaling import session_migration

_UNCERTAIN = ("silence", "outcome_unknown", "connection_lost")
_NOT_DONE = ("deadline_exceeded", "unavailable")


PATIENCE_S = 4.5  # more than a request, and some messages between replicas, take on their way


class Violation(AssertionError):
    """What must not happen."""


class Robot:
    """One session, for a few episodes. With `steps` it sends back the step of the last answer.

    Without `steps` and with `gives_up` it sends no deadline, and begins its next episode when an
    answer does not come: over HTTP after longer than a message between replicas takes, or over a
    connection at once. Either way it closes the connection, to connect again elsewhere, and each
    act belongs to the episode in which it was sent.
    """

    def __init__(self, world: World, number: int) -> None:
        self.world = world
        self.name = f"robot{number}"
        draw = world.draw
        self.steps = draw.random() < 0.6
        self.timed = draw.random() < 0.5  # over HTTP; else as over a connection
        self.gives_up = not self.steps and draw.random() < 0.6
        self.link = world.connect() if self.gives_up and not self.timed else None
        # A fault may hold an HTTP request back until later ones have been executed elsewhere.
        self.strict = self.link is not None or (self.gives_up and not world.plan.rough)
        self.history: list[str] = []
        # Acts whose answer says that they were not executed, and never will be.
        self.refused: list[str] = []
        self.done: list[str] = []  # acts that were answered with an action
        self.over = False
        self.uncertain: set[str] = set()  # acts and resets of which it does not know what became
        self._step: int | None = None
        self._asked = 0

    async def run(self) -> None:
        """Until its episodes are over, or the world is."""
        draw = self.world.draw
        for episode in range(draw.randint(1, 3)):
            await asyncio.sleep(draw.random() * 0.5)
            await self._episode(f"{self.name}/{episode}")
        self.over = True

    async def _episode(self, instruction: str) -> None:
        draw = self.world.draw
        while True:
            self._asked += 1
            instruction = f"{instruction}.{self._asked}"
            reply = await self._ask("reset", instruction, None)
            if code(reply) == "ok":
                break
            if code(reply) in _UNCERTAIN:
                self.uncertain.add(instruction)
            self._reconnect(reply)
            await asyncio.sleep(0.1)
        # An answer to a reset does not wait for the slowest of messages to the other replicas.
        if self.gives_up:
            await asyncio.sleep(max(0.0, self.world.plan.latest_s - session_migration._OTHERS_S))
        acted: list[str] = []  # that it was told of
        for _ in range(draw.randint(2, 6)):
            await asyncio.sleep(draw.random() * (3.0 if self.gives_up else 0.4))
            self._asked += 1
            name = f"{self.name}.{self._asked}"
            reply = await self._ask("act", instruction, name)
            outcome = code(reply)
            self._reconnect(reply)
            if outcome == "ok" and reply is not None:
                self.done.append(name)
                self._check(reply, instruction, [*acted, name])
                acted.append(name)
            elif outcome in _NOT_DONE:
                self.refused.append(name)
            elif outcome in _UNCERTAIN:
                self.uncertain.add(name)
                if self.steps or self.gives_up:
                    return  # where it is now is not known: another episode
            else:
                if not self.world.plan.rough and not self._excuses():
                    raise Violation(
                        f"{name}: {outcome} ({reply and reply.error}), though nothing was lost: a "
                        "session was"
                    )
                return

    def _excuses(self) -> set[str]:
        """Requests that may come late and end its episode: over connections that it has closed,
        only resets.
        """
        return {name for name in self.uncertain if self.link is None or "/" in name}

    def _reconnect(self, reply: Reply | None) -> None:
        """Elsewhere, if the connection is silent, or its replica stops."""
        if self.link is not None and (
            reply is None or reply.draining or code(reply) == "unavailable"
        ):
            self.link.end()
            self.link = self.world.connect()

    def _check(self, reply: Reply, instruction: str, expected: list[str]) -> None:
        obeyed, ids = reply.act.info["obeys"], reply.act.info["ids"]
        if not obeyed.startswith(self.name + "/"):
            raise Violation(f"{expected[-1]}: crossed with another session, it obeys {obeyed}")
        if not (self.steps or self.strict) and (self.uncertain or self.world.plan.rough):
            # What it gave up may come late, and what a fault left behind may be met: steps are for
            # that.
            return
        if obeyed != instruction:
            raise Violation(
                f"{expected[-1]}: of an older episode, it obeys {obeyed}, not {instruction}"
            )
        if [one for one in ids if one not in self.uncertain] != expected:
            raise Violation(
                f"{expected[-1]}: acts were lost or doubled: {ids}, want {expected} and some of "
                f"{self.uncertain}"
            )

    async def _ask(self, op: str, instruction: str, name: str | None) -> Reply | None:
        """The answer, if it comes in time."""
        draw = self.world.draw
        deadline_s = None if self.gives_up else draw.choice([0.05, 0.5, 3.0, None])
        answer = self.world.send(
            op,  # type: ignore[arg-type]
            self.name,
            Obs(info={"id": name, "of": instruction if self.strict else None}),
            link=self.link,
            # Without a step, only the clocks say which of two replicas has the newer episode.
            steady=not (self.steps or (self.gives_up and self.world.clocks_agree)),
            timed=self.timed,
            instruction=instruction if op == "reset" else None,
            step=self._step if self.steps else None,
            deadline_ms=None if deadline_s is None else deadline_s * 1e3,
            request_id=name or instruction,
        )
        if self.gives_up:
            patience_s = draw.choice([0.05, 0.5, 3.0]) if self.link is not None else PATIENCE_S
        else:
            patience_s = 20.0 if deadline_s is None else deadline_s + draw.choice([0.0, 12.0])
        await asyncio.wait([answer], timeout=patience_s)
        reply = answer.result() if answer.done() else None
        if reply is None and self.gives_up:
            answer.cancel()
        if reply is not None and reply.step is not None and reply.error is None:
            self._step = reply.step
        self.history.append(
            f"{self.world.clock.now:8.3f} {op} {name or instruction}: {code(reply)}"
        )
        return reply


def play(world: World) -> list[Robot]:
    """Run a world with its robots to the end; `Violation` if a history cannot be."""
    robots = [Robot(world, number) for number in range(world.draw.randint(2, 3))]
    tasks = [world.outside.create_task(robot.run()) for robot in robots]
    try:
        world.clock.run(LENGTH_S, lambda: all(task.done() for task in tasks))
        for task in tasks:
            if task.done():
                task.result()
        if world.clock.errors:
            raise world.clock.errors[0]
        names = [name for name, _, _ in world.log.acts]
        executed = set(names)
        if len(executed) < len(names):
            raise Violation(
                f"executed twice: {sorted(name for name in executed if names.count(name) > 1)}"
            )
        for robot in robots:
            if late := executed.intersection(robot.refused):
                raise Violation(
                    f"executed, though answered with that they never would be: {sorted(late)}"
                )
            if unheard := set(robot.done) - executed:
                raise Violation(f"answered, but never executed: {sorted(unheard)}")
        for name, obeyed, sent_in in world.log.acts:
            if sent_in is not None and sent_in != obeyed:
                raise Violation(f"{name}: sent in episode {sent_in}, executed in {obeyed}")
            if name.partition(".")[0] != obeyed.partition("/")[0]:
                raise Violation(f"{name}: crossed with another session, it obeyed {obeyed}")
    finally:
        world.close()
    return robots
