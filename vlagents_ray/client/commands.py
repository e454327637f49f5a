"""Commands from the live page to a robot, which arrive in the replies to its requests; they can
only make it stop.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, replace

from vlagents_ray.chunking.control import RobotControl
from vlagents_ray.errors import ConfigError, printable
from vlagents_ray.interface import Act, Obs

COMMAND = "command"  # the entry of `Act.info` with a command: {"id", "do", "by"}, str each
# The entry of `Obs.info` with outcomes by id: why it was refused, or "" if executed.
COMMANDED = "commanded"
COMMANDS = ("pause", "stop", "success", "failure")  # none of them can start a motion
logger = logging.getLogger(__name__)
_BY = 80  # characters of a name that are kept


@dataclass(frozen=True, slots=True)
class Command:
    """A command from the live page."""

    id: str  # identifies the answer for the server
    do: str  # one of `COMMANDS`
    by: str = ""  # name of the API key used for the command; empty on a server without keys


class CommandInbox:
    """The commands for one session, from `RemoteAgent(url, commands=inbox)` to the state of the
    robot.

    The agent's thread adds commands and collects outcomes; `obey` runs on the thread of the control
    loop.
    """

    def __init__(self, allow: Collection[str] = COMMANDS) -> None:
        """Create an inbox; commands that are not in `allow` are refused. Raises `ConfigError`
        for an unknown one.
        """
        if unknown := sorted(set(allow) - set(COMMANDS)):
            raise ConfigError(f"allow: got {unknown}, want some of {list(COMMANDS)}")
        self.control = RobotControl()  # that of the last run
        self._allow = frozenset(allow)
        self._waiting: deque[Command] = deque()
        self._answers: dict[str, str] = {}  # refusal by id of a command, empty if it was executed
        self._sent: dict[str, str] = {}  # the outcomes in the last request

    def asking(self, obs: Obs) -> Obs:
        """Return the observation of a request with the outcomes of earlier commands added."""
        answers = self._sent = dict(self._answers)
        return replace(obs, info={**obs.info, COMMANDED: answers}) if answers else obs

    def came(self, act: Act | Exception) -> None:
        """Remove the command from the answer to that request, and queue or refuse it; ignore an
        invalid entry.
        """
        if isinstance(act, Exception):
            return
        for told in self._sent:  # these have reached the server
            self._answers.pop(told, None)
        stated = act.info.pop(COMMAND, None)
        if not isinstance(stated, dict) or not all(
            isinstance(stated.get(name), str) for name in ("id", "do")
        ):
            return
        command = Command(stated["id"], stated["do"], printable(str(stated.get("by", ""))[:_BY]))
        if command.do in self._allow:
            self._waiting.append(command)
        elif command.do in COMMANDS:
            self._answers[command.id] = f"{command.do}: not allowed here"
        else:
            self._answers[command.id] = (
                f"{command.do[:_BY]!r}: no such command, want one of {list(COMMANDS)}"
            )

    @property
    def waiting(self) -> list[Command]:
        """The commands that were received and not executed yet, oldest first."""
        return list(self._waiting)

    def obey(self, control: RobotControl) -> list[Command]:
        """Apply the commands received since the last call to the state of the robot, and return
        them.
        """
        done = []
        while self._waiting:
            command = self._waiting.popleft()
            by = f" by {command.by}" if command.by else ""
            if command.do == "pause":
                control.pause(f"paused from the live page{by}")
            elif command.do == "stop":
                control.stop(f"the live page{by}")
                logger.warning("stopped from the live page%s", by)
            else:
                control.mark(command.do)
            done.append(command)
            self._answers[command.id] = ""
        return done
