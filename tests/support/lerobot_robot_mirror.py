"""A simulated robot as LeRobot finds it, `--robot.type=mirror`: it is at once where an action sends
it.

With `--teleop.type=mirror`, its operator corrects the policy now and then, by the keys of LeRobot's
own loop.
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
KEYBOARD = "MIRROR_KEYBOARD"  # the descriptor that writes what the operator types
WATCHED, MOVED = 5, 3  # actions of the policy before a correction, and of the operator in one


def moved_to(move: int) -> list[float]:
    """Where the operator's move of that number, counted from 1, sends the motors."""
    return [move / 8, -move / 8, 0.5]


class Operator:
    """Who pauses the robot after some actions of the policy, moves it, and gives it back; waits
    for what happens.
    """

    def __init__(self) -> None:
        self.does, self.watched, self.moves = "watches", 0, 0
        self._last: dict[str, float] = {}

    def sees(self, action: dict[str, float]) -> None:
        """The robot gets an action; LeRobot's loop repeats the last one while it is paused."""
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
        """Where the operator sends the motors next."""
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
    # File with a line of JSON for each action: what it was seen to be, and where it is sent.
    log: str = ""
    actions: int = 0  # Ctrl-C after so many


class MirrorRobot(Robot):
    """Each of its images has another colour."""

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
    """What the operator moves the robot with."""

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
