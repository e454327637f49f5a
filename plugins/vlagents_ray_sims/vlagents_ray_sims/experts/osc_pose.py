"""Experts for robosuite's OSC_POSE, which pick an object from above: the base class, and
robosuite's tasks.

They read the positions of the objects from the simulator's state. An action is (7,) for one arm:
0.05 m and 0.5 rad a unit, gripper -1 open, 1 closed.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from vlagents_ray.errors import ContractMismatch, InvalidObservation, MissingState, NotReset
from vlagents_ray.interface import Act, Obs
from vlagents_ray.registry import env_task

OPEN, CLOSED = -1.0, 1.0
_ARRIVED_M = 0.008
OVER_M = 0.12  # height of the hand above the grasp when approaching it
UP = np.array([0.0, 0.0, 1.0])
_PER_RAD = 2.0  # units of the action: all of the remaining rotation
_MOST_TURN = 0.3


@dataclass(frozen=True, slots=True)
class PickPhase:
    """A phase of the motion, which ends when the hand arrives, or after `steps`."""

    name: str
    gripper: float
    steps: int
    waits: bool = False  # waits `steps` for the fingers, independent of the hand


class PickExpert(ABC):
    """Moves the hand through a sequence of poses, each of which is computed when its phase
    begins.
    """

    per_m: ClassVar[float] = 10.0
    """Units of the action for a metre of the remaining distance; 20 command all of it."""

    def __init__(self, name: str, phases: Sequence[PickPhase]) -> None:
        self._name, self._phases = name, phases
        self._first: np.ndarray | None = None  # (3, 3), of the hand: its fingers close along y
        self._phase, self._spent = 0, 0
        # Of the hand in this phase: (3,) m, (3, 3)
        self._target, self._turned = np.zeros(3), np.eye(3)

    def reset(self, obs: Obs, instruction: str) -> None:
        hand, self._first = self._hand(obs)
        self._phase, self._spent, self._turned = 0, 0, self._first
        self._aim(hand, obs)

    def act(self, obs: Obs) -> Act:
        if self._first is None:
            raise NotReset(f"{self._name}: act before reset; call reset(obs, instruction) first")
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
        return _towards(
            hand, orientation, self._target, self._turned, phase.gripper, per_m=self.per_m
        )

    def _finished(self, hand: np.ndarray, obs: Obs) -> None:  # noqa: B027 - an expert of one object has nothing to do
        """Begin other phases after the last one."""

    def _turn(self, yaw: float) -> None:
        """Turn the hand, by the smaller of two angles, so that its fingers close across the
        direction `yaw`, rad.
        """
        near = (yaw + math.pi / 2) % math.pi - math.pi / 2
        if self._first is not None:
            self._turned = rotation(np.array([0.0, 0.0, near])) @ self._first

    @abstractmethod
    def _hand(self, obs: Obs) -> tuple[np.ndarray, np.ndarray]:
        """Return the position (3,) m and orientation (3, 3) of the hand in the world's frame."""

    @abstractmethod
    def _aim(self, hand: np.ndarray, obs: Obs) -> None:
        """Set the target of the hand in the phase that begins."""


@dataclass(frozen=True, slots=True)
class Handling:
    """How an object is grasped and placed."""

    name: str  # robosuite's
    handle_m: float = 0.0  # from the object's origin to the grasp, along its own x axis
    # The fingers close across that axis, and the object is turned by its nearest right angle.
    aligned: bool = False
    lift_m: float = 0.12  # to pass over other objects
    # Height of its origin above the place when the hand opens; None: only lifted.
    release_m: float | None = None


_HANDLED = {
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
    """Grasps the task's object from above, lifts it and, if the task has one, moves it to its
    place.
    """

    per_m = 20.0

    def __init__(self, env_name: str) -> None:
        task = env_task(env_name) or "Lift"
        if task not in _HANDLED:
            known = [f"robosuite/{one}" for one in _HANDLED]
            raise ContractMismatch(f"no scripted expert for env {env_name!r}: want one of {known}")
        self._handled = _HANDLED[task]
        phases = _PICK if self._handled.release_m is None else (*_PICK, *_PLACE)
        super().__init__(f"robosuite/{task}", phases)

    def _hand(self, obs: Obs) -> tuple[np.ndarray, np.ndarray]:
        for part in ("robot0_eef_pos", "robot0_eef_quat"):
            if part not in obs.state:
                raise MissingState(part, have=obs.state)
        x, y, z, w = (float(value) for value in obs.state["robot0_eef_quat"])
        sine = math.sqrt(x * x + y * y + z * z)
        angle = 2.0 * math.atan2(sine, w)
        axis = np.array([x, y, z]) / sine if sine else np.zeros(3)
        return obs.state["robot0_eef_pos"].astype(np.float64), rotation(angle * axis)

    def _aim(self, hand: np.ndarray, obs: Obs) -> None:
        handled, phase = self._handled, self._phases[self._phase].name
        thing, yaw = self._object(obs)
        grasp = thing + handled.handle_m * np.array([math.cos(yaw), math.sin(yaw), 0.0])
        if phase == "over":
            self._target = grasp + OVER_M * UP
            if handled.aligned:
                self._turn(yaw)
        elif phase == "down":
            self._target = grasp
        elif phase in ("lift", "leave"):
            self._target = hand + handled.lift_m * UP
        elif phase in ("carry", "lower"):
            right = round(yaw / (math.pi / 2)) * math.pi / 2 if handled.aligned else yaw
            held = rotation(np.array([0.0, 0.0, right - yaw])) @ (hand - thing)
            height = handled.lift_m if phase == "carry" else handled.release_m or 0.0
            self._target = self._read(obs, "target_pos", 3) + held + height * UP
            if handled.aligned and phase == "carry":
                self._turn(right)

    def _object(self, obs: Obs) -> tuple[np.ndarray, float]:
        """Return the position of the object, (3,) m, and its angle about the vertical, rad."""
        yaw = yaw_of(self._read(obs, f"{self._handled.name}_quat", 4))
        return self._read(obs, f"{self._handled.name}_pos", 3), yaw

    def _read(self, obs: Obs, name: str, size: int) -> np.ndarray:
        state = obs.info.get("sim_state")
        value = state.get(name) if isinstance(state, dict) else None
        if not isinstance(value, np.ndarray) or value.shape != (size,):
            raise InvalidObservation(
                f"info['sim_state']: want {name!r}, ({size},), as the env {self._name} gives it; "
                f"this expert cannot act on images"
            )
        return value


def _towards(
    hand: np.ndarray,
    orientation: np.ndarray,
    target: np.ndarray,
    upright: np.ndarray,
    gripper: float,
    *,
    per_m: float,
) -> Act:
    """Compute the action that moves the hand from a position (3,) m and an orientation (3, 3)
    towards a pose.
    """
    move = np.clip((target - hand) * per_m, -1.0, 1.0)
    turn = np.clip(_rotation_vector(upright @ orientation.T) * _PER_RAD, -_MOST_TURN, _MOST_TURN)
    return Act(np.concatenate([move, turn, [gripper]]).astype(np.float32))


def yaw_of(quaternion: np.ndarray) -> float:
    """Return the angle of a unit quaternion xyzw about the vertical, rad."""
    x, y, z, w = (float(part) for part in quaternion)
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def rotation(rotation_vector: np.ndarray) -> np.ndarray:
    """Convert a rotation vector (3,) rad to a matrix (3, 3) by Rodrigues' formula."""
    angle = float(np.linalg.norm(rotation_vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = rotation_vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned: np.ndarray = (
        np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)
    )
    return turned


def _rotation_vector(turned: np.ndarray) -> np.ndarray:
    """Convert a matrix (3, 3) to a rotation vector (3,) rad, with sines for the small angles."""
    return (
        np.array(
            [turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]
        )
        / 2
    )
