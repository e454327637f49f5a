"""A simulated robot that LeRobot finds with `--robot.type=mirror`. It reaches the position of an
action at once.

With `--teleop.type=mirror`, a simulated operator corrects the policy from time to time, with the
keys of LeRobot's own loop.
"""

import json
import os
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from mirror_policy import CAMERA, SIDE, colour_of

MOTORS = ("shoulder.pos", "elbow.pos", "gripper.pos")
KEYBOARD = "MIRROR_KEYBOARD"  # file descriptor to which the operator's key presses are written
# Number of the policy's actions before a correction, and of the operator's actions in a correction.
WATCHED, MOVED = 5, 3


def moved_to(move: int) -> list[float]:
    """Return the motor positions of the operator's move with that number, counted from 1."""
    return [move / 8, -move / 8, 0.5]


class Operator:
    """An operator who pauses the robot after some actions of the policy, moves it, and returns
    control. The operator waits for each change before the next key press.
    """

    def __init__(self) -> None:
        self.does, self.watched, self.moves = "watches", 0, 0
        self._last: dict[str, float] = {}

    def sees(self, action: dict[str, float]) -> None:
        """Update the operator's state with the robot's next action. LeRobot's loop repeats the last
        action while the policy is paused.
        """
        paused, self._last = action == self._last, dict(action)
        if self.does == "watches" and not paused:
            self.watched += 1
            if self.watched % WATCHED == 0:
                self._press("pauses", b" ")
        elif self.does == "pauses" and paused:
            self._press("corrects", b"\t")
        elif self.does == "ends" and paused:
            self._press("watches", b" ")

    def move(self) -> list[float]:
        """Return the next motor positions from the operator."""
        self.moves += 1
        if self.does == "corrects" and self.moves % MOVED == 0:
            self._press("ends", b"\t")
        return moved_to(self.moves)

    def _press(self, does: str, key: bytes) -> None:
        if KEYBOARD in os.environ:
            self.does = does
            os.write(int(os.environ[KEYBOARD]), key)


_operator = Operator()


@RobotConfig.register_subclass("mirror")
@dataclass
class MirrorRobotConfig(RobotConfig):
    camera: str = CAMERA
    # File with a line of JSON for each action: the observed position and the commanded one.
    log: str = ""
    actions: int = 0  # number of actions after which Ctrl-C is sent


class MirrorRobot(Robot):
    """A robot whose images all differ in colour."""

    config_class, name = MirrorRobotConfig, "mirror"
    is_connected = is_calibrated = True

    def __init__(self, config: MirrorRobotConfig) -> None:
        super().__init__(config)
        self.config, self.cameras = config, {config.camera: None}
        self.positions, self.images, self.actions = dict.fromkeys(MOTORS, 0.25), 0, 0

    @property
    def observation_features(self) -> dict[str, Any]:
        return self.action_features | dict.fromkeys(self.cameras, (SIDE, SIDE, 3))

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(MOTORS, float)

    def get_observation(self) -> dict[str, Any]:
        self.images += 1
        image = np.full((SIDE, SIDE, 3), colour_of(self.images), np.uint8)
        return self.positions | dict.fromkeys(self.cameras, image)

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        before, self.positions = self.positions, {motor: float(action[motor]) for motor in MOTORS}
        self.actions += 1
        if self.config.log:
            numbers = {"state": list(before.values()), "action": list(self.positions.values())}
            with Path(self.config.log).open("a") as log:
                log.write(
                    json.dumps({"image": self.images, "moves": _operator.moves, **numbers}) + "\n"
                )
        _operator.sees(self.positions)
        if self.actions == self.config.actions:
            os.kill(os.getpid(), signal.SIGINT)
        return action

    def connect(self, calibrate: bool = True) -> None: ...
    def calibrate(self) -> None: ...
    def configure(self) -> None: ...
    def disconnect(self) -> None: ...


@TeleoperatorConfig.register_subclass("mirror")
@dataclass
class MirrorTeleoperatorConfig(TeleoperatorConfig): ...


class MirrorTeleoperator(Teleoperator):
    """The operator's input device."""

    config_class, name = MirrorTeleoperatorConfig, "mirror"
    is_connected = is_calibrated = True
    action_features = dict.fromkeys(MOTORS, float)
    feedback_features: dict[str, Any] = {}  # noqa: RUF012 - LeRobot's

    def get_action(self) -> dict[str, Any]:
        return dict(zip(MOTORS, _operator.move(), strict=True))

    def send_feedback(self, feedback: dict[str, Any]) -> None: ...
    def connect(self, calibrate: bool = True) -> None: ...
    def calibrate(self) -> None: ...
    def configure(self) -> None: ...
    def disconnect(self) -> None: ...
