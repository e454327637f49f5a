"""A simulated robot as LeRobot finds it, `--robot.type=mirror`: it is at once where an action sends it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.robots import Robot, RobotConfig
from mirror_policy import CAMERA, SIDE, colour_of

MOTORS = ("shoulder.pos", "elbow.pos", "gripper.pos")


@RobotConfig.register_subclass("mirror")
@dataclass
class MirrorRobotConfig(RobotConfig):
    camera: str = CAMERA


class MirrorRobot(Robot):
    """Each of its images has another colour."""

    config_class, name = MirrorRobotConfig, "mirror"
    is_connected = is_calibrated = True

    def __init__(self, config: MirrorRobotConfig) -> None:
        super().__init__(config)
        self.cameras = {config.camera: None}
        self.positions, self.images = dict.fromkeys(MOTORS, 0.25), 0

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
        self.positions = {motor: float(action[motor]) for motor in MOTORS}
        return action

    def connect(self, calibrate: bool = True) -> None: ...
    def calibrate(self) -> None: ...
    def configure(self) -> None: ...
    def disconnect(self) -> None: ...
