"""Commands from the live page to a robot: they come in the answers to its requests, and its own computer decides."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Protocol

from vlagents_ray.errors import ConfigError, InvalidInput, VLAgentsError
from vlagents_ray.interface import Act, Obs

COMMAND = "command"  # the entry of `Act.info` with a command: {"id", "do", "text", "by"}, str each
COMMANDED = "commanded"  # the entry of `Obs.info` with the answers: by id, why it was refused, "" if it was obeyed
COMMANDS = ("pause", "resume", "stop", "success", "failure", "instruct")
_REFUSAL = 200  # most characters of a refusal


@dataclass(frozen=True, slots=True)
class Command:
    """A command from the live page."""

    id: str  # by which the server knows the answer; empty if the command is not the server's
    do: str  # one of `COMMANDS`
    text: str = ""  # of "instruct": the new instruction
    by: str = ""  # name of the key whose holder pressed the button; empty on a server without keys


class Operated(Protocol):
    """What obeys commands; a method that cannot, raises one of this package's errors, which the page shows."""

    def pause(self) -> None:
        """Hold the robot still until `resume`."""
        ...

    def resume(self) -> None:
        """Let the policy go on after `pause`, from where the robot is."""
        ...

    def stop(self, by: str) -> None:
        """Stop the robot; whoever stands at it starts it again."""
        ...

    def mark(self, label: str) -> None:
        """End the episode as a "success" or a "failure"."""
        ...

    def instruct(self, text: str) -> None:
        """End the episode, and begin the next one with another instruction."""
        ...


class CommandInbox:
    """The commands for one session, from `RemoteAgent(url, commands=inbox)` to whatever obeys them.

    The agent's thread puts commands in and takes answers out; `obey` runs on the thread of the control loop.
    """

    def __init__(self, allow: Collection[str] = COMMANDS) -> None:
        """Create an inbox; commands that are not in `allow` are refused. Raises `ConfigError` for an unknown one."""
        if unknown := sorted(set(allow) - set(COMMANDS)):
            raise ConfigError(f"allow: got {unknown}, want some of {list(COMMANDS)}")
        self._allow = frozenset(allow)
        self._waiting: deque[Command] = deque()
        self._answers: dict[str, str] = {}  # refusal by id of a command, empty if it was obeyed
        self._sent: dict[str, str] = {}  # those in the last request

    def asking(self, obs: Obs) -> Obs:
        """Return the observation of a request with what became of the commands before it."""
        answers = self._sent = dict(self._answers)
        return replace(obs, info={**obs.info, COMMANDED: answers}) if answers else obs

    def came(self, act: Act | Exception) -> None:
        """Take the command out of the answer to that request; one of another form is left out."""
        if isinstance(act, Exception):
            return
        for told in self._sent:  # they have reached the server
            self._answers.pop(told, None)
        stated = act.info.pop(COMMAND, None)
        if not isinstance(stated, dict) or not all(isinstance(stated.get(name), str) for name in ("id", "do")):
            return
        command = Command(stated["id"], stated["do"], str(stated.get("text", "")), str(stated.get("by", "")))
        if command.do in self._allow:
            self._waiting.append(command)
        else:
            self._answers[command.id] = f"{command.do}: not allowed here"

    def put(self, do: str, text: str = "") -> None:
        """Add a command that this machine gives by itself, such as an instruction that came on a topic of ROS.

        Args:
            do: One of `COMMANDS`.
            text: The new instruction, of "instruct".
        """
        self._waiting.append(Command("", do, text))

    @property
    def waiting(self) -> list[Command]:
        """The commands that have come and were not obeyed yet, oldest first."""
        return list(self._waiting)

    def obey(self, operated: Operated) -> list[Command]:
        """Let `operated` do what has come since the last call; return those commands that it did."""
        done = []
        while self._waiting:
            command, refused = self._waiting.popleft(), ""
            try:
                _do(command, operated)
                done.append(command)
            except VLAgentsError as refusal:
                refused = str(refusal)[:_REFUSAL]
            if command.id:
                self._answers[command.id] = refused
        return done


def _do(command: Command, operated: Operated) -> None:
    if command.do == "pause":
        operated.pause()
    elif command.do == "resume":
        operated.resume()
    elif command.do == "stop":
        operated.stop(command.by)
    elif command.do == "instruct":
        operated.instruct(command.text)
    elif command.do in ("success", "failure"):
        operated.mark(command.do)
    else:
        raise InvalidInput(f"{command.do}: unknown here")
