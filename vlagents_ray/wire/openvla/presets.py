"""Mappings of the clients of OpenVLA and OpenVLA-OFT."""

from __future__ import annotations

from typing import Any

from vlagents_ray.wire.mapping.robots import ALOHA_ACTION, ALOHA_STATE, libero_state

PRESETS: dict[str, dict[str, Any]] = {
    # openvla, vla-scripts/deploy.py
    "openvla": {
        "cameras": {"front": "image"},
        "instruction": "instruction",
        "info": {"unnorm_key": "unnorm_key"},
        "action_gripper": {"index": 6, "open": 1.0, "closed": 0.0},
    },
    # openvla-oft: observations as in experiments/robot/libero; vla-scripts/deploy.py replies with the model's output, 1
    # = open, which its clients convert to LIBERO's -1 themselves (normalize_gripper_action, invert_gripper_action)
    "openvla-oft": {
        "cameras": {"front": "full_image", "wrist": {"key": "wrist_image", "optional": True}},
        **libero_state("state"),
        "instruction": "instruction",
        "info": {"unnorm_key": "unnorm_key"},
        "action_gripper": {"index": 6, "open": 1.0, "closed": 0.0},
    },
    # openvla-oft, experiments/robot/aloha/run_aloha_eval.py: `state` is qpos, (14,)
    "openvla-oft-aloha": {
        "cameras": {
            "front": "full_image",
            "left_wrist": {"key": "left_wrist_image", "optional": True},
            "right_wrist": {"key": "right_wrist_image", "optional": True},
        },
        "state": ALOHA_STATE,
        "instruction": "instruction",
        "info": {"unnorm_key": "unnorm_key"},
        "action_gripper": ALOHA_ACTION,
    },
}
