"""Commands from the live page to a robot, which arrive in the replies to the robot's requests. A
command can only pause or stop the robot, or end its episode.
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
# The entry of `Obs.info` with the outcomes of commands, by id: the reason of the rejection, or ""
# if the command was executed.
COMMANDED = "commanded"
MARKS = ("success", "failure")  # the commands that end an episode with an outcome
COMMANDS = ("pause", "stop", *MARKS)  # no command can start a motion
logger = logging.getLogger(__name__)
_NAME_CHARACTERS = 80  # the maximum length of a name from the network; longer names are truncated


@dataclass(frozen=True, slots=True)
class Command:
    """A command from the live page."""

    id: str  # identifies the command when its outcome is sent to the server
    do: str  # one of `COMMANDS`
    by: str = ""  # name of the API key used for the command; empty on a server without keys


class CommandInbox:
    """The commands for one session, from `RemoteAgent(url, commands=inbox)` to the state of the
    robot.

    The agent's thread adds commands and collects outcomes; `apply` runs on the thread of the
    control loop.
    """

    def __init__(self, allow: Collection[str] = COMMANDS) -> None:
        """Create an empty inbox.

        Args:
            allow: The names of the commands that may be executed; others are rejected.

        Raises:
            ConfigError: `allow` has an unknown name.
        """
        unknown = sorted(set(allow) - set(COMMANDS))
        if unknown:
            raise ConfigError(
                f"allow: expected only {list(COMMANDS)}, got {unknown}; leave these out"
            )

        self.control = RobotControl()  # the `RobotControl` of the last run
        self._allow = frozenset(allow)
        self._waiting: deque[Command] = deque()
        # Outcomes by the id of the command: the reason of a rejection, or "" if the command was
        # executed.
        self._outcomes: dict[str, str] = {}
        self._sent_outcomes: dict[str, str] = {}  # the outcomes in the last request

    def with_outcomes(self, obs: Obs) -> Obs:
        """Return the observation of a request with the outcomes of earlier commands added."""
        outcomes = self._sent_outcomes = dict(self._outcomes)
        return replace(obs, info={**obs.info, COMMANDED: outcomes}) if outcomes else obs

    def receive(self, act: Act | Exception) -> None:
        """Remove the command from the answer to the last request, and queue or reject the command.
        An invalid entry is ignored.
        """
        if isinstance(act, Exception):
            return
        for sent_id in self._sent_outcomes:  # the server has received these outcomes
            self._outcomes.pop(sent_id, None)

        entry = act.info.pop(COMMAND, None)
        if not isinstance(entry, dict):
            return
        command_id, action = entry.get("id"), entry.get("do")
        if not isinstance(command_id, str) or not isinstance(action, str):
            return

        sender = printable(str(entry.get("by", ""))[:_NAME_CHARACTERS])
        command = Command(command_id, action, sender)
        if command.do in self._allow:
            self._waiting.append(command)
        elif command.do in COMMANDS:
            self._outcomes[command.id] = f"{command.do}: not allowed here"
        else:
            self._outcomes[command.id] = (
                f"expected a command of {list(COMMANDS)}, got {command.do[:_NAME_CHARACTERS]!r}"
            )

    @property
    def waiting(self) -> list[Command]:
        """The received commands that have not been executed yet, oldest first."""
        return list(self._waiting)

    def begin_episode(self) -> None:
        """Reject the marks that have not been applied yet, since they are about an earlier episode;
        `RemoteAgent.reset` calls this method.

        Stops and pauses remain: they only hold the robot.
        """
        waiting = list(self._waiting)
        self._waiting.clear()
        for command in waiting:
            if command.do in MARKS:
                self._outcomes[command.id] = f"{command.do}: its episode has ended"
            else:
                self._waiting.append(command)

    def apply(self, control: RobotControl) -> list[Command]:
        """Apply the commands that arrived since the last call to the state of the robot, and return
        them.
        """
        executed = []
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
            executed.append(command)
            self._outcomes[command.id] = ""
        return executed
