"""LeRobot's own asynchronous client with a simulated arm, as a process: `python robot_client.py
PORT ACTIONS`.

It runs until the arm has performed so many actions, and prints these as JSON. As a module, it is
the arm alone.
"""

from __future__ import annotations

import json
import sys
import threading
from dataclasses import dataclass
from typing import Any

import numpy as np

JOINTS = [f"joint_{number}.pos" for number in range(6)]
CAMERA, SIDE = "top", 64
TASK = "lift"


def image() -> np.ndarray:
    return np.random.default_rng(5).integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)


def main(port: int, actions: int) -> None:
    from lerobot.async_inference.configs import RobotClientConfig
    from lerobot.async_inference.robot_client import RobotClient
    from lerobot.robots import Robot, RobotConfig

    @RobotConfig.register_subclass("simulated_arm")
    @dataclass
    class SimulatedArmConfig(RobotConfig):
        pass

    class SimulatedArm(Robot):
        """An arm that is at once where an action sends it."""

        config_class, name = SimulatedArmConfig, "simulated_arm"
        is_connected = is_calibrated = True

        def __init__(self, config: Any) -> None:
            super().__init__(config)
            self.joints, self.performed = [0.0] * len(JOINTS), list[list[float]]()

        @property
        def observation_features(self) -> dict[str, Any]:
            return self.action_features | {CAMERA: (SIDE, SIDE, 3)}

        @property
        def action_features(self) -> dict[str, Any]:
            return dict.fromkeys(JOINTS, float)

        def get_observation(self) -> dict[str, Any]:
            return dict(zip(JOINTS, self.joints, strict=True)) | {CAMERA: image()}

        def send_action(self, action: dict[str, float]) -> dict[str, float]:
            self.joints = [action[joint] for joint in JOINTS]
            self.performed.append(self.joints)
            if len(self.performed) == actions:
                client.shutdown_event.set()
            return action

        def connect(self, calibrate: bool = True) -> None: ...
        def calibrate(self) -> None: ...
        def configure(self) -> None: ...
        def disconnect(self) -> None: ...

    # LeRobot finds it beside its configuration.
    vars(sys.modules[__name__])["SimulatedArm"] = SimulatedArm
    client = RobotClient(
        RobotClientConfig(
            robot=SimulatedArmConfig(),
            server_address=f"127.0.0.1:{port}",
            policy_type="act",
            pretrained_name_or_path="me/tiny",
            actions_per_chunk=8,
            task=TASK,
            fps=60,
            chunk_size_threshold=0.0,  # asks for the next chunk when none is left
            aggregate_fn_name="latest_only",
        )
    )
    if not client.start():
        raise SystemExit("not connected")
    receiver = threading.Thread(target=client.receive_actions)
    receiver.start()
    client.control_loop(TASK)
    performed = client.robot.performed
    client.stop()
    receiver.join(30)
    print(json.dumps(performed))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
