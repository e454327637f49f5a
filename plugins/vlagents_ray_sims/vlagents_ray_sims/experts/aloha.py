"""An expert for ALOHA's two tasks, from the simulator's state."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vlagents_ray.errors import ContractMismatch, MissingState, NotReset
from vlagents_ray.interface import Act, Obs
from vlagents_ray.policies.experts import sim_vector
from vlagents_ray.registry import env_task

_SHOULDER = 0.12705  # height of the shoulder's axis over the table, m
# From the shoulder to the elbow with all joints at 0: forward, up, m.
_UPPER = np.array([0.05955, 0.3])
_FOREARM = 0.3  # from the elbow to the wrist's axis, m
_HAND = 0.2  # from the wrist's axis to between the fingers' pads, m
# x, y, m, and the direction that the arm faces.
_BASES = {"left": (-0.469, 0.5, 1.0), "right": (0.469, 0.5, -1.0)}
_OPEN, _CLOSED = 1.0, 0.0
_TILT = math.radians(60)  # of a hand that grasps from above, so that it does not hit the other one
_OBJECTS = {"transfer_cube": 7, "insertion": 14}  # numbers of `info["sim_state"]`


@dataclass(frozen=True, slots=True)
class HandPose:
    """Target of the fingers' pads, and orientation of the hand."""

    xyz: tuple[float, float, float]  # m, in the world's frame
    pitch: float  # of the hand below the horizontal, rad
    roll: float = 0.0  # about the hand's own axis, rad
    gripper: float = _OPEN


def joints(arm: str, pose: HandPose) -> list[float]:
    """Return the joint angles of an arm and its gripper's position, 7 numbers; the nearest ones
    if out of reach.
    """
    base_x, base_y, facing = _BASES[arm]
    x, y = facing * (pose.xyz[0] - base_x), facing * (pose.xyz[1] - base_y)
    out = math.hypot(x, y) - _HAND * math.cos(pose.pitch)
    up = pose.xyz[2] - _SHOULDER + _HAND * math.sin(pose.pitch)
    upper, away = math.hypot(*_UPPER), math.hypot(out, up)
    cosine = (upper**2 + away**2 - _FOREARM**2) / (2 * upper * away)
    # Of the upper arm, from the vertical.
    raised = math.atan2(out, up) - math.acos(min(max(cosine, -1.0), 1.0))
    # Of the forearm.
    below = math.atan2(upper * math.cos(raised) - up, out - upper * math.sin(raised))
    shoulder = raised - math.atan2(*_UPPER)
    return [
        math.atan2(y, x),
        shoulder,
        below - shoulder,
        0.0,
        pose.pitch - below,
        pose.roll,
        pose.gripper,
    ]


Waypoints = list[tuple[int, HandPose]]
"""The steps at which a hand is to be in each pose."""


class AlohaExpert:
    """Moves each hand along waypoints over the objects, which it finds in `info["sim_state"]`;
    actions are (14,).
    """

    def __init__(self, env_name: str) -> None:
        self._task = env_task(env_name) or "transfer_cube"
        if self._task not in _OBJECTS:
            raise ContractMismatch(
                f"no expert for {env_name!r}: want one of {[f'aloha/{task}' for task in _OBJECTS]}"
            )
        self._way: dict[str, list[tuple[int, np.ndarray]]] = {}
        self._step = 0

    def reset(self, obs: Obs, instruction: str) -> None:
        objects = sim_vector(obs, _OBJECTS[self._task], f"aloha/{self._task}")
        plan = (_transfer if self._task == "transfer_cube" else _insertion)(objects)
        self._way = {
            arm: [
                (0, _now(obs, arm)),
                *((step, np.array(joints(arm, pose))) for step, pose in plan[arm]),
            ]
            for arm in _BASES
        }
        self._step = 0

    def act(self, obs: Obs) -> Act:
        if not self._way:
            raise NotReset("aloha expert: act before reset; call reset(obs, instruction) first")
        self._step += 1
        return Act(
            np.concatenate([_at(self._way[arm], self._step) for arm in _BASES]).astype(np.float32)
        )


def _transfer(objects: np.ndarray) -> dict[str, Waypoints]:
    """Let the right hand lift the cube to the middle, and the left hand, turned by 90 degrees,
    take it.
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
    """Lift the peg with the right hand and the socket with the left one, and move them together."""
    peg, socket = objects[:2], objects[7:9]
    # The peg is grasped 2 cm lower than the socket.
    held = {"right": (peg, 1.0, 0.22), "left": (socket, -1.0, 0.2)}
    return {
        arm: [
            *_grasp(x, y, 10),
            (230, HandPose((side * 0.1, 0.5, height), _TILT, gripper=_CLOSED)),
            (360, HandPose((side * 0.03, 0.5, height), _TILT, gripper=_CLOSED)),
        ]
        for arm, ((x, y), side, height) in held.items()
    }


def _grasp(x: float, y: float, later: int) -> Waypoints:
    """Return waypoints above the object, at it, and with closed fingers."""
    return [
        (70 + later, HandPose((x, y, 0.12), _TILT)),
        (110 + later, HandPose((x, y, 0.02), _TILT)),
        (140 + later, HandPose((x, y, 0.02), _TILT, gripper=_CLOSED)),
    ]


def _now(obs: Obs, arm: str) -> np.ndarray:
    """Return the arm's joint angles and its gripper's position, (7,)."""
    parts = [f"{arm}/{part}" for part in ("joints", "gripper")]
    for part in parts:
        if part not in obs.state:
            raise MissingState(part, have=obs.state)
    return np.concatenate([obs.state[part] for part in parts])


def _at(way: list[tuple[int, np.ndarray]], step: int) -> np.ndarray:
    """Return the command of a step, (7,), between the poses before and after it."""
    steps = [at for at, _ in way]
    return np.array(
        [np.interp(step, steps, [pose[i] for _, pose in way]) for i in range(len(way[0][1]))]
    )
