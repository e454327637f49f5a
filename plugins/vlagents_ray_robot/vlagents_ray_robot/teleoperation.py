"""Devices with which an operator moves a robot: leaders for `ChunkPlayer(..., override=leader)`."""

from __future__ import annotations

import contextlib
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from vlagents_ray.chunking.control import Leader
from vlagents_ray.columns import Columns
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError, MissingState
from vlagents_ray.interface import Obs
from vlagents_ray.registry import require
from vlagents_ray.robot.terminal import Terminal
from vlagents_ray_robot import DISTRIBUTION

__all__ = ["AxesDevice", "AxesLeader", "Keyboard", "SpaceMouse"]

_FULLY_OPEN = 0.9  # minimum opening of a gripper that counts as empty


class AxesDevice(ABC):
    """A device with axes; its methods return at once."""

    _presses = 0  # the number of presses of the gripper's button
    _taken = False  # whether the operator has taken over

    @abstractmethod
    def engaged(self) -> bool:
        """Read the device, and return whether the operator moves the robot."""

    @abstractmethod
    def axes(self) -> np.ndarray:
        """Return x, y, z, roll, pitch and yaw from the last reading, (6,), each in [-1, 1]."""

    def gripper_presses(self) -> int:
        """Return the number of presses of the gripper's button since the last call."""
        presses, self._presses = self._presses, 0
        return presses

    def help(self, *, joints: bool) -> str:
        """Return a line that explains the device to the operator.

        Args:
            joints: Whether the axes move joints.
        """
        return ""

    def __enter__(self) -> AxesDevice:
        return self

    def __exit__(self, *exc: object) -> None:  # noqa: B027 - not every device needs closing
        """Close the device."""

    @classmethod
    @contextlib.contextmanager
    def open_leader(
        cls,
        contract: Contract | None,
        *,
        step: float | None = None,
        measure: Callable[[Obs], np.ndarray] | None = None,
    ) -> Iterator[Leader]:
        """Open the device as a leader.

        Args:
            contract: The contract of the policy or the environment.
            step: The change of a number of the action per tick at the full deflection of an axis;
                None takes the change from the contract.
            measure: Returns the robot's measured pose, (D,), in an observation; None reads the
                state's part `joints`.

        Yields:
            The leader, an `AxesLeader`.
        """
        with cls() as device:
            yield AxesLeader(contract, device, step=step, measure=measure)


class AxesLeader:
    """A leader that turns the axes of a device into actions.

    Axis i moves number i of the action: for relative actions of an end effector these are x, y, z
    and, if the action has them, rotations; otherwise the first six joints. A button opens and
    closes the gripper, see `Columns`; a gripper whose open and closed values are not declared is a
    number like the others. At a takeover, a gripper keeps its last command. Without a command, it
    stays open if it is measured as fully open; otherwise it is closed, as it may hold something.

    Args:
        contract: The policy's contract, which declares `action.dim` and whether actions are
            relative.
        device: The device.
        step: The change of a number per tick at the full deflection of an axis, in the action's
            units; default: half of the action's bound, if actions are relative and bounded.
        measure: Returns the robot's pose in an observation, (D,) in the action's order and units,
            with or without the gripper, at which absolute targets begin; default: the state's part
            `joints`.

    Raises:
        ConfigError: The contract is incomplete, or has several grippers, which a single button
            cannot operate; or `step` is missing or not above 0.
    """

    def __init__(
        self,
        contract: Contract | None,
        device: AxesDevice,
        *,
        step: float | None = None,
        measure: Callable[[Obs], np.ndarray] | None = None,
    ) -> None:
        spec = None if contract is None else contract.action
        if spec is None or spec.dim is None or spec.relative is None:
            raise ConfigError(
                "teleoperation: expected an action with `dim` and `delta` (whether it is "
                f"relative) in the contract, got {spec}; set both in the policy's contract, or "
                "serve noop with `--set delta=false`"
            )

        if step is None and spec.relative and spec.low is not None and spec.high is not None:
            step = min(abs(spec.low), abs(spec.high)) / 2
        if step is None or not step > 0:
            raise ConfigError(
                f"step: expected the change of a number per tick, above 0, got {step}; set it, "
                "as the contract has no bounds of relative actions to compute it from"
            )

        self._spec = spec
        self._device = device
        self._step = step
        self._columns = Columns.from_spec(spec, spec.dim)
        self._button = _button_column(self._columns)  # the gripper that the button operates
        self._measure = measure
        self._engaged = False
        # The last command of the robot, (D,), whose grippers are kept; None if it is unknown.
        self._last: np.ndarray | None = None
        self._target: np.ndarray | None = None  # the last target, (D,), if actions are absolute

    @property
    def help(self) -> str:
        """A line that explains the device to the operator; "" if the device needs no
        explanation.
        """
        moves_joints = self._spec.space in (None, "joint") and not self._spec.relative
        return self._device.help(joints=moves_joints)

    def engaged(self) -> bool:
        """Read the device, and return whether the operator moves the robot."""
        engaged = self._device.engaged()
        if engaged and not self._engaged:  # the beginning of a takeover
            self.begin(None)
        self._engaged = engaged
        return engaged

    def join(self, arm: ActionSpec) -> None:
        """Join the arm's description of its grippers to the policy's.

        Args:
            arm: The actions of the robot's contract.

        Raises:
            ConfigError: The robot has several grippers, which a single button cannot operate.
        """
        self._columns = Columns.from_spec(self._spec, self._columns.dim, arm)
        self._button = _button_column(self._columns)

    def begin(self, last: np.ndarray | None) -> None:
        """Begin a takeover.

        Args:
            last: The last command, (D,), whose grippers are kept; None if there is none.
        """
        self._last = None if last is None else np.array(last, np.float32)
        self._target = None

    def rebase(self, last: np.ndarray | None) -> None:
        """Begin the next absolute target at another pose.

        Args:
            last: The last command, (D,); None for the measured pose.
        """
        self._target = None if last is None else np.array(last, np.float32)
        if self._target is not None and self._last is not None:
            pressed = self._last[self._button] if self._button is not None else None
            self._last = self._target.copy()
            if pressed is not None:
                self._last[self._button] = pressed  # the operator's press still applies

    def action(self, obs: Obs) -> np.ndarray:
        """Return the action of the axes at the last reading, (D,) float32.

        Raises:
            MissingState: The observation has no pose at which an absolute target begins.
        """
        spec, dim = self._spec, self._columns.dim
        moved = [column for column in range(dim) if column != self._button]
        axes = self._device.axes()[: len(moved)]
        motion = np.zeros(dim, np.float32)
        motion[moved[: len(axes)]] = self._step * axes

        if self._target is None:
            self._target = self._start(obs)
        action = self._columns.moved(self._target, motion.tolist())
        if not spec.relative and (spec.low is not None or spec.high is not None):
            action = np.clip(action, spec.low, spec.high)
        if self._button is not None:
            action[self._button] = self._gripper_command(obs)

        self._target = self._last = action
        return action.copy()

    def _gripper_command(self, obs: Obs) -> float:
        """Return the command of the gripper that the button opens and closes."""
        opened = float(self._columns.gripper_open or 0.0)
        closed = float(self._columns.gripper_closed or 0.0)
        if self._last is not None and self._button is not None:
            command = float(self._last[self._button])
        else:
            is_open = obs.gripper is not None and obs.gripper >= _FULLY_OPEN
            command = opened if is_open else closed

        if self._device.gripper_presses() % 2:
            is_open = abs(command - opened) < abs(command - closed)
            command = closed if is_open else opened
        return command

    def _start(self, obs: Obs) -> np.ndarray:
        """Return the pose at which absolute targets begin, (D,) float32. Its grippers have their
        last commands, if these are known.
        """
        dim, grippers = self._columns.dim, list(self._columns.grippers)
        pose = np.zeros(dim, np.float32) if self._last is None else self._last.copy()
        others = [column for column in range(dim) if column not in grippers]
        is_needed = any(column in others for column in self._columns.absolute)
        if self._last is None and grippers and self._button is None:
            is_needed = True
        if not is_needed:
            return pose

        measured = self._measured(obs)
        has_goals = self._last is not None or self._button is not None
        if measured.shape == (dim,):
            pose[others] = measured[others]
            if self._last is None:
                pose[grippers] = measured[grippers]
        elif measured.shape == (len(others),) and has_goals:
            pose[others] = measured
        else:
            raise ConfigError(
                f"measure: expected the pose of an action, ({dim},), at which its targets begin, "
                f"got {measured.shape}; give a function that returns it (--measure)"
            )
        return pose

    def _measured(self, obs: Obs) -> np.ndarray:
        """Return the measured pose, with or without the grippers."""
        if self._measure is not None:
            return np.array(self._measure(obs), np.float32)
        if "joints" not in obs.state:
            raise MissingState("joints", obs.state)
        return np.array(obs.state["joints"], np.float32)


def _button_column(columns: Columns) -> int | None:
    """Return the column of the gripper that a button opens and closes; None if there is no gripper,
    or if its open and closed values are not declared.

    Raises:
        ConfigError: There are several grippers, or only one of the values is declared.
    """
    ends = (columns.gripper_open, columns.gripper_closed)
    if ends == (None, None) or not columns.grippers:
        return None
    if len(columns.grippers) > 1:
        raise ConfigError(
            f"teleoperation: expected at most one gripper, got the columns "
            f"{list(columns.grippers)}; the device has one button, and would move a gripper that "
            "the operator does not see to; write a leader for both arms"
        )
    if None in ends:
        raise ConfigError(
            "teleoperation: expected both `gripper_open` and `gripper_closed` in the contract's "
            f"action, got {ends[0]} and {ends[1]}; declare both in the policy's contract"
        )
    return columns.grippers[0]


# A keyboard as a device with axes. It is read from the terminal, so that it also works over SSH.

# The time for which a key counts as pressed. Terminals report no release, but repeat a key that
# stays pressed.
HOLD_S = 0.2
# The axis and the direction by key.
AXES = {"w": (0, 1), "s": (0, -1), "a": (1, 1), "d": (1, -1), "r": (2, 1), "f": (2, -1)}
AXES |= {"o": (3, 1), "u": (3, -1), "i": (4, 1), "k": (4, -1), "j": (5, 1), "l": (5, -1)}
GRIPPER, TAKE = " ", "\n"
HELP = (
    "w/s a/d r/f move along x, y, z and take over; u/o i/k j/l turn; space opens and closes the "
    "gripper; Enter takes over and gives back"
)
JOINTS_HELP = (
    "w/s a/d r/f o/u i/k j/l move joints 1 to 6 and take over; space opens and closes the gripper; "
    "Enter takes over and gives back"
)


class Keyboard(AxesDevice):
    """The keys of a terminal as six axes; any axis key takes over, Enter takes over or gives back.

        with Keyboard() as device:
            player = ChunkPlayer(agent, override=AxesLeader(agent.contract, device))

    Args:
        keys: Further keys, each with a function that the thread of the control loop calls.
        terminal: The file descriptor of the terminal; default: the one of standard input.

    Raises:
        ConfigError: A key is used twice, or there is no terminal.
    """

    def __init__(
        self, keys: Mapping[str, Callable[[], object]] | None = None, *, terminal: int | None = None
    ) -> None:
        self._keys = dict(keys or {})
        used_twice = sorted(self._keys.keys() & {*AXES, GRIPPER, TAKE})
        if used_twice:
            raise ConfigError(
                f"keyboard: expected keys that move nothing, got {used_twice}, which move the "
                "robot; choose others"
            )

        self._terminal = Terminal(terminal)
        # The time until which the key of an axis and a direction counts as pressed, s of
        # `time.monotonic`.
        self._until = np.zeros((6, 2))
        self._open = contextlib.ExitStack()

    def __enter__(self) -> Keyboard:
        self._open.enter_context(self._terminal.keys_at_once())
        self._open.enter_context(self._terminal.consumed_by(self._press))
        return self

    def __exit__(self, *exc: object) -> None:
        self._open.close()

    def engaged(self) -> bool:
        if not self._terminal.read(self._press):
            raise ConnectionError("the terminal is closed")
        return self._taken

    def axes(self) -> np.ndarray:
        """Return the axes whose keys are pressed, (6,), each -1, 0 or 1."""
        pressed = self._until > time.monotonic()
        return pressed[:, 0].astype(np.float32) - pressed[:, 1]

    def help(self, *, joints: bool) -> str:
        return JOINTS_HELP if joints else HELP

    def _press(self, key: str) -> bool:
        """Handle a key; return whether it has a meaning."""
        if key in AXES:
            axis, sign = AXES[key]
            direction = 0 if sign > 0 else 1
            self._until[axis, direction] = time.monotonic() + HOLD_S
            self._until[axis, 1 - direction] = 0.0
            self._taken = True
        elif key == GRIPPER:
            self._presses += 1
            self._taken = True
        elif key == TAKE:
            self._taken = not self._taken
            self._until[:] = 0.0
        elif key in self._keys:
            self._keys[key]()
        else:
            return False
        return True


# A SpaceMouse as a device with axes, which needs the extra "spacemouse".

# An axis within this share of its range counts as 0, as the cap never rests exactly in the middle.
_DEAD = 0.1
# Maximum number of reports that are read at one tick, as the device sends more reports than a loop
# has ticks.
_REPORTS = 64


class SpaceMouse(AxesDevice):
    """The cap of a SpaceMouse as six axes: forward, left and up are +x, +y, +z, as in ROS (REP
    103).

    Moving the cap takes over. The first button opens and closes the gripper, the last button takes
    over or gives back.

    Raises:
        ConfigError: There is no such device, or this user may not read it.
        MissingDependency: The extra "spacemouse" is not installed.
    """

    def __init__(self) -> None:
        try:
            library: Any = require("pyspacemouse", extra="spacemouse", distribution=DISTRIBUTION)
            self._device: Any = library.open(axis_convention=library.AxisConvention.ROS)
        except (OSError, RuntimeError) as error:  # The library loads hidapi, which may fail.
            raise ConfigError(
                f"SpaceMouse: {error}; plug one in, install hidapi (Debian: libhidapi-hidraw0), "
                "and let this user read its /dev/hidraw"
            ) from error
        self._axes = np.zeros(6, np.float32)
        self._buttons: list[int] = []

    def __exit__(self, *exc: object) -> None:
        self._device.close()

    def engaged(self) -> bool:
        """Read the device's reports, and return whether the operator moves the robot."""
        last_report = None
        for _ in range(_REPORTS):
            state = self._device.read()
            if state.t == last_report:
                break
            last_report = state.t

            last_buttons = self._buttons or [0] * len(state.buttons)
            self._buttons = list(state.buttons)
            pressed = [now > last for now, last in zip(self._buttons, last_buttons, strict=True)]
            if pressed and pressed[0]:
                self._presses += 1
                self._taken = True
            if len(pressed) > 1 and pressed[-1]:
                self._taken = not self._taken

        axes = np.array([state.x, state.y, state.z, state.roll, state.pitch, state.yaw], np.float32)
        self._axes = np.where(np.abs(axes) < _DEAD, 0, np.clip(axes, -1, 1)).astype(np.float32)
        self._taken = self._taken or bool(self._axes.any())
        return self._taken

    def axes(self) -> np.ndarray:
        return self._axes


# The functions that open the leaders "keyboard" and "spacemouse"; see
# `vlagents_ray.robot.leaders.OpenLeader`.
open_keyboard = Keyboard.open_leader
open_spacemouse = SpaceMouse.open_leader
