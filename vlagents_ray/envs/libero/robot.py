"""The state and actions of LIBERO's robot, a Panda arm under robosuite's OSC_POSE."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.envs.libero.benchmark_protocol import LiberoProtocol

_OPEN_M = 0.04  # a finger's travel from closed to open


def contract(protocol: LiberoProtocol) -> Contract:
    """Return the contract of an env under a protocol; names and units are those of policies for LIBERO."""
    return Contract(
        cameras={name: CameraSpec(*protocol.image_size) for name in protocol.cameras},
        state={
            "xyz_axis_angle": StateSpec(6, "m+rad"),
            "gripper_qpos": StateSpec(2, "m"),
            "joints": StateSpec(7, "rad"),
        },
        gripper=True,
        instruction=True,
        action=ActionSpec(
            dim=7,
            space="ee_pose",
            delta=True,
            rotation="axis_angle",
            frame="base",
            gripper_open=protocol.gripper_open,
            gripper_closed=protocol.gripper_closed,
            low=-1.0,
            high=1.0,
        ),
        control_hz=protocol.control_hz,
    )


def read(raw: Mapping[str, Any]) -> tuple[dict[str, np.ndarray], float]:
    """Return the state in robosuite's observation, each part (D,) float32, and the gripper in [0, 1], 1 = open."""
    fingers = raw["robot0_gripper_qpos"]
    pose = np.concatenate([raw["robot0_eef_pos"], axis_angle(raw["robot0_eef_quat"])])
    state = {"xyz_axis_angle": pose, "gripper_qpos": fingers, "joints": raw["robot0_joint_pos"]}
    gripper = min(max(float(fingers[0]) / _OPEN_M, 0.0), 1.0)
    return {name: part.astype(np.float32) for name, part in state.items()}, gripper


def to_simulator(action: np.ndarray, protocol: LiberoProtocol) -> np.ndarray:
    """An action under `protocol`, (7,), as robosuite takes it: the gripper -1 to open, 1 to close, 0 to stay.

    Closer to `gripper_open` means open, as in openvla's evaluation, which binarises, and as robosuite's own
    gripper does, of whose command only the sign counts.
    """
    middle = (protocol.gripper_open + protocol.gripper_closed) / 2
    command = np.sign((action[6] - middle) * (protocol.gripper_closed - protocol.gripper_open))
    return np.append(action[:6], command).astype(np.float64)


def axis_angle(quaternion: np.ndarray) -> np.ndarray:
    """A unit quaternion xyzw to axis times angle, (3,) rad, the angle in [0, 2 pi].

    As robosuite's `quat2axisangle`, q and -q give different ones: policies were trained on states in which
    no sign was normalised. For a gripper that points down w is near 0, and a state that chose the sign by it
    would jump.
    """
    w = min(max(float(quaternion[3]), -1.0), 1.0)
    sine = math.sqrt(1.0 - w * w)
    if math.isclose(sine, 0.0):
        return np.zeros(3)
    turned: np.ndarray = np.asarray(quaternion[:3], np.float64) * 2.0 * math.acos(w) / sine
    return turned
