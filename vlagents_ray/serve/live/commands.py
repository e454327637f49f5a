"""Commands to the sessions of a replica, from those who may operate them on the live page.

A robot is reached by nothing but the answers to its own requests. So a command waits for the next one, but no longer
than `_WAITS_S`, since a late one would surprise whoever stands at the robot. A later request of the robot says what
became of it. What concerns the weights is done here.
"""

from __future__ import annotations

import itertools
import logging
import threading
import time
import uuid
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, Literal

from vlagents_ray.client.commands import COMMAND, COMMANDED, COMMANDS
from vlagents_ray.errors import InvalidInput, Overloaded, UnknownSession, VLAgentsError
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.sessions import SessionTable

logger = logging.getLogger(__name__)

HERE = {"follow": True, "pin": False}
"""The commands that the server itself obeys: whether a session's later episodes take the newest weights."""
SAVE = "save"
"""The command that saves the session's last seconds, which the server does as well."""

TRACKED_S = 15.0  # time for which the answer to a command is looked out for
_WAITS_S = 5.0  # time within which a command has to reach the robot
_SHOWN = 5  # last commands of a session that are shown
_UNANSWERED = 3  # requests without an answer to a command, after which it counts as ignored
_TEXT = 1000  # most characters of an instruction
_REFUSAL = 200

State = Literal["waiting", "sent", "saving", "done", "refused", "ignored", "too late"]


@dataclass(slots=True)
class Press:
    """A button that was pressed."""

    id: str
    do: str
    text: str
    by: str  # name of the key; empty without keys
    pressed: float  # s, of the board's clock
    state: State = "waiting"
    why: str = ""  # it was refused; or the folder into which the session was saved
    requests: int = 0  # of the session since it was sent

    def describe(self) -> dict[str, Any]:
        """Return it for viewers."""
        return {"id": self.id, "do": self.do, "text": self.text, "by": self.by, "state": self.state, "why": self.why}


class CommandBoard:
    """The commands to the sessions of one replica. Thread-safe."""

    def __init__(
        self,
        sessions: SessionTable[LoadedModel],
        watch: Callable[[float], None],
        clock: Callable[[], float] = time.monotonic,
        save: Callable[[str], str] = lambda _: "",
    ) -> None:
        """Create a board without commands.

        Args:
            sessions: The sessions of the replica.
            watch: Has the board see all messages for so many seconds more.
            clock: The time, s.
            save: Saves the last seconds of a session, and returns where to; it may take long, and raise errors.
        """
        self._save = save
        self._sessions = sessions
        self._watch = watch
        self._clock = clock
        self._numbers = itertools.count(1)
        self._prefix = uuid.uuid4().hex[:8]
        self._presses: dict[str, list[Press]] = {}  # by session, oldest first
        self._lock = threading.Lock()

    def press(self, session_id: str, do: str, text: str, by: str) -> dict[str, Any]:
        """Take a command for a session, and return it as `of` does.

        Args:
            session_id: Id of the session in the engine.
            do: One of `COMMANDS` or `HERE`, or `SAVE`.
            text: The new instruction, for "instruct".
            by: Name of the key whose holder commands.

        Raises:
            UnknownSession: The session is not here.
            InvalidInput: There is no such command, or it lacks its text.
            Overloaded: Too many commands wait for the session's next request.
        """
        if do not in (*COMMANDS, *HERE, SAVE):
            raise InvalidInput(f"do: got {do[:40]!r}, want one of {[*COMMANDS, *HERE, SAVE]}")
        if (do == "instruct") != bool(text) or len(text) > _TEXT:
            raise InvalidInput(f"text: got {len(text)} characters, want 1 to {_TEXT} with 'instruct', else none")
        session = next((one for one in self._sessions.all() if one.id == session_id), None)  # `get` would mark it used
        if session is None:
            raise UnknownSession(f"session {session_id[:80]!r}: is not here; it ended, or has begun again elsewhere")
        pressed = Press(f"{self._prefix}-{next(self._numbers)}", do, text, by, self._clock())
        self.forget_others(self._sessions.ids())
        with self._lock:
            held = self._presses.setdefault(session_id, [])
            self._expire(held)
            if len(held) == _SHOWN:
                over = next((one for one in held if one.state not in ("waiting", "saving")), None)
                if over is None:
                    raise Overloaded(f"session {session_id!r}: {_SHOWN} commands wait already for its robot's request")
                held.remove(over)
            held.append(pressed)
        if do in HERE:
            session.told_to_follow = session.follows = HERE[do]
            pressed.state = "done"
        elif do == SAVE:
            pressed.state = "saving"
            threading.Thread(target=self._save_now, args=(session_id, pressed), daemon=True).start()
        else:
            self._watch(TRACKED_S)
        return pressed.describe()

    def note(self, session_id: str, request: Request) -> None:
        """Note what a session's request says of earlier commands."""
        held = self._presses.get(session_id)
        if not held or request.obs is None:
            return
        said = request.obs.info.get(COMMANDED)
        answers = said if isinstance(said, dict) else {}
        with self._lock:
            for one in held:
                if one.state not in ("sent", "ignored"):
                    continue
                if isinstance(why := answers.get(one.id), str):
                    one.state, one.why = ("refused", why[:_REFUSAL]) if why else ("done", "")
                elif request.op == "act":
                    one.requests += 1
                    one.state = "ignored" if one.requests >= _UNANSWERED else one.state

    def send(self, session_id: str, reply: Reply) -> None:
        """Put the oldest command that waits into the answer to a session's act; "stop" goes first."""
        held = self._presses.get(session_id)
        if not held or reply.act is None:
            return
        with self._lock:
            self._expire(held)
            for one in sorted(held, key=lambda one: one.do != "stop"):
                if one.state == "waiting":
                    reply.act.info[COMMAND] = {"id": one.id, "do": one.do, "text": one.text, "by": one.by}
                    one.state = "sent"
                    return

    def of(self, session_id: str) -> list[dict[str, Any]]:
        """Return the last commands to a session, oldest first."""
        with self._lock:
            held = self._presses.get(session_id, [])
            self._expire(held)
            return [one.describe() for one in held]

    def forget_others(self, sessions: Collection[str]) -> None:
        """Drop the commands to all sessions but these, since those have ended."""
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
        """Give up what has waited for too long; the caller holds the lock."""
        oldest = self._clock() - _WAITS_S
        for one in held:
            if one.state == "waiting" and one.pressed < oldest:
                one.state = "too late"
