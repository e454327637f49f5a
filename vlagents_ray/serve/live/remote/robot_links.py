"""The robots that let a human at the live page move them, and who holds each."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import Any

from vlagents_ray.client.steering import SILENT_S
from vlagents_ray.errors import MalformedMessage, shown

_WAIT_S = 1.0  # longest wait for a beat, after which the caller asks again
_WHY = 200  # most characters of a reason
_NAME = 200  # most characters of a session's name

Send = Callable[[dict[str, Any]], Awaitable[None]]
"""Sends a message to a robot."""


@dataclass(slots=True)
class Holder:
    """Who moves a robot."""

    hold: str
    by: str  # name of the key; empty without keys
    heard: float  # when the last command came, s of the clock


class RobotLink:
    """One robot's connection. Only for the event loop that serves it.

    Args:
        send: Sends a message to the robot.
        clock: The time, s.
    """

    def __init__(self, send: Send, clock: Callable[[], float] = time.monotonic) -> None:
        self._send, self._clock = send, clock
        self.holder: Holder | None = None
        self._said: dict[str, Any] = {"beat": -1}
        self._over: dict[str, str] = {}  # why a hold is over; the last one alone
        self._changed = asyncio.Event()

    async def take(self, hold: str, by: str) -> dict[str, Any]:
        """Let a human hold the robot; return `over` with the reason if somebody else does."""
        await self._expire()
        if self.holder is not None and self.holder.hold != hold:
            return {"over": f"{self.holder.by or 'somebody'} moves this robot; wait until it is given back"}
        self.holder = Holder(hold, by, self._clock())
        await self._send({"do": "begin", "hold": hold, "by": by})
        return {}

    async def forward(self, hold: str, message: dict[str, Any]) -> dict[str, Any]:
        """Send the holder's message to the robot; return `over` with the reason if he does not hold it any more."""
        if self.holder is None or self.holder.hold != hold:
            return self._gone(hold)
        self.holder.heard = self._clock()
        if message["do"] != "move":
            self._end(hold, "given back")
        await self._send({**message, "hold": hold})
        return {}

    async def next(self, hold: str, after: int) -> dict[str, Any]:
        """Wait for a beat of the robot after that number.

        Returns:
            What the robot says of the hold, `over` with the reason if it has ended, or nothing after a second.
        """
        if self.holder is not None and self.holder.hold == hold and self._said["beat"] <= after:
            try:
                await asyncio.wait_for(self._changed.wait(), _WAIT_S)
            except asyncio.TimeoutError:
                return {}
        if self.holder is None or self.holder.hold != hold:
            return self._gone(hold)
        known = self._said.get("hold") == hold  # else the robot said it before it knew of this one
        about = {"moves": self._said["moves"], "why": self._said["why"]} if known else {"moves": False, "why": ""}
        return {"beat": self._said["beat"], **about}

    async def hear(self, said: dict[str, Any]) -> None:
        """Take a beat of the robot, as `read_beat` returns it, and answer it."""
        ended, why = said["ended"]
        if self.holder is not None and self.holder.hold == ended:
            self._end(ended, why)
        await self._expire()
        self._said = said
        self._notify()
        await self._send({})

    def close(self, why: str) -> None:
        """End the hold: the connection of the robot is over."""
        if self.holder is not None:
            self._end(self.holder.hold, why)

    async def _expire(self) -> None:
        holder = self.holder
        if holder is not None and self._clock() - holder.heard > SILENT_S:
            why = f"nothing came from the page for {SILENT_S:g} s"
            self._end(holder.hold, why)
            await self._send({"do": "gone", "hold": holder.hold, "why": why})

    def _end(self, hold: str, why: str) -> None:
        self.holder, self._over = None, {hold: why}
        self._notify()

    def _gone(self, hold: str) -> dict[str, Any]:
        return {"over": self._over.get(hold, "the robot has ended it")}

    def _notify(self) -> None:
        self._changed.set()
        self._changed = asyncio.Event()


class RobotLinks:
    """The connections of the robots at one replica, by the session that the engine knows them by."""

    def __init__(self) -> None:
        self._links: dict[str, RobotLink] = {}

    def describe(self) -> dict[str, dict[str, Any]]:
        """Return who holds each robot, by session: `by` is None if nobody does. Callable from any thread."""
        links = dict(self._links)
        return {name: {"by": None if (one := link.holder) is None else one.by} for name, link in links.items()}

    def put(self, session: str, link: RobotLink) -> None:
        """Note that a robot is reached by `link`, and by none of before."""
        before = self._links.get(session)
        if before is link:
            return
        self.remove(link, "its session has begun again; take over on its new card")
        if before is not None:
            before.close("the robot has connected again; take over again")
        self._links[session] = link

    def remove(self, link: RobotLink, why: str) -> None:
        """Forget a robot's connection."""
        for session in [name for name, one in self._links.items() if one is link]:
            del self._links[session]
        link.close(why)

    async def exchange(self, session: str, hold: str, message: dict[str, Any]) -> dict[str, Any] | None:
        """Pass on what a human does, and return what is to be told to him.

        Args:
            session: The session of the robot, as the engine names it.
            hold: The id of his hold.
            message: Its `do` is "find", "take" with `by`, "wait" with `after`, or what the robot is sent: "move",
                "release" or "gone".

        Returns:
            Nothing, or `over` with the reason; with "wait", also what the robot says. None if it is not here.
        """
        link = self._links.get(session)
        if link is None:
            return None
        if message["do"] == "find":
            return {}
        if message["do"] == "take":
            return await link.take(hold, message["by"])
        if message["do"] == "wait":
            return await link.next(hold, message["after"])
        return await link.forward(hold, message)


def read_beat(stated: object) -> dict[str, Any]:
    """Return the entries of a robot's beat; raise `MalformedMessage` if it has another form."""
    found = stated if isinstance(stated, Mapping) else {}
    session, beat, hold, why, ended = (found.get(name) for name in ("session", "beat", "hold", "why", "ended"))
    texts = [session, hold, why, *(ended if isinstance(ended, list) and len(ended) == 2 else [None])]
    if not all(isinstance(text, str) for text in texts) or not 0 < len(str(session)) <= _NAME or type(beat) is not int:
        raise MalformedMessage(f"robot: got {shown(stated)}, want a beat with session, beat, hold, moves, why, ended")
    _, hold, why, ended_hold, ended_why = (str(text) for text in texts)
    said = {"session": session, "beat": beat, "hold": hold, "moves": bool(found.get("moves")), "why": why[:_WHY]}
    return {**said, "ended": (ended_hold, ended_why[:_WHY])}
