"""Mappings of openpi's example clients, and of RoboArena's.

openpi's servers accept images as (H, W, 3) or (3, H, W), in uint8 or floats in [0, 1]: see `_parse_image` in its
src/openpi/policies/libero_policy.py and droid_policy.py, and `convert_image` in aloha_policy.py.
"""

from __future__ import annotations

from typing import Any

from vlagents_ray.wire.mapping.robots import ALOHA_ACTION, ALOHA_STATE, libero_state

PRESETS: dict[str, dict[str, Any]] = {
    # openpi, examples/libero/main.py
    "openpi-libero": {
        "cameras": {
            "front": {"key": "observation/image", "layout": "any"},
            "wrist": {"key": "observation/wrist_image", "layout": "any"},
        },
        **libero_state("observation/state"),
        "instruction": "prompt",
        "action_gripper": {"index": 6, "open": -1.0, "closed": 1.0},
    },
    # openpi, examples/droid/main.py; DROID's gripper reads 0 when open
    "openpi-droid": {
        "cameras": {
            "front": {"key": "observation/exterior_image_1_left", "layout": "any"},
            "wrist": {"key": "observation/wrist_image_left", "layout": "any"},
        },
        "state": {"joints": {"key": "observation/joint_position", "stop": 7}},
        "gripper": {"key": "observation/gripper_position", "open": 0.0, "closed": 1.0},
        "instruction": "prompt",
        "action_gripper": {"index": 7, "open": 0.0, "closed": 1.0},
    },
    # openpi, examples/aloha_sim/env.py
    "openpi-aloha": {
        "cameras": {
            "front": {"key": "images/cam_high", "layout": "chw"},
            "left_wrist": {"key": "images/cam_left_wrist", "layout": "chw", "optional": True},
            "right_wrist": {"key": "images/cam_right_wrist", "layout": "chw", "optional": True},
        },
        "state": ALOHA_STATE,
        "instruction": "prompt",
        "action_gripper": ALOHA_ACTION,
    },
    # BEHAVIOR-1K, OmniGibson/omnigibson/eval, evaluator.py and r1pro.yaml at c71025a: RGBA images; the proprioception
    # has 61 numbers (`PROPRIOCEPTION_INDICES` in utils/eval_utils.py), 256 in the challenge of 2025; an action has 23,
    # the grippers' from -1 (closed) to 1; no text is sent, only the task's number
    "behavior-r1pro": {
        "cameras": {
            "front": {"key": "robot_r1::robot_r1:zed_link:Camera:0::rgb", "layout": "rgba"},
            "left_wrist": {"key": "robot_r1::robot_r1:left_realsense_link:Camera:0::rgb", "layout": "rgba"},
            "right_wrist": {"key": "robot_r1::robot_r1:right_realsense_link:Camera:0::rgb", "layout": "rgba"},
        },
        "state": {"proprio": "robot_r1::proprio"},
        "instruction": "prompt|task_id",
        "info": {"task_id": "task_id"},
        "action_gripper": [{"index": 14, "open": 1.0, "closed": -1.0}, {"index": 22, "open": 1.0, "closed": -1.0}],
    },
}

ROBOARENA: dict[str, dict[str, Any]] = {
    # openpi's DROID keys, but the numbers of the cameras begin with 0
    "roboarena": {
        "cameras": {
            "front": {"key": "observation/exterior_image_0_left", "layout": "any"},
            "front_2": {"key": "observation/exterior_image_1_left", "layout": "any", "optional": True},
            "wrist": {"key": "observation/wrist_image_left", "layout": "any", "optional": True},
        },
        "state": {"joints": {"key": "observation/joint_position", "stop": 7}},
        "gripper": {"key": "observation/gripper_position", "open": 0.0, "closed": 1.0},
        "instruction": "prompt",
        "info": {"session_id": "session_id"},
        "action_gripper": {"index": 7, "open": 0.0, "closed": 1.0},
    },
}
