"""What the experts for robosuite's OSC_POSE share: a hand that is moved to poses one after the other.

An action is (7,) for one arm: 0.05 m and 0.5 rad a unit, gripper -1 open, 1 closed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vlagents_ray.interface import Act

OPEN, CLOSED = -1.0, 1.0
_PER_RAD = 2.0  # units of the action: all of the remaining rotation
_MOST_TURN = 0.3


@dataclass(frozen=True, slots=True)
class PickPhase:
    """A phase of the motion, which ends when the hand arrives, or after `steps`."""

    name: str
    gripper: float
    steps: int
    waits: bool = False  # waits `steps` for the fingers, independent of the hand


def towards(
    hand: np.ndarray,
    orientation: np.ndarray,
    target: np.ndarray,
    upright: np.ndarray,
    gripper: float,
    *,
    per_m: float = 10.0,
) -> Act:
    """Compute the action that moves the hand towards a pose.

    Args:
        hand: Where the hand is, (3,) m.
        orientation: How it is held, (3, 3).
        target: Where it shall be, (3,) m.
        upright: How it shall be held, (3, 3).
        gripper: `OPEN` or `CLOSED`.
        per_m: Units of the action for a metre of the remaining distance; 20 command all of it.
    """
    move = np.clip((target - hand) * per_m, -1.0, 1.0)
    turn = np.clip(_rotation_vector(upright @ orientation.T) * _PER_RAD, -_MOST_TURN, _MOST_TURN)
    return Act(np.concatenate([move, turn, [gripper]]).astype(np.float32))


def matrix(rotation_vector: np.ndarray) -> np.ndarray:
    """Convert a rotation vector (3,) rad to a matrix (3, 3) by Rodrigues' formula."""
    angle = float(np.linalg.norm(rotation_vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = rotation_vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned: np.ndarray = np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)
    return turned


def _rotation_vector(turned: np.ndarray) -> np.ndarray:
    """Convert a matrix (3, 3) to a rotation vector (3,) rad, with sines for the small angles."""
    return np.array([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]) / 2
