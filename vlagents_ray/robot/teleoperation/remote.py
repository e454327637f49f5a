"""A leader whose human is at the live page of the policy's server."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from vlagents_ray.chunking.takeover import Leader
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.client.steering import BEAT_S, IDLE_S, SILENT_S, Steering
from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, ConnectionLost, MalformedMessage
from vlagents_ray.interface import Obs
from vlagents_ray.robot.teleoperation.axes import AxesLeader
from vlagents_ray.robot.teleoperation.relay import RelayedLeader
from vlagents_ray.robot.teleoperation.remote_link import RemoteLink

if TYPE_CHECKING:
    from typing_extensions import Self

_BEATS = 1024  # beats whose times are kept


class RemoteLeader:
    """Lets a human at the live page move this robot, with keys or buttons: its "Take over".

        with RemoteLeader(agent) as leader:
            player = ChunkPlayer(agent, override=leader)

    Inside of the context, the robot is offered to those who hold a key of the scope `operate`. Their commands pass the
    guard as any other leader's. One counts until `deadline_s` after the newest sign of life of this robot that it
    answers, by this computer's clock; then the robot holds still. A human who is silent for 3 s has lost the robot: it
    is paused until somebody resumes or takes over.

    A human at the robot goes first: one who engages `local`, or any pause, ends the other's hold at once, and one far
    away cannot end a pause of `takeover.pause()`.

    Args:
        agent: The policy's server; the robot's card is that of its session.
        contract: What actions are, as for `AxesLeader`; default: the policy's contract.
        local: What a human at the robot moves it with.
        deadline_s: How long a command counts, s. The time to the page and back, and 0.05 s, have to fit in.
        step: As for `AxesLeader`.
        measure: As for `AxesLeader`.

    Raises:
        ConfigError: The contract does not say enough (see `AxesLeader`), or the server has no live page.
    """

    def __init__(
        self,
        agent: RemoteAgent,
        contract: Contract | None = None,
        *,
        local: Leader | None = None,
        deadline_s: float = 0.3,
        step: float | None = None,
        measure: Callable[[Obs], np.ndarray] | None = None,
    ) -> None:
        self._relay = RelayedLeader(deadline_s)
        self._device = _RelayedAxes(self._relay)
        self._axes = AxesLeader(contract or agent.contract, self._device, step=step, measure=measure)
        self._agent = agent
        self._local = local
        self._link = RemoteLink(agent.url, agent.credentials, self)
        self._lock = threading.RLock()
        self._here = self._distant = False  # who is engaged at this tick; set by the loop's thread alone
        self._hold = ""  # id of the human's hold; empty if there is none
        self._by = ""  # name of his key
        self._seq = -1  # of the last command that counted
        self._heard = 0.0  # when it came, s of `time.monotonic`
        self._moves, self._why = False, ""  # whether he moved the robot at the last tick, and why not
        self._ended = ("", "")  # the last hold that this robot ended, and why
        self._gone: str | None = None  # why he is gone, until the loop has noticed
        self._beat = 0
        self._beats: dict[int, float] = {}  # when they were sent, s of `time.monotonic`, by number

    def __enter__(self) -> Self:
        self._link.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self._link.close()

    @property
    def distant(self) -> bool:
        """Whether the human for whom `engaged` has returned true last is at the live page."""
        return self._distant

    @property
    def by(self) -> str | None:
        """The name of the key whose holder has taken over at the live page, "" without keys; None if nobody has."""
        with self._lock:
            return self._by if self._hold else None

    def engaged(self) -> bool:
        """Return whether a human wants to move the robot, at the robot or at the live page.

        Raises:
            ConnectionLost: The human at the live page is gone, once.
            ConfigError: The leader was not opened.
        """
        if not self._link.is_open:
            raise ConfigError("RemoteLeader: it was not opened; use `with RemoteLeader(agent) as leader:`")
        self._here = self._distant = False
        self._here = self._local is not None and self._local.engaged()
        with self._lock:
            self._expire()
            gone, self._gone = self._gone, None
            if self._here:
                self.dismiss("somebody at the robot has taken over")
                return True
            if gone is not None:
                raise ConnectionLost(gone)
            self._distant = self._axes.engaged()
            return self._distant

    def action(self, obs: Obs) -> np.ndarray:
        """Return the human's action, (D,) float32; raises `InvalidAction` if his last command is too old."""
        if self._local is not None and self._here:
            return self._local.action(obs)
        with self._lock:
            action = self._axes.action(obs)
            self._moves, self._why = True, ""
            return action

    def note_held(self, why: str) -> None:
        """Note why the robot holds still, for the human at the live page."""
        self._moves, self._why = False, why

    def dismiss(self, why: str) -> None:
        """Let the human at the live page have to take over again, and tell him why."""
        with self._lock:
            if self._hold:
                self._ended = (self._hold, why)
            self._let_go()

    def beat(self) -> dict[str, Any]:
        """Return the next sign of life for the server; see `vlagents_ray.client.steering`."""
        with self._lock:
            self._expire()
            self._beat += 1
            self._beats[self._beat] = time.monotonic()
            self._beats.pop(self._beat - _BEATS, None)
            said = {"hold": self._hold, "moves": self._moves, "why": self._why, "ended": list(self._ended)}
            return {"session": self._agent.session, "beat": self._beat, **said}

    @property
    def beat_s(self) -> float:
        """The time between two beats, s."""
        return BEAT_S if self._hold else IDLE_S

    def receive(self, message: Mapping[str, Any]) -> None:
        """Take a message of the server; one of another form, of another hold, late or out of order does not count."""
        hold, do = message.get("hold"), message.get("do")
        with self._lock:
            if not isinstance(hold, str) or not hold:
                return
            if do == "begin":
                self._begin(hold, str(message.get("by", "")))
            elif hold != self._hold:
                return
            elif do == "move":
                self._move(message)
            elif do == "release":
                self._let_go()
            elif do == "gone":
                self._lose(str(message.get("why", "")))

    def _begin(self, hold: str, by: str) -> None:
        self.dismiss("somebody else has taken over")
        self._hold, self._by, self._seq, self._heard = hold, by, -1, time.monotonic()
        self._moves, self._why = False, "the robot's control loop has not moved it yet"

    def _move(self, message: Mapping[str, Any]) -> None:
        try:
            command = Steering.of(message)
        except MalformedMessage:
            return
        sent = self._beats.get(command.beat)
        if sent is None or command.seq <= self._seq:
            return
        if self._relay.command(np.array(command.axes, np.float32), at=sent):
            self._device.note(command.grips)
            self._seq, self._heard = command.seq, time.monotonic()

    def _expire(self) -> None:
        if self._hold and time.monotonic() - self._heard > SILENT_S:
            self._lose(f"no command came for {SILENT_S:g} s")

    def _lose(self, why: str) -> None:
        self._ended = (self._hold, why)
        if self._relay.engaged():
            self._gone = f"the human at the live page is gone: {why}"
        self._let_go()

    def _let_go(self) -> None:
        self._hold, self._moves, self._why = "", False, ""
        self._relay.release()
        self._device.begin()


class _RelayedAxes:
    """The axes and the gripper's button of a human who is far away, as a device."""

    def __init__(self, relay: RelayedLeader) -> None:
        self._relay = relay
        self.begin()

    def begin(self) -> None:
        """Begin another hold."""
        self._grips = self._presses = 0

    def note(self, grips: int) -> None:
        """Note how often the gripper's button was pressed in this hold."""
        self._presses += max(0, grips - self._grips)
        self._grips = grips

    def engaged(self) -> bool:
        return self._relay.engaged()

    def axes(self) -> np.ndarray:
        return self._relay.action(Obs())

    def gripper_presses(self) -> int:
        presses, self._presses = self._presses, 0
        return presses
