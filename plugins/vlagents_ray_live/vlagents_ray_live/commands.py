"""Commands to the sessions of a replica, from the live page.

The page accepts commands from callers whose key has the scope "operate". Over a network a robot can
only be stopped: it is paused, stopped, or its episode is marked. Commands that make it move
(resuming, another instruction, an operator's motion) are given at the robot.

A command is sent in the answer to the robot's next request, within `_WAITS_S` or never, since a
late command could stop the robot unexpectedly. A mark belongs to the episode that the caller saw,
and is never sent in another one; a stop and a pause may be, since they only hold the robot. A later
request reports the outcome. The command `SAVE` is executed by the server itself.
"""

from __future__ import annotations

import logging
import threading
import time
import uuid
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, Literal

from vlagents_ray.client.commands import COMMAND, COMMANDED, MARKS
from vlagents_ray.client.commands import COMMANDS as ROBOT_COMMANDS
from vlagents_ray.errors import InvalidInput, Overloaded, UnknownSession, VLAgentsError
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.sessions import Session, SessionTable

logger = logging.getLogger(__name__)

SAVE = "save"  # the command with which the server saves the session's last seconds
COMMANDS = (*ROBOT_COMMANDS, SAVE)

TRACKED_S = 15.0  # the time for which the outcome of a command is awaited
_WAITS_S = 5.0  # the time within which a command must reach the robot
_SHOWN = 5  # the number of the latest commands that are kept and shown for each session
# The number of requests without the outcome of a command after which the command counts as ignored.
_UNANSWERED = 3
_REFUSAL = 200  # maximum length of a reason, characters

State = Literal["waiting", "sent", "saving", "done", "refused", "ignored", "too late"]


@dataclass(slots=True)
class Press:
    """A command that was given with a button of the page."""

    id: str
    do: str  # the command, one of `COMMANDS`
    by: str  # the name of the caller's key; empty without keys
    pressed: float  # time at which it was pressed, s, of the clock of the board
    episode: str | None  # the episode of the command, see `episode_of`
    state: State = "waiting"
    # The reason why the command was rejected or not sent, or the folder into which the session was
    # saved.
    why: str = ""
    requests: int = 0  # the number of the session's requests since the command was sent

    def describe(self) -> dict[str, Any]:
        """Describe the command for viewers."""
        return {"id": self.id, "do": self.do, "by": self.by, "state": self.state, "why": self.why}


class CommandBoard:
    """The commands to the sessions of one replica. Thread-safe.

    Args:
        sessions: The sessions of the replica.
        save: Writes the last seconds of a session and returns the path of the dataset. It may be
            slow, and may raise errors.
        clock: Returns the current time, s.
    """

    def __init__(
        self,
        sessions: SessionTable[LoadedModel],
        save: Callable[[str], str] = lambda _: "",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._save = save
        self._sessions = sessions
        self._clock = clock
        self._presses: dict[str, list[Press]] = {}  # the commands by session, oldest first
        self._lock = threading.Lock()

    def press(
        self, session_id: str, do: str, by: str, episode: str | None = None
    ) -> dict[str, Any]:
        """Accept a command to a session.

        Args:
            session_id: The session.
            do: The command, one of `COMMANDS`.
            by: The name of the caller's key.
            episode: The episode that a mark ends, as in the session's snapshot; default: the
                running episode.

        Returns:
            The description of the command, see `describe`.

        Raises:
            UnknownSession: The session is not at this replica.
            InvalidInput: The command is unknown.
            Overloaded: Too many commands wait for the session's next request.
        """
        if do not in COMMANDS:
            raise InvalidInput(
                f"do: expected one of {list(COMMANDS)}, got {do[:40]!r}; resume a robot, change "
                "its instruction or move it at the robot"
            )
        if session_id not in self._sessions:
            raise UnknownSession(
                f"session {session_id[:80]!r}: is not at this replica; it has ended, or has moved "
                f"to another replica"
            )

        if episode is None:
            episode = self._running_episode(session_id)
        pressed = Press(uuid.uuid4().hex, do, by, self._clock(), episode)
        self.forget_others(self._sessions.ids())
        with self._lock:
            presses = self._presses.setdefault(session_id, [])
            self._expire(presses, session_id)
            if len(presses) == _SHOWN:
                replaced = _replaceable(presses, do)
                if replaced is None:
                    raise Overloaded(
                        f"session {session_id!r}: {_SHOWN} commands already wait for its robot's "
                        f"request"
                    )
                presses.remove(replaced)
            presses.append(pressed)
            self._expire([pressed], session_id)  # the caller may have seen an earlier episode

        if do == SAVE:
            pressed.state = "saving"
            threading.Thread(target=self._save_now, args=(session_id, pressed), daemon=True).start()
        return pressed.describe()

    def read_outcomes(self, session_id: str, request: Request) -> None:
        """Read the outcomes of earlier commands that a session's request reports."""
        presses = self._presses.get(session_id)
        if not presses or request.obs is None:
            return

        # By id of a command: the reason for rejecting it; empty if the command was executed.
        outcomes = request.obs.info.get(COMMANDED)
        if not isinstance(outcomes, dict):
            outcomes = {}
        with self._lock:
            for press in presses:
                if press.state not in ("sent", "ignored"):
                    continue
                refusal = outcomes.get(press.id)
                if isinstance(refusal, str):
                    press.state = "refused" if refusal else "done"
                    press.why = refusal[:_REFUSAL]
                elif request.op == "act":
                    press.requests += 1
                    if press.requests >= _UNANSWERED:
                        press.state = "ignored"

    def send(self, session_id: str, reply: Reply) -> None:
        """Add the oldest waiting command to an answer with an action of the session; "stop" has
        priority.
        """
        presses = self._presses.get(session_id)
        if not presses or reply.act is None:
            return

        with self._lock:
            self._expire(presses, session_id)
            for press in sorted(presses, key=lambda press: press.do != "stop"):
                if press.state == "waiting":
                    reply.act.info[COMMAND] = {"id": press.id, "do": press.do, "by": press.by}
                    press.state = "sent"
                    return

    def describe(self, session_id: str) -> list[dict[str, Any]]:
        """Return `id`, `do`, `by`, `state` and `why` of each of the last commands to a session,
        oldest first.
        """
        with self._lock:
            presses = self._presses.get(session_id, [])
            self._expire(presses, session_id)
            return [press.describe() for press in presses]

    def forget_others(self, sessions: Collection[str]) -> None:
        """Drop the commands to all other sessions, which have ended."""
        with self._lock:
            for session in self._presses.keys() - set(sessions):
                del self._presses[session]

    def _save_now(self, session_id: str, press: Press) -> None:
        """Save the last seconds of a session; runs on a separate thread."""
        try:
            press.why = self._save(session_id)
            press.state = "done"
        except Exception as error:
            if not isinstance(error, VLAgentsError):
                logger.exception("session %s was not saved", session_id)
            press.why = str(error)[:_REFUSAL]
            press.state = "refused"

    def _expire(self, presses: Collection[Press], session_id: str) -> None:
        """Expire the commands that have waited for too long, and the marks of earlier episodes; the
        caller holds the lock.
        """
        oldest = self._clock() - _WAITS_S
        running_episode = self._running_episode(session_id) if presses else None
        for press in presses:
            if press.state != "waiting":
                continue
            if press.do in MARKS and press.episode != running_episode:
                press.state, press.why = "too late", "its episode has ended"
            elif press.pressed < oldest:
                press.state = "too late"
                press.why = f"the robot made no request for {_WAITS_S:g} s"

    def _running_episode(self, session_id: str) -> str | None:
        """Return the running episode of a session; None if the session has ended."""
        for session in self._sessions.all():
            if session.id == session_id:
                return episode_of(session)
        return None


def episode_of(session: Session[LoadedModel]) -> str:
    """Return the name of a session's running episode for viewers: a text, since JavaScript rounds
    large integers.
    """
    return str(session.first)


def _replaceable(presses: Collection[Press], do: str) -> Press | None:
    """Return the oldest command that may be dropped for the new command `do`; None if there is
    none.
    """
    for press in presses:
        if press.state not in ("waiting", "saving"):
            return press
    if do == "stop":  # a stop is more important than the other commands
        for press in presses:
            if press.state == "waiting" and press.do != "stop":
                return press
    return None
