"""What the clients of other systems send, by the preset that is for them: as their own code builds it.

Each names its source. `arrives` is what the preset must make of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

TASK = "put the bowl on the stove"
_RANDOM = np.random.default_rng(15)


@dataclass(frozen=True)
class Sent:
    """One observation of a client."""

    preset: str
    source: str
    observation: dict[str, Any]
    cameras: tuple[str, ...]  # that arrive
    state: dict[str, int]  # that arrive, and their sizes
    gripper: bool = False  # does it arrive?


def image(size: int = 32) -> np.ndarray:
    return _RANDOM.integers(0, 256, (size, size, 3), np.uint8)


def chw(size: int = 32) -> np.ndarray:
    return np.ascontiguousarray(image(size).transpose(2, 0, 1))


LIBERO_STATE = np.array([-0.05, 0.03, 0.91, 3.1, 0.02, -0.1, 0.0388, -0.0388])
_LIBERO = {"xyz_axis_angle": 6, "gripper_qpos": 2}
_ALOHA = {"left/joints": 6, "left/gripper": 1, "right/joints": 6, "right/gripper": 1}
_OFT = {"full_image": image(), "state": LIBERO_STATE, "instruction": TASK, "unnorm_key": "libero_spatial"}

SENT = [
    Sent(
        "openpi-libero",
        "openpi, examples/libero/main.py",
        {
            "observation/image": image(),
            "observation/wrist_image": image(),
            "observation/state": LIBERO_STATE,
            "prompt": TASK,
        },
        ("front", "wrist"),
        _LIBERO,
        gripper=True,
    ),
    Sent(
        "openpi-droid",
        "openpi, examples/droid/main.py",
        {
            "observation/exterior_image_1_left": image(),
            "observation/wrist_image_left": image(),
            "observation/joint_position": np.arange(7.0) / 10,
            "observation/gripper_position": np.array([0.4]),
            "prompt": TASK,
        },
        ("front", "wrist"),
        {"joints": 7},
        gripper=True,
    ),
    Sent(
        "openpi-aloha",
        "openpi, examples/aloha_sim/env.py",
        {"state": np.arange(14.0), "images": {"cam_high": chw()}, "prompt": TASK},
        ("front",),
        _ALOHA,
    ),
    Sent(
        "openpi-aloha",
        "openpi, examples/simple_client/main.py",
        {
            "state": np.ones((14,)),
            "images": {"cam_high": chw(), "cam_low": chw(), "cam_left_wrist": chw(), "cam_right_wrist": chw()},
            "prompt": TASK,
        },
        ("front", "left_wrist", "right_wrist"),
        _ALOHA,
    ),
    Sent(
        "roboarena",
        "roboarena, policy_server's client",
        {
            "observation/exterior_image_0_left": image(),
            "observation/exterior_image_1_left": image(),
            "observation/wrist_image_left": image(),
            "observation/joint_position": np.arange(7, dtype=np.float32) / 10,
            "observation/cartesian_position": np.zeros(6, np.float32),
            "observation/gripper_position": np.zeros(1, np.float32),
            "prompt": TASK,
            "session_id": "episode-1",
            "endpoint": "infer",
        },
        ("front", "front_2", "wrist"),
        {"joints": 7},
        gripper=True,
    ),
    Sent(
        "openvla",
        "openvla, vla-scripts/deploy.py",
        {"image": image(), "instruction": TASK, "unnorm_key": "bridge_orig"},
        ("front",),
        {},
    ),
    Sent(
        "openvla-oft",
        "openvla-oft, experiments/robot/libero/run_libero_eval.py",
        _OFT | {"wrist_image": image()},
        ("front", "wrist"),
        _LIBERO,
        gripper=True,
    ),
    Sent(
        "openvla-oft-aloha",
        "openvla-oft, experiments/robot/aloha/run_aloha_eval.py",
        _OFT | {"left_wrist_image": image(), "right_wrist_image": image(), "state": np.arange(14.0)},
        ("front", "left_wrist", "right_wrist"),
        _ALOHA,
    ),
    Sent(
        "gr00t",
        "Isaac-GR00T N1.6, its SO-100 adapter",
        {
            "video": {"front": image()[None, None], "wrist": image()[None, None]},
            "state": {"single_arm": np.zeros((1, 1, 5), np.float32), "gripper": np.zeros((1, 1, 1), np.float32)},
            "language": {"annotation.human.task_description": [[TASK]]},
        },
        ("front", "wrist"),
        {"single_arm": 5, "gripper": 1},
    ),
    Sent(
        "gr00t-n1.5",
        "Isaac-GR00T N1.5, examples/SO-100/eval_lerobot.py",
        {
            "video.front": image()[None],
            "video.wrist": image()[None],
            "state.single_arm": np.zeros((1, 5)),
            "state.gripper": np.zeros((1, 1)),
            "annotation.human.task_description": [TASK],
        },
        ("front", "wrist"),
        {"single_arm": 5, "gripper": 1},
    ),
    Sent(
        "vla-eval",
        "vla-eval 0.8.0, benchmarks/libero: send_state, send_wrist_image",
        {
            "images": {"agentview": image(), "wrist": image()},
            "task_description": TASK,
            "states": LIBERO_STATE,
            "controller_states": LIBERO_STATE.astype(np.float32) + 1,
        },
        ("agentview", "wrist"),
        {"state": 8},
    ),
    Sent(
        "vla-eval",
        "vla-eval 0.8.0, its smoke test",
        {
            "images": {"agentview": image(), "wrist": image()},
            "task_description": "smoke test",
            "state": np.zeros(8, np.float32),
        },
        ("agentview", "wrist"),
        {"state": 8},
    ),
    Sent(
        "vla-eval",
        "vla-eval 0.8.0, benchmarks/libero as it is: no state",
        {"images": {"agentview": image()}, "task_description": TASK},
        ("agentview",),
        {},
    ),
    Sent(
        "vlagents",
        "vlagents 0.3.0, as its gateway hands it to a mapping",
        {
            "cameras": {"rgb_side": image()},
            "state": {"joints": np.zeros(7), "xyzrpy": np.zeros(6)},
            "info": {},
            "gripper": 1.0,
        },
        ("rgb_side",),
        {"joints": 7, "xyzrpy": 6},
        gripper=True,
    ),
    Sent(
        "lerobot",
        "LeRobot 0.4.4, async_inference/robot_client.py with an SO-100, by the names of its features",
        {
            "observation.state": np.zeros(6, np.float32),
            "observation.images.front": image(),
            "observation.images.wrist": image(),
            "task": TASK,
        },
        ("front", "wrist"),
        {"joints": 6},
    ),
]
