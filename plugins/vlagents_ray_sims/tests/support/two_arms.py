"""A scene with two arms, as a user would register it: RCS's own FR3, twice, 80 cm apart."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium
import numpy as np
import rcs
from rcs.envs.configs import EmptyWorldFR3
from rcs.envs.tasks import PickTaskConfig

SIDES = {"left": 0.4, "right": -0.4}  # position along y, m


class TwoArms(EmptyWorldFR3):
    """A scene in which the right arm picks up a cuboid; success is that of RCS's own pick task."""

    robot_prefix_template = "robot{robot_name}_"
    gripper_prefix_template = "gripper{robot_name}_"

    def config(self) -> Any:
        config = super().config()
        for part in ("robot_cfgs", "gripper_cfgs", "gripper_offsets"):
            [one] = getattr(config, part).values()
            setattr(config, part, {side: copy.copy(one) for side in SIDES})
        config.robot_to_shared_base_frame = {
            side: rcs.common.Pose(translation=np.array([0.0, y, 0.0])) for side, y in SIDES.items()
        }
        del config.camera_adds["wrist"], config.camera_cfgs["wrist"]
        config.task_cfg = PickTaskConfig(robot_name="right")
        return config


gymnasium.register(id="lab/two_arms", entry_point=TwoArms())
