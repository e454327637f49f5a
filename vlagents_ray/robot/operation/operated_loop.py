"""A control loop that obeys commands from the live page, at its next tick."""

from __future__ import annotations

from vlagents_ray.chunking.takeover import Takeover
from vlagents_ray.client.commands import CommandInbox
from vlagents_ray.errors import ConfigError
from vlagents_ray.robot.safety import Watchdog

PAUSED = "paused from the live page"


class OperatedLoop:
    """What commands have a control loop do: `vlagents_ray.client.commands.Operated`.

    A paused robot stands still, and goes on with `resume`. A stopped one is started again by a person who sees it, as
    after a stop by the watchdog; without a watchdog the loop ends. Where motion restarts by itself (a simulated robot),
    it holds until `resume`. A player that a human can take over from is paused itself, so that he can also do it in a
    pause.
    """

    def __init__(
        self,
        commands: CommandInbox | None,
        watchdog: Watchdog | None,
        *,
        manual: bool,
        takeover: Takeover | None = None,
    ) -> None:
        """Begin with a robot that moves.

        Args:
            commands: The commands; None if the loop obeys none.
            watchdog: The loop's watchdog.
            manual: Whether a person restarts motion after a stop.
            takeover: That of the chunk player; None if there is none.
        """
        self.outcome = ""  # "success" or "failure", if it was marked
        self.next_instruction: str | None = None
        self.over = False  # whether the loop ends
        self._commands = commands
        self._watchdog = watchdog
        self._manual = manual
        self._takeover = takeover if takeover is not None and takeover.used else None
        self._holds: str | None = None

    def holds(self) -> str | None:
        """Obey the commands that have come; return why the robot is to stand still, None if it may move."""
        if self._commands is not None:
            self._commands.obey(self)
        return self._holds if self._watchdog is None else _why_stopped(self._watchdog) or self._holds

    def stood(self) -> None:
        """Let motion begin again after a stop by the watchdog, where no person restarts it."""
        if self._watchdog is not None and not self._manual:
            self._watchdog.restart()

    def pause(self) -> None:
        """Hold the robot still until `resume`."""
        if self._takeover is not None:
            self._takeover.pause(PAUSED, here=False)
        else:
            self._holds = self._holds or PAUSED

    def resume(self) -> None:
        """Let the policy go on; raises `ConfigError` if somebody at the robot paused it, or has to start it."""
        if self._watchdog is not None and self._watchdog.stopped and self._manual:
            raise ConfigError("resume: the robot is stopped; start it where it stands")
        if self._takeover is not None:
            self._takeover.resume(here=False)
        self._holds = None

    def stop(self, by: str) -> None:
        """Stop the robot."""
        reason = f"stopped from the live page{by and f' by {by}'}"
        if not self._manual:
            self._holds = reason
        elif self._watchdog is not None:
            self._watchdog.trip(reason)
        else:
            self._holds, self.over = reason, True

    def mark(self, label: str) -> None:
        """End the episode as a "success" or a "failure"."""
        self.outcome, self.over = label, True

    def instruct(self, text: str) -> None:
        """End the loop, and let its caller begin another one with this instruction."""
        self.next_instruction, self.over = text, True


def _why_stopped(watchdog: Watchdog) -> str | None:
    if not watchdog.stopped:
        return None
    silent = watchdog.silent
    cause = f"no signal from the {' and the '.join(silent)}" if silent else "waiting for a restart (Watchdog.restart)"
    return f"stopped by the watchdog: {cause}"
