"""An expert for LIBERO's tasks, which moves objects, closes drawers and turns knobs.

It reads the positions of the objects from the simulator's state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.errors import ContractMismatch, InvalidObservation, shown
from vlagents_ray.interface import Obs
from vlagents_ray_sims.experts.osc_pose import (
    CLOSED,
    OPEN,
    OVER_M,
    UP,
    PickExpert,
    PickPhase,
    rotation,
    yaw_of,
)

_LIFT_M = 0.2  # minimum height by which an object is lifted, to pass over other objects, m
_DOWNWARDS_M = 0.08  # height by which an object is lifted if its target is lower than it, m
_CLEAR_M = 0.12  # height of a carried object above its target
_LEAVE_M = 0.15
_HANDLE_M = 0.121  # from the middle of a drawer to the outer side of its handle
_TRAVEL_M = 0.165  # travel of a drawer from open to closed
_APPROACH_M = 0.06  # distance of the hand to the handle before it pushes
_TWIST = 1.2  # rotation of a stove's knob, rad


@dataclass(frozen=True, slots=True)
class Grip:
    """The grasp and release of a kind of object."""

    # From the object's origin to the hand when it closes, m.
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # The object's axis, x or y, along which the fingers close; the offset is then in its frame.
    along: str = ""
    foot_m: float = 0.0  # height of the object's origin above its lowest point


# Objects that are not listed are round: they are grasped in the middle, at any orientation.
_GRIPS = {
    # Bowls are wider than the hand: a finger goes inside.
    "akita_black_bowl": Grip((0.0, 0.048, 0.035)),
    "white_bowl": Grip((0.0, 0.036, 0.022)),
    "porcelain_mug": Grip((0.055, 0.0, 0.095), "x"),  # the rim on the other side of the handle
    "white_yellow_mug": Grip((-0.06, 0.0, 0.085), "x"),
    "red_coffee_mug": Grip((-0.053, 0.0, 0.115), "x"),
    "moka_pot": Grip((0.0, 0.07, 0.03), "x", foot_m=0.067),  # the handle
    "chefmate_8_frypan": Grip((0.18, 0.0, 0.042), "y"),
    "black_book": Grip((0.0, -0.012, 0.105), "x"),
    "yellow_book": Grip((0.0, 0.0, 0.095), "x"),
    "wine_bottle": Grip((0.0, 0.0, 0.09)),
    "new_salad_dressing": Grip((0.0, 0.0, 0.04), foot_m=0.023),
    "butter": Grip(along="y", foot_m=0.01),
    "cream_cheese": Grip(along="y", foot_m=0.01),
    "chocolate_pudding": Grip(along="y", foot_m=0.014),
}
_MIDDLE = Grip(foot_m=0.04)

_PLACING = (
    PickPhase("over", OPEN, 60),
    PickPhase("down", OPEN, 45),
    PickPhase("grasp", CLOSED, 14, waits=True),
    PickPhase("lift", CLOSED, 50),
    PickPhase("carry", CLOSED, 100),
    PickPhase("lower", CLOSED, 50),
    PickPhase("release", OPEN, 10, waits=True),
    PickPhase("leave", OPEN, 30),
)
_CLOSING = (
    PickPhase("over", CLOSED, 80),
    PickPhase("down", CLOSED, 35),
    PickPhase("push", CLOSED, 40),
    PickPhase("leave", CLOSED, 30),
)
_TURNING = (
    PickPhase("over", OPEN, 80),
    PickPhase("down", OPEN, 45),
    PickPhase("grasp", CLOSED, 12, waits=True),
    PickPhase("twist", CLOSED, 30, waits=True),
    PickPhase("release", OPEN, 8, waits=True),
    PickPhase("leave", OPEN, 30),
)
# For each kind of predicate: the phases that fulfil it.
_MOTIONS = {"on": _PLACING, "in": _PLACING, "turnon": _TURNING, "close": _CLOSING}
# The order in which predicates are fulfilled: an object is put into a drawer before the drawer is
# closed.
_ORDER = ("turnon", "on", "in", "close")
_STATE_KEYS = {"goal", "unmet", "positions", "quaternions"}


class LiberoExpert(PickExpert):
    """Fulfils the predicates of the goal one after the other, and then repeats the unmet
    predicates.

    It cannot open drawers or microwaves: `reset` raises `ContractMismatch` for such goals.
    """

    units_per_m = 12.0

    def __init__(self, env_name: str) -> None:
        super().__init__(env_name, _PLACING)
        self._predicate: list[str] = []
        self._tries: dict[str, int] = {}  # the number of attempts for each object
        self._lifted_from = 0.0  # height of the object before it was lifted, m

    def reset(self, obs: Obs, instruction: str) -> None:
        kinds = {predicate[0] for predicate in self._state(obs)["goal"]}
        unknown = sorted(kinds - set(_MOTIONS))
        if unknown:
            raise ContractMismatch(
                f"{self._name}: expected goals of {sorted(_MOTIONS)}, as this expert meets, got "
                f"{unknown}"
            )
        self._tries = {}
        self._choose(obs)
        super().reset(obs, instruction)

    def _finished(self, hand: np.ndarray, obs: Obs) -> None:
        if self._state(obs)["unmet"]:
            self._choose(obs)
            self._phase, self._spent = 0, 0
            self._aim(hand, obs)

    def _choose(self, obs: Obs) -> None:
        """Select the next predicate: the one whose object has had the fewest attempts."""

        def rank(predicate: list[str]) -> tuple[int, int]:
            kind, name, *_ = predicate
            return self._tries.get(name, 0), _ORDER.index(kind)

        state = self._state(obs)
        self._predicate = min(state["unmet"] or state["goal"], key=rank)
        kind, name, *_ = self._predicate
        self._tries[name] = self._tries.get(name, 0) + 1
        self._phases = _MOTIONS[kind]

    def _hand(self, obs: Obs) -> tuple[np.ndarray, np.ndarray]:
        pose = obs.state.get("xyz_axis_angle")
        if pose is None or pose.shape != (6,):
            raise InvalidObservation(
                "state 'xyz_axis_angle': expected (6,), m and rad, as LIBERO's env gives it, got "
                f"{shown(pose)}"
            )
        return pose[:3].astype(np.float64), rotation(pose[3:].astype(np.float64))

    def _aim(self, hand: np.ndarray, obs: Obs) -> None:
        state, phase = self._state(obs), self._phases[self._phase].name
        kind, name, *_ = self._predicate
        if phase == "leave":
            self._target = hand + _LEAVE_M * UP
        elif kind == "close":
            self._aim_at_drawer(state["positions"][name], phase)
        elif kind == "turnon":
            self._aim_at_knob(state["positions"][name], phase)
        else:
            self._aim_at_object(hand, obs, phase)

    def _aim_at_object(self, hand: np.ndarray, obs: Obs, phase: str) -> None:
        state = self._state(obs)
        _, name, region = self._predicate
        position, region_position = state["positions"][name], state["positions"][region]
        grip = _GRIPS.get(name.rpartition("_")[0], _MIDDLE)

        if phase in ("over", "down"):
            if grip.along:
                yaw = yaw_of(state["quaternions"][name])
            else:
                yaw = self._rim_yaw(name, state["positions"])
            self._turn(yaw + (math.pi / 2 if grip.along == "x" else 0.0))
            self._target = position + rotation(yaw * UP) @ np.array(grip.offset)
            if phase == "over":
                self._target[2] = max(self._target[2] + OVER_M, hand[2])

        elif phase == "lift":
            self._lifted_from = position[2]
            rise = region_position[2] - position[2] + grip.foot_m + _CLEAR_M
            self._target = hand + (_DOWNWARDS_M if rise < 0 else max(_LIFT_M, rise)) * UP

        elif phase == "carry" and position[2] - self._lifted_from < _DOWNWARDS_M / 2:
            self._finished(hand, obs)  # the hand has lost the object

        elif phase in ("carry", "lower"):
            # The position of the hand at which the object is in the region.
            above = region_position + hand - position
            is_container = region.endswith("contain_region") and "caddy" not in region
            drop = 0.1 if is_container else grip.foot_m + 0.02
            height = hand[2] if phase == "carry" else above[2] + drop
            self._target = np.array([above[0], above[1], height])

    def _rim_yaw(self, name: str, positions: dict[str, np.ndarray]) -> float:
        """Return the yaw at which to grasp a round object's rim, rad.

        The first attempt is at the side away from the cabinet, whose open drawer the hand could
        hit. Each further attempt is at the next side.
        """
        cabinets = [position for other, position in positions.items() if "cabinet_1" in other]
        first_side = math.pi if cabinets and cabinets[0][1] > 0 else 0.0
        return first_side + math.pi / 2 * (self._tries[name] - 1)

    def _aim_at_drawer(self, drawer: np.ndarray, phase: str) -> None:
        """Push the handle from the front, with the hand's narrow side towards the other drawers."""
        # Cabinets stand on both sides of the table and face its middle.
        front = -math.copysign(1.0, drawer[1])
        self._turn(math.pi / 2)
        if phase in ("over", "down"):
            height = OVER_M if phase == "over" else 0.0
            self._target = drawer + np.array([0.0, front * (_HANDLE_M + _APPROACH_M), height])
        elif phase == "push":
            push = np.array([0.0, front * (_APPROACH_M + _TRAVEL_M), 0.0])
            self._target = self._target - push

    def _aim_at_knob(self, stove: np.ndarray, phase: str) -> None:
        self._turn(0.0)
        knob = stove + np.array([0.006, 0.003, 0.035])
        if phase in ("over", "down"):
            self._target = knob + (OVER_M * UP if phase == "over" else 0.0)
        elif phase == "twist":
            self._turn(_TWIST)

    def _state(self, obs: Obs) -> dict[str, Any]:
        state = obs.info.get("sim_state")
        if not isinstance(state, dict) or not set(state) >= _STATE_KEYS:
            content: Any = sorted(state) if isinstance(state, dict) else type(state).__name__
            raise InvalidObservation(
                "info['sim_state']: expected goal, unmet, positions and quaternions, as the env "
                f"{self._name} gives them, got {content}; this expert cannot act on images"
            )
        return state
