"""Who moves a robot at a tick: the policy, nobody, or a human. This is decided on the robot's computer."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from vlagents_ray.chunking.buffer import Step
from vlagents_ray.chunking.motion import Motion
from vlagents_ray.errors import ConfigError, InvalidAction, VLAgentsError
from vlagents_ray.interface import (
    DISTRIBUTION,
    EXECUTED,
    INTERVENTION,
    SAFE,
    SAMPLES,
    SILENT,
    WANTED,
    Act,
    Obs,
)

TakeoverState = Literal["autonomous", "paused", "human"]
UNCERTAINTY = "uncertainty"  # in the info of an Act, if the policy states it: a number, or one for each row
PAUSED = "paused by an operator"
_EXECUTED = 256  # human actions of which a request tells, the last ones
RELEASED = "a human has released the robot, or a pause is over: waiting for a new answer"


class Leader(Protocol):
    """The interface of what a human moves a robot with: a keyboard, a SpaceMouse, a second arm."""

    def engaged(self) -> bool:
        """Return at once whether the human wants to move the robot at this tick."""
        ...

    def action(self, obs: Obs) -> np.ndarray:
        """Return the human's action at once, for a tick at which `engaged` was true.

        Args:
            obs: The observation of the tick.

        Returns:
            The action, (D,) float32, in the units of the policy's contract.

        Raises:
            InvalidAction: There is none at this tick; the robot holds still.
        """
        ...


@runtime_checkable
class DistantLeader(Leader, Protocol):
    """The interface of a leader with which a human may be far from the robot: whoever stands at it goes first."""

    @property
    def distant(self) -> bool:
        """Whether the human for whom `engaged` has returned true last is far away."""
        ...

    def note_held(self, why: str) -> None:
        """Note why the robot holds still at this tick, in place of the human's action."""
        ...

    def dismiss(self, why: str) -> None:
        """Let a human who is far away have to take over again; `why` is told to him."""
        ...


class Takeover:
    """The state of a chunk player: autonomous → paused → human → autonomous, decided once a tick.

    A leader that is engaged has the robot, whatever the state was. When it lets go, the policy continues, or the robot
    is paused if `pause` was called meanwhile. `pause` and `resume` may be called from any thread; they take effect at
    the next tick.

    A human who is far away (`DistantLeader`) goes last: any pause ends his hold of the robot at once, and he takes over
    neither in a pause by somebody at the robot nor while the robot is stopped.

    Args:
        leader: What a human moves the robot with; None if there is nothing.
        ask_for_help: The uncertainty of a chunk above which the robot pauses (see `uncertainty`); None: no pauses.
        samples: The number of samples of its actions for which the policy is asked; None: no samples.

    Raises:
        ConfigError: `ask_for_help` is negative or NaN.
    """

    def __init__(
        self, leader: Leader | None = None, ask_for_help: float | None = None, samples: int | None = None
    ) -> None:
        if ask_for_help is not None and not ask_for_help >= 0:
            raise ConfigError(f"ask_for_help: got {ask_for_help}, want 0 or above, or None")
        self.leader = leader
        self._state: TakeoverState = "autonomous"
        self._threshold = ask_for_help
        self._samples = samples
        self._executed: deque[np.ndarray] = deque(maxlen=_EXECUTED)  # in place of the policy's, since the last request
        self._pause: str | None = None  # the reason of a pause that lasts
        self._paused_here = False  # whether somebody at the robot paused it
        self._noted = False  # an action was noted at this tick
        self._judged: Mapping[str, Any] | None = None  # the info of the last chunk whose uncertainty was looked at
        self._helped = False  # since the last certain chunk, a human has looked at the scene

    @property
    def state(self) -> TakeoverState:
        """Who moves the robot: "autonomous" (the policy), "paused" (nobody) or "human"; readable from any thread."""
        return self._state

    @property
    def reason(self) -> str | None:
        """Why the robot is paused, or will be when the human lets go; None if it is not."""
        return self._pause

    @property
    def used(self) -> bool:
        """Whether a leader or a threshold is set."""
        return self.leader is not None or self._threshold is not None

    def pause(self, reason: str = PAUSED, *, here: bool = True) -> None:
        """Let the robot hold still from the next tick on, until `resume` or a human.

        Args:
            reason: Why, for `reason`.
            here: Whether somebody at the robot asks for it; then nobody who is far away ends it.
        """
        self._paused_here = here or (self._paused_here and self._pause is not None)
        self._pause = reason

    def resume(self, *, here: bool = True) -> None:
        """Let the policy continue from the next tick on, with a new answer.

        Args:
            here: Whether somebody at the robot asks for it.

        Raises:
            ConfigError: Somebody at the robot paused it, and somebody else is to end that.
        """
        if not here and self._pause is not None and self._paused_here:
            raise ConfigError("resume: somebody at the robot has paused it; resume it there")
        self._pause = None

    def begin(self) -> None:
        """Begin an episode; a pause, and a human's hold of the robot, last into it. The player calls this."""
        self._executed.clear()
        self._judged, self._helped = None, False

    def update(self) -> bool:
        """Decide at the beginning of a tick who moves the robot; the player calls this.

        Returns:
            Whether what the policy has planned is void, since a human moved the robot, or nobody does. In a pause the
            policy is asked on, and none of its answers is executed.
        """
        self._noted = False
        before, engaged = self._state, False
        if self.leader is not None:
            try:
                engaged = self.leader.engaged()
            except Exception as error:  # noqa: BLE001 - a broken device must not end the loop
                self.pause(_reason(error), here=False)
            if engaged and self._pause is not None and self._is_outranked(before):
                engaged = False
            elif engaged and before != "human":
                self._pause = None
        self._state = "human" if engaged else "autonomous" if self._pause is None else "paused"
        void = self._state == "paused" or self._state == "autonomous" != before
        self._helped |= void
        return void

    def act(self, obs: Obs, planned: Step | None, motion: Motion) -> Act:
        """Return the action of the human who has the robot, or the safe one where that is refused.

        Args:
            obs: The observation of the tick.
            planned: What the policy wanted; None if that is unknown.
            motion: Checks the action, and knows the safe one.

        Returns:
            The action, (D,) float32; its info has `INTERVENTION`, `WANTED` and, if the action is a safe one, `SAFE`.

        Raises:
            InvalidAction: There is neither an action of the human nor a safe one that passes the check.
        """
        info: dict[str, Any] = {INTERVENTION: True, SILENT: 0.0}  # the policy's silence stops no human
        if planned is not None:
            info[WANTED] = planned.action.copy()
        try:
            action = motion.move(self._led(obs), obs)
        except InvalidAction as error:
            if isinstance(self.leader, DistantLeader):
                self.leader.note_held(str(error))
            action, info[SAFE] = motion.hold(obs, str(error))
        else:
            self.note_executed(action)
        return Act(action.copy(), info=info)

    def note_executed(self, action: np.ndarray) -> None:
        """Note an action, (D,), that the robot executed in place of the policy's; the next request says so."""
        self._executed.append(action)
        self._noted = True

    def note_held(self, action: np.ndarray) -> None:
        """Note an action, (D,), that holds the robot; in a pause, the policy's is not to be expected any more."""
        if self._state == "paused":
            self.note_executed(action)

    def note_stopped(self) -> None:
        """Note that the robot was stopped, and did not execute the action noted at this tick."""
        if self._noted:
            self._executed.pop()
            self._noted = False
        if isinstance(self.leader, DistantLeader) and self.leader.distant:
            self.leader.dismiss("the robot was stopped")

    def extras(self) -> dict[str, Any]:
        """Return what the next request says in its `Obs.info`: the samples wanted, and what was executed since."""
        extras: dict[str, Any] = {} if self._samples is None else {SAMPLES: self._samples}
        if self._executed:
            extras[EXECUTED] = np.stack(self._executed)
            self._executed.clear()
        return extras

    def _is_outranked(self, before: TakeoverState) -> bool:
        """Whether the human who is engaged is far away, and the pause ends his hold of the robot, or forbids one."""
        if not (isinstance(self.leader, DistantLeader) and self.leader.distant):
            return False
        outranked = self._paused_here or before == "human"
        if outranked:
            self.leader.dismiss(self._pause or PAUSED)
        return outranked

    def _led(self, obs: Obs) -> np.ndarray:
        if self.leader is None:
            raise InvalidAction("leader: there is none")
        try:
            return np.array(self.leader.action(obs), np.float32)
        except Exception as error:
            raise InvalidAction(f"leader: {error}") from error

    def needs_help(self, info: Mapping[str, Any]) -> bool:
        """Pause if a chunk is too uncertain, and return whether it is; the player calls this before it executes a row.

        After a pause the policy may continue once with an uncertain chunk: help is asked for again when there was a
        certain one in between.

        Args:
            info: What the policy says of the chunk.

        Raises:
            ConfigError: It states no uncertainty.
        """
        if self._threshold is None or info is self._judged:
            return False
        self._judged = info
        value = uncertainty(info)
        if value is None:
            raise ConfigError(
                "ask_for_help: the policy states no uncertainty; ask it for samples (samples=8), or add "
                f"act.info[{UNCERTAINTY!r}] to its answers"
            )
        if value <= self._threshold:
            self._helped = False
            return False
        if self._helped:
            return False
        self.pause(f"asks for help: its uncertainty is {value:.3g}, above {self._threshold:.3g}", here=False)
        return True


def _reason(error: Exception) -> str:
    """Return why a leader that raised an error pauses the robot; this package's errors say it themselves."""
    return str(error) if isinstance(error, VLAgentsError) else f"the leader failed: {error!r}"


def uncertainty(info: Mapping[str, Any]) -> float | None:
    """Return how uncertain a policy is of a chunk.

    Args:
        info: The info of the policy's `Act`.

    Returns:
        `info["uncertainty"]` if the policy states it; else the mean standard deviation of its samples, in the units of
        the action; None if there are none.
    """
    if UNCERTAINTY in info:
        return float(np.max(info[UNCERTAINTY]))
    if DISTRIBUTION in info:
        return float(np.mean(info[DISTRIBUTION]["std"]))
    return None
