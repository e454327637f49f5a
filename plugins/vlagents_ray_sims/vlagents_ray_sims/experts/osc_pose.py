"""Scripted experts for robosuite's controller OSC_POSE, which pick an object from above.

This module has the base class and the expert for robosuite's tasks. Experts read the positions of
the objects from the simulator's state. An action is (7,) for one arm: 0.05 m and 0.5 rad per unit,
gripper -1 open, 1 closed.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from vlagents_ray.errors import (
    ContractMismatch,
    InvalidObservation,
    MissingState,
    NotReset,
    shown,
)
from vlagents_ray.interface import Act, Obs
from vlagents_ray.registry import env_task

OPEN, CLOSED = -1.0, 1.0
_ARRIVED_M = 0.008  # distance to the target at which the hand has arrived
OVER_M = 0.12  # height of the hand above the grasp when approaching it
UP = np.array([0.0, 0.0, 1.0])
_UNITS_PER_RAD = 2.0  # units of the action per rad, which command all of the remaining rotation
_MAX_TURN = 0.3  # largest command of a rotation, units


@dataclass(frozen=True, slots=True)
class PickPhase:
    """A phase of the motion, which ends when the hand arrives, or after `steps`."""

    name: str
    gripper: float
    steps: int
    # Whether the phase waits `steps` for the fingers, whatever the position of the hand.
    waits: bool = False


class PickExpert(ABC):
    """Moves the hand through a sequence of poses; each pose is computed when its phase begins."""

    units_per_m: ClassVar[float] = 10.0
    """Units of the action for each metre of the remaining distance; 20 units command all of the
    distance.
    """

    def __init__(self, name: str, phases: Sequence[PickPhase]) -> None:
        self._name, self._phases = name, phases
        # Orientation of the hand at the reset, (3, 3), at which the fingers close along the y axis.
        self._first: np.ndarray | None = None
        self._phase, self._spent = 0, 0  # index of the phase, and number of its steps so far
        # Target position of the hand in this phase, (3,) m, and its orientation, (3, 3).
        self._target, self._target_orientation = np.zeros(3), np.eye(3)

    def reset(self, obs: Obs, instruction: str) -> None:
        hand, self._first = self._hand(obs)
        self._phase, self._spent, self._target_orientation = 0, 0, self._first
        self._aim(hand, obs)

    def act(self, obs: Obs) -> Act:
        """Begin the next phase if the hand has arrived, and move the hand towards its target."""
        if self._first is None:
            raise NotReset(
                f"{self._name}: act was called before reset; call reset(obs, instruction) first"
            )

        hand, orientation = self._hand(obs)
        phase = self._phases[self._phase]
        arrived = not phase.waits and float(np.linalg.norm(hand - self._target)) < _ARRIVED_M
        if arrived or self._spent >= phase.steps:
            if self._phase < len(self._phases) - 1:
                self._phase, self._spent = self._phase + 1, 0
                self._aim(hand, obs)
            else:
                self._finished(hand, obs)
            phase = self._phases[self._phase]
        self._spent += 1

        move = np.clip((self._target - hand) * self.units_per_m, -1.0, 1.0)
        remaining_rotation = _rotation_vector(self._target_orientation @ orientation.T)
        turn = np.clip(remaining_rotation * _UNITS_PER_RAD, -_MAX_TURN, _MAX_TURN)
        return Act(np.concatenate([move, turn, [phase.gripper]]).astype(np.float32))

    def _finished(self, hand: np.ndarray, obs: Obs) -> None:  # noqa: B027 - an expert for one object has nothing to do
        """Begin further phases after the last phase."""

    def _turn(self, yaw: float) -> None:
        """Turn the hand so that its fingers close across the direction `yaw`, rad.

        Of the two such angles, which differ by half a turn, the smaller one is chosen.
        """
        smaller_yaw = (yaw + math.pi / 2) % math.pi - math.pi / 2
        if self._first is not None:
            turn = rotation(np.array([0.0, 0.0, smaller_yaw]))
            self._target_orientation = turn @ self._first

    @abstractmethod
    def _hand(self, obs: Obs) -> tuple[np.ndarray, np.ndarray]:
        """Return the position (3,) m and orientation (3, 3) of the hand in the world frame."""

    @abstractmethod
    def _aim(self, hand: np.ndarray, obs: Obs) -> None:
        """Set the target of the hand in the phase that begins."""


@dataclass(frozen=True, slots=True)
class Handling:
    """How an object is grasped and placed."""

    name: str  # robosuite's name of the object
    handle_m: float = 0.0  # from the object's origin to the grasp, along its own x axis
    # Whether the fingers close across the x axis, and the object is turned to the nearest right
    # angle before it is placed.
    aligned: bool = False
    lift_m: float = 0.12  # height by which the object is lifted, to pass over other objects
    # Height of the object's origin above the target when the hand opens; None if the object is
    # only lifted.
    release_m: float | None = None


_HANDLING = {
    "Lift": Handling("cube"),
    "PickPlaceCan": Handling("Can", lift_m=0.25, release_m=0.07),
    "NutAssemblySquare": Handling("SquareNut", handle_m=0.054, aligned=True, release_m=0.02),
}
_PICK = (
    PickPhase("over", OPEN, 80),
    PickPhase("down", OPEN, 60),
    PickPhase("grasp", CLOSED, 12, waits=True),
    PickPhase("lift", CLOSED, 60),
)
_PLACE = (
    PickPhase("carry", CLOSED, 100),
    PickPhase("lower", CLOSED, 50),
    PickPhase("release", OPEN, 8, waits=True),
    PickPhase("leave", OPEN, 25),
)


class RobosuiteExpert(PickExpert):
    """Grasps the task's object from above, lifts it, and moves it to its target, if the task has
    one.
    """

    units_per_m = 20.0

    def __init__(self, env_name: str) -> None:
        task = env_task(env_name) or "Lift"
        if task not in _HANDLING:
            envs = [f"robosuite/{known_task}" for known_task in _HANDLING]
            raise ContractMismatch(
                f"expected an env with a scripted expert, one of {envs}, got {env_name!r}"
            )
        self._handling = _HANDLING[task]
        phases = _PICK if self._handling.release_m is None else (*_PICK, *_PLACE)
        super().__init__(f"robosuite/{task}", phases)

    def _hand(self, obs: Obs) -> tuple[np.ndarray, np.ndarray]:
        for name in ("robot0_eef_pos", "robot0_eef_quat"):
            if name not in obs.state:
                raise MissingState(name, have=obs.state)
        x, y, z, w = obs.state["robot0_eef_quat"].tolist()
        sine = math.sqrt(x * x + y * y + z * z)
        angle = 2.0 * math.atan2(sine, w)
        axis = np.array([x, y, z]) / sine if sine else np.zeros(3)
        return obs.state["robot0_eef_pos"].astype(np.float64), rotation(angle * axis)

    def _aim(self, hand: np.ndarray, obs: Obs) -> None:
        handling, phase = self._handling, self._phases[self._phase].name
        position, yaw = self._object(obs)
        grasp = position + handling.handle_m * np.array([math.cos(yaw), math.sin(yaw), 0.0])
        if phase == "over":
            self._target = grasp + OVER_M * UP
            if handling.aligned:
                self._turn(yaw)
        elif phase == "down":
            self._target = grasp
        elif phase in ("lift", "leave"):
            self._target = hand + handling.lift_m * UP
        elif phase in ("carry", "lower"):
            placed_yaw = round(yaw / (math.pi / 2)) * math.pi / 2 if handling.aligned else yaw
            # Vector from the object to the hand, after the object is turned to the nearest right
            # angle.
            grip = rotation(np.array([0.0, 0.0, placed_yaw - yaw])) @ (hand - position)
            height = handling.lift_m if phase == "carry" else handling.release_m or 0.0
            self._target = self._read(obs, "target_pos", 3) + grip + height * UP
            if handling.aligned and phase == "carry":
                self._turn(placed_yaw)

    def _object(self, obs: Obs) -> tuple[np.ndarray, float]:
        """Return the position of the object, (3,) m, and its angle about the vertical, rad."""
        name = self._handling.name
        yaw = yaw_of(self._read(obs, f"{name}_quat", 4))
        return self._read(obs, f"{name}_pos", 3), yaw

    def _read(self, obs: Obs, name: str, size: int) -> np.ndarray:
        """Return a value of `info["sim_state"]`, (`size`,); raises `InvalidObservation`."""
        state = obs.info.get("sim_state")
        value = state.get(name) if isinstance(state, dict) else None
        if not isinstance(value, np.ndarray) or value.shape != (size,):
            raise InvalidObservation(
                f"info['sim_state']: expected {name!r}, ({size},), as the env {self._name} gives "
                f"it, got {shown(value)}; this expert cannot act on images"
            )
        return value


def yaw_of(quaternion: np.ndarray) -> float:
    """Return the angle of a unit quaternion xyzw about the vertical, rad."""
    x, y, z, w = quaternion.tolist()
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def rotation(rotation_vector: np.ndarray) -> np.ndarray:
    """Convert a rotation vector (3,) rad to a matrix (3, 3) by Rodrigues' formula."""
    angle = float(np.linalg.norm(rotation_vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = rotation_vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix: np.ndarray = (
        np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)
    )
    return matrix


def _rotation_vector(matrix: np.ndarray) -> np.ndarray:
    """Convert a matrix (3, 3) to a rotation vector (3,) rad.

    The length is the sine of the angle, which is close to the angle if that is small.
    """
    x = matrix[2, 1] - matrix[1, 2]
    y = matrix[0, 2] - matrix[2, 0]
    z = matrix[1, 0] - matrix[0, 1]
    return np.array([x, y, z]) / 2
