"""Mappings that clients of several systems share: the layouts of LIBERO's and ALOHA's vectors."""

from __future__ import annotations

from typing import Any

# Six joints in rad and one gripper in [0, 1] per arm, the left arm first.
ALOHA_STATE = {
    "left/joints": {"key": "state", "stop": 6},
    "left/gripper": {"key": "state", "start": 6, "stop": 7},
    "right/joints": {"key": "state", "start": 7, "stop": 13},
    "right/gripper": {"key": "state", "start": 13, "stop": 14},
}
ALOHA_ACTION = [{"index": 6}, {"index": 13}]


def libero_state(key: str) -> dict[str, Any]:
    """Return the mapping of LIBERO's state.

    The state contains the end effector's pose in the robot's base frame (position in m, axis-angle
    in rad) and two finger joints, 0.04 m when open.

    Args:
        key: The key under which the client sends the state.
    """
    return {
        "state": {
            "xyz_axis_angle": {"key": key, "stop": 6},
            "gripper_qpos": {"key": key, "start": 6, "stop": 8},
        },
        "gripper": {"key": key, "index": 6, "open": 0.04, "closed": 0.0},
    }
