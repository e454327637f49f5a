"""The mappings of known clients, by name. Units and orders are those of each system's own examples."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.wire.mapping import KeyMapping

# End effector in LIBERO's base frame: position in m, axis-angle in rad; two finger joints, 0.04 m when open.
_LIBERO_STATE = {
    "xyz_axis_angle": {"key": "{state}", "stop": 6},
    "gripper_qpos": {"key": "{state}", "start": 6, "stop": 8},
}
_LIBERO_GRIPPER = {"key": "{state}", "index": 6, "open": 0.04, "closed": 0.0}
_LIBERO_ACTION = {"index": 6, "open": -1.0, "closed": 1.0}


def _with_state(template: Any, key: str) -> Any:
    if isinstance(template, Mapping):
        return {name: _with_state(value, key) for name, value in template.items()}
    return key if template == "{state}" else template


_JSON: dict[str, dict[str, Any]] = {
    # openpi, examples/libero/main.py
    "openpi-libero": {
        "cameras": {"front": "observation/image", "wrist": "observation/wrist_image"},
        "state": _with_state(_LIBERO_STATE, "observation/state"),
        "gripper": _with_state(_LIBERO_GRIPPER, "observation/state"),
        "instruction": "prompt",
        "action_gripper": _LIBERO_ACTION,
    },
    # openpi, examples/droid/main.py; DROID's gripper reads 0 when open
    "openpi-droid": {
        "cameras": {
            "front": "observation/exterior_image_1_left",
            "wrist": "observation/wrist_image_left",
        },
        "state": {"joints": {"key": "observation/joint_position", "stop": 7}},
        "gripper": {"key": "observation/gripper_position", "open": 0.0, "closed": 1.0},
        "instruction": "prompt",
        "action_gripper": {"index": 7, "open": 0.0, "closed": 1.0},
    },
    # openpi, examples/aloha_sim/env.py; six joints in rad and one gripper in [0, 1] an arm, left first
    "openpi-aloha": {
        "cameras": {
            "front": {"key": "images/cam_high", "layout": "chw"},
            "left_wrist": {"key": "images/cam_left_wrist", "layout": "chw", "optional": True},
            "right_wrist": {"key": "images/cam_right_wrist", "layout": "chw", "optional": True},
        },
        "state": {
            "left/joints": {"key": "state", "stop": 6},
            "left/gripper": {"key": "state", "start": 6, "stop": 7},
            "right/joints": {"key": "state", "start": 7, "stop": 13},
            "right/gripper": {"key": "state", "start": 13, "stop": 14},
        },
        "instruction": "prompt",
        "action_gripper": [{"index": 6}, {"index": 13}],
    },
    # RoboArena: openpi's DROID keys with the cameras' numbers from 0
    "roboarena": {
        "cameras": {
            "front": "observation/exterior_image_0_left",
            "front_2": {"key": "observation/exterior_image_1_left", "optional": True},
            "wrist": {"key": "observation/wrist_image_left", "optional": True},
        },
        "state": {"joints": {"key": "observation/joint_position", "stop": 7}},
        "gripper": {"key": "observation/gripper_position", "open": 0.0, "closed": 1.0},
        "instruction": "prompt",
        "info": {"session_id": "session_id"},
        "action_gripper": {"index": 7, "open": 0.0, "closed": 1.0},
    },
    # openvla, vla-scripts/deploy.py
    "openvla": {
        "cameras": {"front": "image"},
        "instruction": "instruction",
        "info": {"unnorm_key": "unnorm_key"},
        "action_gripper": {"index": 6, "open": 1.0, "closed": 0.0},
    },
    # openvla-oft: observations as in experiments/robot/libero; vla-scripts/deploy.py answers what the model gives, 1 =
    # open, which its clients turn into LIBERO's -1 themselves (normalize_gripper_action, invert_gripper_action)
    "openvla-oft": {
        "cameras": {"front": "full_image", "wrist": {"key": "wrist_image", "optional": True}},
        "state": _with_state(_LIBERO_STATE, "state"),
        "gripper": _with_state(_LIBERO_GRIPPER, "state"),
        "instruction": "instruction",
        "info": {"unnorm_key": "unnorm_key"},
        "action_gripper": {"index": 6, "open": 1.0, "closed": 0.0},
    },
    # GR00T N1.6 and newer: {"video": {k: (1, T, H, W, 3)}, "state": {k: (1, T, D)}, "language": {"task": [[text]]}};
    # how an action's columns are named depends on the robot, so a deployment adds `action`
    "gr00t": {
        "cameras": {"*": "video/*"},
        "state": {"*": "state/*"},
        "instruction": "language/*",
    },
    # GR00T N1.5: the same with flat keys
    "gr00t-n1.5": {
        "cameras": {"*": "video.*"},
        "state": {"*": "state.*"},
        "instruction": "annotation.human.*",
    },
    # vla-eval, types.py: the benchmark chooses the cameras' names
    "vla-eval": {
        "cameras": {"*": "images/*"},
        "state": {"state": {"key": "state", "optional": True}},
        "instruction": "task_description",
    },
    # ours, by name, for clients that take a mapping and have no names of their own
    "vlagents": {
        "cameras": {"*": "cameras/*"},
        "state": {"*": "state/*"},
        "gripper": {"key": "gripper", "optional": True},
        "instruction": "instruction",
        "info": {"info": "info"},
    },
}

PRESETS: dict[str, KeyMapping] = {name: KeyMapping.from_json(mapping) for name, mapping in _JSON.items()}


def read_mapping(value: str | Mapping[str, Any]) -> KeyMapping:
    """A mapping as a deployment file states it: a preset's name, or an object, whose `preset` names what it changes.

    What such an object states replaces that part of the preset. Raises `ConfigError`.
    """
    if isinstance(value, str):
        return _preset(value)
    if not isinstance(value, Mapping):
        raise ConfigError(f"mapping: got {type(value).__name__}, want a preset's name or an object")
    own = dict(value)
    base = _preset(own.pop("preset")).to_json() if "preset" in own else {}
    return KeyMapping.from_json(base | own)


def _preset(name: object) -> KeyMapping:
    if not isinstance(name, str) or name not in PRESETS:
        raise ConfigError(f"mapping: got {name!r}, want one of the presets {sorted(PRESETS)}, or an object")
    return PRESETS[name]
