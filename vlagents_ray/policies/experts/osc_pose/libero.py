"""An expert for LIBERO's two suites of picking and placing one object, from the simulator's state.

The hand keeps its initial orientation, in which the fingers close along y. Bowls in or on the cabinet (libero_spatial/4
and /9) are then out of reach: it acts there, and fails.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.errors import ContractMismatch, InvalidObservation, NotReset
from vlagents_ray.interface import Act, Obs
from vlagents_ray.policies.experts.osc_pose.hand import CLOSED, OPEN, PickPhase, matrix, towards
from vlagents_ray.registry import env_task

_SUITES = ("libero_spatial", "libero_object")
_ARRIVED_M = 0.008
_OVER_M = 0.12  # height above the grasp when approaching it
_LIFT_M = 0.2
_LEAVE_M = 0.15


@dataclass(frozen=True, slots=True)
class Grip:
    """The grasp and release of a kind of object."""

    offset: tuple[float, float, float]  # from the object's origin to the hand when it closes, m
    release_m: float  # height of the object above its target when the hand opens


_RIM = Grip((0.0, 0.048, 0.035), 0.02)  # bowls are wider than the hand: a finger goes inside
_MIDDLE = Grip((0.0, 0.0, 0.0), 0.1)

_PHASES = (
    PickPhase("over", OPEN, 80),
    PickPhase("down", OPEN, 60),
    PickPhase("grasp", CLOSED, 15, waits=True),
    PickPhase("lift", CLOSED, 60),
    PickPhase("carry", CLOSED, 120),
    PickPhase("lower", CLOSED, 60),
    PickPhase("release", OPEN, 12, waits=True),
    PickPhase("leave", OPEN, 25),
)


class LiberoExpert:
    """Grasps the object of the goal from above, and places it at the goal's target."""

    def __init__(self, env_name: str) -> None:
        suite = (env_task(env_name) or _SUITES[0]).partition("/")[0]
        if not suite.startswith(_SUITES):  # those that vary them included
            raise ContractMismatch(f"no scripted expert for env {env_name!r}: in LIBERO there are those for {_SUITES}")
        self._name = env_name
        self._upright: np.ndarray | None = None  # (3, 3), the hand's first orientation
        self._thing, self._place = "", ""
        self._phase, self._spent = 0, 0
        self._target = np.zeros(3)  # of the hand in this phase, m

    def reset(self, obs: Obs, instruction: str) -> None:
        """Begin an episode.

        Raises:
            InvalidObservation: The observation has no simulator state of LIBERO.
            ContractMismatch: The goal is not of picking and placing an object.
        """
        goal, positions = self._sim_state(obs)
        if len(goal) != 1 or len(goal[0]) != 3 or goal[0][0] not in ("on", "in"):
            raise ContractMismatch(f"{self._name}: the expert brings one thing to one place, the goal is {goal}")
        _, self._thing, self._place = goal[0]
        if missing := {self._thing, self._place} - set(positions):
            raise InvalidObservation(f"info['sim_state']: no position of {sorted(missing)}, got {sorted(positions)}")
        hand, self._upright = _hand(obs)
        self._phase, self._spent = 0, 0
        self._target = self._aim(hand, positions)

    def act(self, obs: Obs) -> Act:
        """Compute the next action, (7,) float32."""
        if self._upright is None:
            raise NotReset(f"{self._name}: act before reset; call reset(obs, instruction) first")
        _, positions = self._sim_state(obs)
        hand, orientation = _hand(obs)
        phase = _PHASES[self._phase]
        arrived = not phase.waits and float(np.linalg.norm(hand - self._target)) < _ARRIVED_M
        if (arrived or self._spent >= phase.steps) and self._phase < len(_PHASES) - 1:
            self._phase, self._spent = self._phase + 1, 0
            self._target = self._aim(hand, positions)
            phase = _PHASES[self._phase]
        self._spent += 1
        return towards(hand, orientation, self._target, self._upright, phase.gripper)

    def _aim(self, hand: np.ndarray, positions: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the target of the hand in the phase that begins, (3,) m."""
        grip = _RIM if "bowl" in self._thing else _MIDDLE
        thing, up = positions[self._thing], np.array([0.0, 0.0, 1.0])
        grasp = thing + np.array(grip.offset)
        above = positions[self._place] + hand - thing  # of the hand, with the object above its target
        targets: dict[str, np.ndarray] = {
            "over": grasp + _OVER_M * up,
            "down": grasp,
            "lift": hand + _LIFT_M * up,
            "carry": np.array([above[0], above[1], hand[2]]),
            "lower": above + grip.release_m * up,
            "leave": hand + _LEAVE_M * up,
        }
        return targets.get(_PHASES[self._phase].name, self._target)  # in other phases only the fingers move

    def _sim_state(self, obs: Obs) -> tuple[list[list[str]], dict[str, np.ndarray]]:
        """Return the goal's predicates and the positions of objects, (3,) m."""
        state = obs.info.get("sim_state")
        if not isinstance(state, dict) or not {"goal", "positions"} <= set(state):
            got: Any = sorted(state) if isinstance(state, dict) else type(state).__name__
            raise InvalidObservation(
                f"info['sim_state']: got {got}, want the goal and the positions, as the env {self._name} gives "
                f"them; this expert cannot act on images"
            )
        return state["goal"], state["positions"]


def _hand(obs: Obs) -> tuple[np.ndarray, np.ndarray]:
    """Return the position (3,) m and orientation (3, 3) of the hand in the world's frame."""
    pose = obs.state.get("xyz_axis_angle")
    if pose is None or pose.shape != (6,):
        raise InvalidObservation("state 'xyz_axis_angle': want (6,), m and rad, as LIBERO's env gives it")
    return pose[:3].astype(np.float64), matrix(pose[3:].astype(np.float64))
