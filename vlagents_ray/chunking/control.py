"""The control state of a robot, on its computer: stops, pauses, takeovers and episodes."""

from __future__ import annotations

import contextlib
import copy
import threading
from collections.abc import Iterator
from typing import Any, Literal, Protocol, get_args

import numpy as np

from vlagents_ray.chunking.fallback import Held
from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.interface import Obs

ControlState = Literal["autonomous", "paused", "human", "stopped"]
Outcome = Literal["success", "failure"]
PAUSED = "paused by an operator"
COMMAND_S = 0.02
"""The longest time, s, for which a stop waits for the end of a command: a tick at 50 Hz.

A command takes less than a millisecond, and a stop must not wait for a command that hangs.
"""


class Leader(Protocol):
    """The interface of an operator's device: a keyboard, a SpaceMouse, a second arm.

    A device that sums its motions to absolute targets also has a method `rebase(last)`, which is
    called when the device's action was not executed. The next target then begins at `last`, the
    executed command, (D,) float32, or at the robot's measured pose if `last` is None. Otherwise,
    the targets would move on while the guard rejects them.

    A device that commands grippers also has a method `begin(last)`, which is called before the
    first `action` of a takeover, with the last command, (D,) float32, or None if there is none. A
    gripper keeps this command until the operator changes it. With a method `join(arm)`, it gets the
    actions of the robot's contract (`ActionSpec`) before that: the arm may know grippers that the
    policy's contract does not declare.
    """

    def engaged(self) -> bool:
        """Return whether the operator moves the robot at this tick. The method must not block."""

    def action(self, obs: Obs) -> np.ndarray:
        """Return the operator's action for a tick at which `engaged()` is true.

        The method must not block.

        Returns:
            (D,) float32 in the contract's units.

        Raises:
            InvalidAction: The device has no action at this tick, so the robot holds still.
        """


class RobotControl:
    """The state machine of a robot.

    | state | source of motion | ends with |
    |---|---|---|
    | "autonomous" | the policy | any of the other states |
    | "human" | the engaged leader | its release: the policy continues, or the robot is paused |
    | "paused" | nothing | `resume`, or an engaged leader |
    | "stopped" | nothing | `restart` |

    `update` sets the state once per tick. All methods may be called from any thread: a pause takes
    effect at the next action, a stop at once. Stops and pauses persist from one run of the control
    loop to the next. Only `pause`, `stop` and `mark` are called over a network (see
    `vlagents_ray.client.commands`): `resume` and `restart` are for the operator at the robot and
    for the robot's own program.

    Args:
        leader: The operator's device, or None.
    """

    def __init__(self, leader: Leader | None = None) -> None:
        self.leader = leader
        self.stops: list[str] = []
        """The reasons of all stops, oldest first."""
        self.running = False
        """Whether `run_loop` drives the robot.

        The loop sends no command while the robot is paused or stopped.
        """
        # Reentrant, since a signal handler may interrupt the thread that owns it.
        self._lock = threading.RLock()
        # Locked during a command, always acquired before `_lock`.
        self._commanding = threading.RLock()
        self._stopping = 0  # number of calls of the robot's `stop` in progress
        self._state: ControlState = "autonomous"
        self._stop: str | None = None  # the reason of a commanded stop
        self._barked = False  # whether a silence stopped the robot
        # Sources whose silence stopped the robot and that are still silent.
        self._silent: set[str] = set()
        self._unseen = False  # whether the loop has not yet held the robot still for the last stop
        self._auto = False  # whether the end of a silence ends the stop that it caused
        self._pause: str | None = None  # the reason of a pause
        self._pauses = 0  # the number of pauses so far
        self._engaged = False  # whether the leader was engaged at the last update
        self._outcome: Outcome | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> RobotControl:
        return RobotControl(copy.deepcopy(self.leader, memo))  # The copy controls another robot.

    @property
    def state(self) -> ControlState:
        """The state at this tick: whether the policy, an operator or nothing moves the robot."""
        return self._state

    @property
    def reason(self) -> str | None:
        """The reason why the robot is paused, or will be paused when the operator releases the
        device; None if there is no pause.
        """
        return self._pause

    @property
    def stopped(self) -> bool:
        """Whether the robot was stopped and motion has not been restarted since."""
        return self._stop is not None or self._barked

    @property
    def silent(self) -> list[str]:
        """The sources whose silence stopped the robot and that are still silent, by name."""
        with self._lock:
            return sorted(self._silent)

    @property
    def needs_restart(self) -> bool:
        """Whether the robot is stopped until `restart`, even if no source is silent."""
        with self._lock:
            return self._stop is not None or (self._barked and not self._auto)

    def pause(self, reason: str = PAUSED) -> None:
        """Hold the robot still until `resume` or a takeover.

        A takeover in progress is not interrupted.
        """
        with self._lock:
            self._pause = reason
            self._pauses += 1

    def resume(self) -> None:
        """Continue with the policy at the next tick, with a new answer."""
        with self._lock:
            self._pause = None

    def stop(self, reason: str, *, silent: str | None = None) -> None:
        """Stop the robot until `restart`: the control loop sends no further command, and calls the
        robot's `stop`.

        Args:
            reason: The reason, for `stops`.
            silent: The source whose silence is the reason. A call of `heard` ends the silence.
        """
        with self._lock:
            self._unseen = True
            self.stops.append(reason)
            if silent is None:
                self._stop = reason
            else:
                self._barked = True
                self._silent.add(silent)

    @contextlib.contextmanager
    def stopping(self) -> Iterator[None]:
        """The context in which any thread calls the robot's `stop`, after it has called `stop` of
        this object.

        The context begins when a command in progress has ended, or after `COMMAND_S` if the command
        hangs. The loop sends no command within the context, even after `restart`. After the
        context, the loop holds the robot still for at least one tick.
        """
        with self._lock:
            self._stopping += 1
        try:
            if self._commanding.acquire(timeout=COMMAND_S):
                self._commanding.release()
            yield
        finally:
            with self._lock:
                self._stopping -= 1
                self._unseen = True

    @contextlib.contextmanager
    def command(self) -> Iterator[Held | None]:
        """Yield the reason why no command may be sent; None if one command may be sent within this
        context.
        """
        with self._commanding:
            yield self.held

    def heard(self, source: str) -> None:
        """Record that a source is no longer silent. The robot stays stopped."""
        with self._lock:
            self._silent.discard(source)

    def restart(self) -> bool:
        """Allow motion again after a stop, unless a source is `silent`.

        A signal handler may call this method.

        Returns:
            Whether motion is allowed. If it is not, call the method again after the silence.
        """
        with self._lock:
            if not self._silent:
                self._stop, self._barked = None, False
            return not self.stopped

    def mark(self, label: str) -> None:
        """End the episode as a "success" or a "failure"; raises `ConfigError` for another label."""
        if label not in get_args(Outcome):
            raise ConfigError(f"mark: expected one of {list(get_args(Outcome))}, got {label!r}")
        with self._lock:
            self._outcome = "success" if label == "success" else "failure"

    def adopt(self, other: RobotControl) -> None:
        """Copy the stop and the pause of another `RobotControl`, which is no longer used."""
        with other._lock, self._lock:
            self._stop, self._barked = self._stop or other._stop, self._barked or other._barked
            self._silent |= other._silent
            self._unseen |= other._unseen
            self.stops += other.stops
            self._pause = self._pause or other._pause

    def begin(self, *, auto: bool) -> None:
        """Begin a run of the loop.

        With `auto`, the end of a silence also ends the stop that the silence caused.
        """
        with self._lock:
            self._auto, self._outcome, self.running = auto, None, True

    def end(self) -> str:
        """End a run of the loop, and return its outcome, or "" if there is none."""
        with self._lock:
            self.running = False
            return self._outcome or ""

    def update(self) -> bool:
        """Set the source of motion at the beginning of a tick; return whether the policy's plan
        must be discarded.
        """
        pauses = self._pauses
        engaged = False
        if self.leader is not None:
            try:
                engaged = self.leader.engaged()
            except Exception as error:  # noqa: BLE001 - a broken device must not end the loop
                is_ours = isinstance(error, VLAgentsError)
                self.pause(str(error) if is_ours else f"the leader failed: {error!r}")

        with self._lock:
            before = self._state
            # A takeover ends an earlier pause, but not one that began during this update.
            if engaged and not self._engaged and pauses == self._pauses:
                self._pause = None
            self._engaged = engaged

            if self.stopped:
                self._state = "stopped"
            elif engaged:
                self._state = "human"
            else:
                self._state = "autonomous" if self._pause is None else "paused"
            return self._state in ("paused", "stopped") or self._state == "autonomous" != before

    @property
    def held(self) -> Held | None:
        """The reason why the robot must not move, according to the last `update` and later events;
        None if it may move.
        """
        with self._lock:
            if self._state == "stopped" or self.stopped or self._unseen or self._stopping:
                silent = " and the ".join(sorted(self._silent))
                if silent:
                    silence = f"no signal from the {silent}"
                else:
                    silence = "waiting for a restart (Watchdog.restart)"
                return Held("stopped", f"stopped: {self._stop or silence}")
            if self._state == "paused" or (self._pause is not None and self._state != "human"):
                return Held("paused", self._pause or PAUSED)
            return None

    def hold(self) -> Held | None:
        """Return `held`, the reason why the robot must not move.

        A control loop calls this once per tick, and sends no command while the robot is held. After
        any stop, the loop holds the robot for at least one tick, and therefore drops the earlier
        plan.
        """
        with self._lock:
            held = self.held
            self._unseen = False
            if self._auto and not self._silent:
                self._barked = False
            return held

    @property
    def over(self) -> bool:
        """Whether the episode has been marked, and therefore ends."""
        return self._outcome is not None
