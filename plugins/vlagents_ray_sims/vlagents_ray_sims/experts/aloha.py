"""A scripted expert for ALOHA's two tasks, which reads the simulator's state."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vlagents_ray.errors import ContractMismatch, MissingState, NotReset
from vlagents_ray.interface import Act, Obs
from vlagents_ray.policies.experts import sim_vector
from vlagents_ray.registry import env_task

_SHOULDER = 0.12705  # height of the shoulder's axis over the table, m
# Vector from the shoulder to the elbow when all joints are at 0: forward and up, m.
_UPPER = np.array([0.05955, 0.3])
_FOREARM = 0.3  # from the elbow to the wrist's axis, m
_HAND = 0.2  # from the wrist's axis to the middle between the fingers' pads, m
# Position of the base, x and y, m, and the direction along x that the arm faces.
_BASES = {"left": (-0.469, 0.5, 1.0), "right": (0.469, 0.5, -1.0)}
_OPEN, _CLOSED = 1.0, 0.0
# Pitch of a hand that grasps from above; at this pitch it does not hit the other hand.
_TILT = math.radians(60)
_SIM_STATE_SIZES = {"transfer_cube": 7, "insertion": 14}  # the length of `info["sim_state"]`


@dataclass(frozen=True, slots=True)
class HandPose:
    """Target of the fingers' pads, and orientation of the hand."""

    xyz: tuple[float, float, float]  # position, m, in the world frame
    pitch: float  # pitch, rad, from the horizontal downwards
    roll: float = 0.0  # roll, rad, about the hand's own axis
    gripper: float = _OPEN


def joints(arm: str, pose: HandPose) -> list[float]:
    """Compute the joints of an arm whose hand is in a pose.

    Args:
        arm: "left" or "right".
        pose: The pose of the hand.

    Returns:
        The six joint angles, rad, and the gripper's position. If the pose is out of reach, these
        are the joints of the nearest pose.
    """
    base_x, base_y, facing = _BASES[arm]
    x, y = facing * (pose.xyz[0] - base_x), facing * (pose.xyz[1] - base_y)

    # Position of the wrist relative to the shoulder, in the vertical plane of the arm, m.
    forward = math.hypot(x, y) - _HAND * math.cos(pose.pitch)
    up = pose.xyz[2] - _SHOULDER + _HAND * math.sin(pose.pitch)

    # The triangle of shoulder, elbow and wrist, by the law of cosines.
    upper_arm, distance = math.hypot(*_UPPER), math.hypot(forward, up)
    cosine = (upper_arm**2 + distance**2 - _FOREARM**2) / (2 * upper_arm * distance)
    at_shoulder = math.acos(min(max(cosine, -1.0), 1.0))

    # The upper arm from the vertical, and the forearm below the horizontal, rad.
    upper_arm_angle = math.atan2(forward, up) - at_shoulder
    forearm_angle = math.atan2(
        upper_arm * math.cos(upper_arm_angle) - up,
        forward - upper_arm * math.sin(upper_arm_angle),
    )

    shoulder = upper_arm_angle - math.atan2(*_UPPER)
    return [
        math.atan2(y, x),  # waist
        shoulder,
        forearm_angle - shoulder,  # elbow
        0.0,  # forearm roll
        pose.pitch - forearm_angle,  # wrist
        pose.roll,
        pose.gripper,
    ]


Waypoints = list[tuple[int, HandPose]]
"""The poses of a hand, each with the step at which the hand has to reach it."""


class AlohaExpert:
    """Moves each hand along waypoints at the objects; actions are (14,).

    The positions of the objects are read from `info["sim_state"]`.
    """

    def __init__(self, env_name: str) -> None:
        self._task = env_task(env_name) or "transfer_cube"
        if self._task not in _SIM_STATE_SIZES:
            envs = [f"aloha/{task}" for task in _SIM_STATE_SIZES]
            raise ContractMismatch(
                f"expected an env with an expert, one of {envs}, got {env_name!r}"
            )
        # For each arm: the steps and the commands, (7,), between which the arm moves.
        self._commands: dict[str, list[tuple[int, np.ndarray]]] = {}
        self._step = 0

    def reset(self, obs: Obs, instruction: str) -> None:
        objects = sim_vector(obs, _SIM_STATE_SIZES[self._task], f"aloha/{self._task}")
        plan = _transfer if self._task == "transfer_cube" else _insertion
        waypoints = plan(objects)

        for arm in _BASES:
            self._commands[arm] = [(0, _current_joints(obs, arm))]
            for step, pose in waypoints[arm]:
                self._commands[arm].append((step, np.array(joints(arm, pose))))
        self._step = 0

    def act(self, obs: Obs) -> Act:
        if not self._commands:
            raise NotReset(
                "aloha expert: act was called before reset; call reset(obs, instruction) first"
            )
        self._step += 1
        commands = [_interpolate(self._commands[arm], self._step) for arm in _BASES]
        return Act(np.concatenate(commands).astype(np.float32))


def _transfer(objects: np.ndarray) -> dict[str, Waypoints]:
    """Return waypoints for both arms: the right hand lifts the cube, and the left hand grasps it.

    The hands meet in the middle, where the left hand is rolled by 90 degrees.

    Args:
        objects: (7,), the pose of the cube.
    """
    x, y = objects[:2]
    middle, side = (0.0, 0.5, 0.25), math.pi / 2
    return {
        "right": [*_grasp(x, y, 0), (230, HandPose(middle, _TILT, gripper=_CLOSED))],
        "left": [
            (230, HandPose((-0.12, 0.5, 0.25), 0.0, side)),
            (290, HandPose(middle, 0.0, side)),
            (320, HandPose(middle, 0.0, side, _CLOSED)),
        ],
    }


def _insertion(objects: np.ndarray) -> dict[str, Waypoints]:
    """Return waypoints for both arms, which lift the peg and the socket and move them together.

    Args:
        objects: (14,), the poses of peg and socket.
    """
    peg_x, peg_y = objects[:2]
    socket_x, socket_y = objects[7:9]
    # The peg is grasped 2 cm lower than the socket, so the peg's hand is 2 cm higher when the two
    # meet.
    return {
        "right": [*_grasp(peg_x, peg_y, 10), *_join(1.0, 0.22)],
        "left": [*_grasp(socket_x, socket_y, 10), *_join(-1.0, 0.2)],
    }


def _join(side: float, height: float) -> Waypoints:
    """Return waypoints from one side of the middle, 1 right or -1 left, towards the middle."""
    return [
        (230, HandPose((side * 0.1, 0.5, height), _TILT, gripper=_CLOSED)),
        (360, HandPose((side * 0.03, 0.5, height), _TILT, gripper=_CLOSED)),
    ]


def _grasp(x: float, y: float, delay_steps: int) -> Waypoints:
    """Return waypoints above the object, at the object, and at the object with closed fingers."""
    return [
        (70 + delay_steps, HandPose((x, y, 0.12), _TILT)),
        (110 + delay_steps, HandPose((x, y, 0.02), _TILT)),
        (140 + delay_steps, HandPose((x, y, 0.02), _TILT, gripper=_CLOSED)),
    ]


def _current_joints(obs: Obs, arm: str) -> np.ndarray:
    """Return the arm's joint angles and its gripper's position, (7,)."""
    names = (f"{arm}/joints", f"{arm}/gripper")
    for name in names:
        if name not in obs.state:
            raise MissingState(name, have=obs.state)
    return np.concatenate([obs.state[name] for name in names])


def _interpolate(commands: list[tuple[int, np.ndarray]], step: int) -> np.ndarray:
    """Return the command of a step, (7,), between the commands of the steps around it."""
    steps = [command_step for command_step, _ in commands]
    values = np.array([command for _, command in commands])  # (number of commands, 7)
    return np.array([np.interp(step, steps, column) for column in values.T])
