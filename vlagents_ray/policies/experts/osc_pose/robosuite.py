"""An expert for three tasks of robosuite, which picks an object from above, from the simulator's state."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vlagents_ray.errors import ContractMismatch, InvalidObservation, MissingState, NotReset
from vlagents_ray.interface import Act, Obs
from vlagents_ray.policies.experts.osc_pose.hand import CLOSED, OPEN, PickPhase, matrix, towards
from vlagents_ray.registry import env_task

_ARRIVED_M = 0.008
_PER_M = 20.0
_OVER_M = 0.12  # height of the hand above the grasp when approaching it
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class Handling:
    """How an object is grasped and placed."""

    name: str  # robosuite's
    handle_m: float = 0.0  # from the object's origin to the grasp, along its own x axis
    aligned: bool = False  # the fingers close across that axis, and the object is turned by its nearest right angle
    lift_m: float = 0.12  # so that it passes over what stands between
    release_m: float | None = None  # height of its origin above the place when the hand opens; None: only lifted


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


class RobosuiteExpert:
    """Grasps the task's object from above, lifts it and, unless that is all, brings it to its place."""

    def __init__(self, env_name: str) -> None:
        task = env_task(env_name) or "Lift"
        if task not in _HANDLED:
            known = [f"robosuite/{one}" for one in _HANDLED]
            raise ContractMismatch(f"no scripted expert for env {env_name!r}: want one of {known}")
        self._name = f"robosuite/{task}"
        self._handled = _HANDLED[task]
        self._phases = _PICK if self._handled.release_m is None else (*_PICK, *_PLACE)
        self._first: np.ndarray | None = None  # (3, 3), of the hand: its fingers close along y
        self._phase, self._spent = 0, 0
        self._target, self._turned = np.zeros(3), np.eye(3)  # of the hand in this phase: (3,) m, (3, 3)

    def reset(self, obs: Obs, instruction: str) -> None:
        """Begin an episode.

        Raises:
            InvalidObservation: The observation has no simulator state of robosuite.
            MissingState: The observation lacks a part of the hand's state.
        """
        hand, self._first = _hand(obs)
        self._phase, self._spent = 0, 0
        self._turned = self._first
        self._aim(hand, obs)

    def act(self, obs: Obs) -> Act:
        """Compute the next action, (7,) float32."""
        if self._first is None:
            raise NotReset(f"{self._name}: act before reset; call reset(obs, instruction) first")
        hand, orientation = _hand(obs)
        phase = self._phases[self._phase]
        arrived = not phase.waits and float(np.linalg.norm(hand - self._target)) < _ARRIVED_M
        if (arrived or self._spent >= phase.steps) and self._phase < len(self._phases) - 1:
            self._phase, self._spent = self._phase + 1, 0
            self._aim(hand, obs)
            phase = self._phases[self._phase]
        self._spent += 1
        return towards(hand, orientation, self._target, self._turned, phase.gripper, per_m=_PER_M)

    def _aim(self, hand: np.ndarray, obs: Obs) -> None:
        """Set the target of the hand in the phase that begins."""
        handled, phase = self._handled, self._phases[self._phase].name
        thing, yaw = self._object(obs)
        grasp = thing + handled.handle_m * np.array([math.cos(yaw), math.sin(yaw), 0.0])
        if phase == "over":
            self._target = grasp + _OVER_M * _UP
            if handled.aligned:
                self._turn(yaw)
        elif phase == "down":
            self._target = grasp
        elif phase in ("lift", "leave"):
            self._target = hand + handled.lift_m * _UP
        elif phase in ("carry", "lower"):
            right = round(yaw / (math.pi / 2)) * math.pi / 2 if handled.aligned else yaw
            held = matrix(np.array([0.0, 0.0, right - yaw])) @ (hand - thing)
            height = handled.lift_m if phase == "carry" else handled.release_m or 0.0
            self._target = self._read(obs, "target_pos", 3) + held + height * _UP
            if handled.aligned and phase == "carry":
                self._turn(right)

    def _turn(self, yaw: float) -> None:
        """Hold the hand so that its fingers close across the direction `yaw`, rad, of two ways by the shorter."""
        near = (yaw + math.pi / 2) % math.pi - math.pi / 2
        if self._first is not None:
            self._turned = matrix(np.array([0.0, 0.0, near])) @ self._first

    def _object(self, obs: Obs) -> tuple[np.ndarray, float]:
        """Return the position of the object, (3,) m, and its angle about the vertical, rad."""
        x, y, z, w = self._read(obs, f"{self._handled.name}_quat", 4)
        yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
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


def _hand(obs: Obs) -> tuple[np.ndarray, np.ndarray]:
    """Return the position (3,) m and orientation (3, 3) of the hand in the world's frame."""
    for part in ("robot0_eef_pos", "robot0_eef_quat"):
        if part not in obs.state:
            raise MissingState(part, have=obs.state)
    x, y, z, w = (float(value) for value in obs.state["robot0_eef_quat"])
    sine = math.sqrt(x * x + y * y + z * z)
    angle = 2.0 * math.atan2(sine, w)
    axis = np.array([x, y, z]) / sine if sine else np.zeros(3)
    return obs.state["robot0_eef_pos"].astype(np.float64), matrix(angle * axis)
