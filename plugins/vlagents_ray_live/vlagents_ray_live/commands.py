"""Commands to the sessions of a replica, from the holders of keys that may operate them on the live
page.

Over a network a robot can only be stopped: it is paused, stopped, or its episode is marked.
Commands that make it move (resuming, another instruction, an operator's motion) are given at the
robot. A command is sent in the answer to the robot's next request, within `_WAITS_S` or never,
since a late one could stop the robot unexpectedly; a later request reports the outcome. The server
itself executes `SAVE`.
"""

from __future__ import annotations

import logging
import threading
import time
import uuid
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, Literal

from vlagents_ray.client.commands import COMMAND, COMMANDED
from vlagents_ray.errors import InvalidInput, Overloaded, UnknownSession, VLAgentsError
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.sessions import SessionTable

logger = logging.getLogger(__name__)

TO_ROBOT = ("pause", "stop", "success", "failure")
"""The commands that are sent to a robot. None of them makes it move."""
SAVE = "save"  # the command that saves the session's last seconds, which the server does
COMMANDS = (*TO_ROBOT, SAVE)

TRACKED_S = 15.0  # time for which the outcome of a command is awaited
_WAITS_S = 5.0  # time within which a command must reach the robot
_SHOWN = 5  # number of commands shown per session, the latest ones
# Number of requests without the outcome of a command after which it counts as ignored.
_UNANSWERED = 3
_REFUSAL = 200  # maximum length of a reason

State = Literal["waiting", "sent", "saving", "done", "refused", "ignored", "too late"]


@dataclass(slots=True)
class Press:
    """A button press."""

    id: str
    do: str
    by: str  # name of the key; empty without keys
    pressed: float  # s, of the clock of the board
    state: State = "waiting"
    why: str = ""  # reason for a refusal, or the folder into which the session was saved
    requests: int = 0  # number of the session's requests since the command was sent

    def describe(self) -> dict[str, Any]:
        """Describe the command for viewers."""
        return {"id": self.id, "do": self.do, "by": self.by, "state": self.state, "why": self.why}


class CommandBoard:
    """The commands to the sessions of one replica. Thread-safe."""

    def __init__(
        self,
        sessions: SessionTable[LoadedModel],
        save: Callable[[str], str] = lambda _: "",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Create a board without commands.

        `save` writes the last seconds of a session and returns the path; it may be slow, and may
        raise errors.
        """
        self._save, self._sessions, self._clock = save, sessions, clock
        self._presses: dict[str, list[Press]] = {}  # by session, oldest first
        self._lock = threading.Lock()

    def press(self, session_id: str, do: str, by: str) -> dict[str, Any]:
        """Accept the command `do`, one of `COMMANDS`, from the holder of the key `by`, and describe
        it as `of` does.

        Raises:
            UnknownSession: The session is not here.
            InvalidInput: The command is unknown.
            Overloaded: Too many commands wait for the session's next request.
        """
        if do not in COMMANDS:
            raise InvalidInput(
                f"do: got {do[:40]!r}, want one of {list(COMMANDS)}; resume a robot, change its "
                "instruction or move it at the robot"
            )
        if session_id not in self._sessions:
            raise UnknownSession(
                f"session {session_id[:80]!r}: is not here; it ended, or has begun again elsewhere"
            )
        pressed = Press(uuid.uuid4().hex, do, by, self._clock())
        self.forget_others(self._sessions.ids())
        with self._lock:
            held = self._presses.setdefault(session_id, [])
            self._expire(held)
            if len(held) == _SHOWN:
                over = next((one for one in held if one.state not in ("waiting", "saving")), None)
                if over is None and do == "stop":  # a "stop" replaces a less important command
                    over = next(
                        (one for one in held if one.state == "waiting" and one.do != "stop"), None
                    )
                if over is None:
                    raise Overloaded(
                        f"session {session_id!r}: {_SHOWN} commands wait already for its robot's "
                        "request"
                    )
                held.remove(over)
            held.append(pressed)
        if do == SAVE:
            pressed.state = "saving"
            threading.Thread(target=self._save_now, args=(session_id, pressed), daemon=True).start()
        return pressed.describe()

    def read_outcomes(self, session_id: str, request: Request) -> None:
        """Read the outcomes of earlier commands that a session's request reports."""
        if not (held := self._presses.get(session_id)) or request.obs is None:
            return
        stated = request.obs.info.get(COMMANDED)
        outcomes = stated if isinstance(stated, dict) else {}
        with self._lock:
            for one in held:
                if one.state not in ("sent", "ignored"):
                    continue
                if isinstance(why := outcomes.get(one.id), str):
                    one.state, one.why = ("refused", why[:_REFUSAL]) if why else ("done", "")
                elif request.op == "act":
                    one.requests += 1
                    one.state = "ignored" if one.requests >= _UNANSWERED else one.state

    def send(self, session_id: str, reply: Reply) -> None:
        """Add the oldest waiting command to the answer to a session's act; "stop" has priority."""
        if not (held := self._presses.get(session_id)) or reply.act is None:
            return
        with self._lock:
            self._expire(held)
            for one in sorted(held, key=lambda one: one.do != "stop"):
                if one.state == "waiting":
                    reply.act.info[COMMAND] = {"id": one.id, "do": one.do, "by": one.by}
                    one.state = "sent"
                    return

    def of(self, session_id: str) -> list[dict[str, Any]]:
        """Describe the last commands to a session, oldest first: `id`, `do`, `by`, `state` and
        `why` of each.
        """
        with self._lock:
            held = self._presses.get(session_id, [])
            self._expire(held)
            return [one.describe() for one in held]

    def forget_others(self, sessions: Collection[str]) -> None:
        """Drop the commands to all other sessions, which have ended."""
        with self._lock:
            for session in self._presses.keys() - set(sessions):
                del self._presses[session]

    def _save_now(self, session_id: str, pressed: Press) -> None:
        try:
            pressed.why, pressed.state = self._save(session_id), "done"
        except Exception as error:
            if not isinstance(error, VLAgentsError):
                logger.exception("session %s was not saved", session_id)
            pressed.why, pressed.state = str(error)[:_REFUSAL], "refused"

    def _expire(self, held: Collection[Press]) -> None:
        """Expire the commands that have waited for too long; the caller holds the lock."""
        oldest = self._clock() - _WAITS_S
        for one in held:
            if one.state == "waiting" and one.pressed < oldest:
                one.state = "too late"
