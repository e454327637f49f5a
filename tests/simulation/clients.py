"""Robots of the simulation: their requests, the answers, and checks whether these answers are
possible.
"""

from __future__ import annotations

import asyncio

from tests.simulation.world import LENGTH_S, World, code
from vlagents_ray import Obs
from vlagents_ray.protocol.messages import Reply
from vlagents_ray.serve.scaling import session_migration

_UNCERTAIN = ("silence", "outcome_unknown", "connection_lost")
_NOT_DONE = ("deadline_exceeded", "unavailable")


PATIENCE_S = 4.5  # longer than a request and some messages between replicas take


class Violation(AssertionError):
    """A result that must not happen."""


class Robot:
    """One session with a few episodes. With `steps` it sends the step of the last answer in each
    request.

    Without `steps` and with `gives_up` it sends no deadline, and begins its next episode when an
    answer does not arrive. Over HTTP it waits for longer than a message between replicas takes;
    over a connection it begins at once. In both cases it closes the connection and connects to
    another replica, and each act belongs to the episode in which it was sent.
    """

    def __init__(self, world: World, number: int) -> None:
        self.world = world
        self.name = f"robot{number}"
        draw = world.draw
        self.steps = draw.random() < 0.6
        self.timed = draw.random() < 0.5  # whether it uses HTTP; otherwise it uses a connection
        self.gives_up = not self.steps and draw.random() < 0.6
        self.link = world.connect() if self.gives_up and not self.timed else None
        # A fault may delay an HTTP request until later requests have been executed at another
        # replica.
        self.strict = self.link is not None or (self.gives_up and not world.plan.rough)
        self.history: list[str] = []
        # Acts whose answer says that they were not and will never be executed.
        self.refused: list[str] = []
        self.done: list[str] = []  # acts that were answered with an action
        self.over = False
        self.uncertain: set[str] = set()  # acts and resets with an unknown outcome
        self._step: int | None = None
        self._asked = 0

    async def run(self) -> None:
        """Run until its episodes or the world have ended."""
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
        # The answer to a reset does not wait for the slowest messages to the other replicas.
        if self.gives_up:
            await asyncio.sleep(max(0.0, self.world.plan.latest_s - session_migration._OTHERS_S))
        acted: list[str] = []  # acts with an answer
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
                    # The state of the session is unknown, so the robot begins another episode.
                    return
            else:
                if not self.world.plan.rough and not self._excuses():
                    raise Violation(
                        f"{name}: {outcome} ({reply and reply.error}), although no fault "
                        "occurred: a session was lost"
                    )
                return

    def _excuses(self) -> set[str]:
        """Return the requests that may arrive late and end the episode. Over closed connections,
        only a reset can do this.
        """
        return {name for name in self.uncertain if self.link is None or "/" in name}

    def _reconnect(self, reply: Reply | None) -> None:
        """Connect to another replica if the connection is silent or its replica stops."""
        if self.link is not None and (
            reply is None or reply.draining or code(reply) == "unavailable"
        ):
            self.link.end()
            self.link = self.world.connect()

    def _check(self, reply: Reply, instruction: str, expected: list[str]) -> None:
        obeyed, ids = reply.act.info["obeys"], reply.act.info["ids"]
        if not obeyed.startswith(self.name + "/"):
            raise Violation(
                f"{expected[-1]}: mixed up with another session, whose instruction is {obeyed}"
            )
        if not (self.steps or self.strict) and (self.uncertain or self.world.plan.rough):
            # An abandoned request may arrive late, and a replica may have an old state after a
            # fault. Only steps prevent these cases.
            return
        if obeyed != instruction:
            raise Violation(
                f"{expected[-1]}: from an older episode: instruction {obeyed}, not {instruction}"
            )
        if [one for one in ids if one not in self.uncertain] != expected:
            raise Violation(
                f"{expected[-1]}: acts were lost or doubled: expected {expected} and some of "
                f"{self.uncertain}, got {ids}"
            )

    async def _ask(self, op: str, instruction: str, name: str | None) -> Reply | None:
        """Return the answer if it arrives in time."""
        draw = self.world.draw
        deadline_s = None if self.gives_up else draw.choice([0.05, 0.5, 3.0, None])
        answer = self.world.send(
            op,  # type: ignore[arg-type]
            self.name,
            Obs(info={"id": name, "of": instruction if self.strict else None}),
            link=self.link,
            steady=not (self.steps or self.gives_up),
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
    """Run a world with its robots to the end; raise `Violation` if a history is impossible."""
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
                    f"executed, although the answer said that they never would be: {sorted(late)}"
                )
            if unheard := set(robot.done) - executed:
                raise Violation(f"answered, but never executed: {sorted(unheard)}")
        for name, obeyed, sent_in in world.log.acts:
            if sent_in is not None and sent_in != obeyed:
                raise Violation(f"{name}: sent in episode {sent_in}, executed in {obeyed}")
            if name.partition(".")[0] != obeyed.partition("/")[0]:
                raise Violation(
                    f"{name}: mixed up with another session, whose instruction was {obeyed}"
                )
    finally:
        world.close()
    return robots
