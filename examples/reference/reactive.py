"""An expert for the tabletop whose action depends only on the current observation.

The expert of `vlagents_ray.policies.experts.tabletop` follows waypoints, and waits after it closed
the gripper. An observation alone does not show at which waypoint it is, so its actions after a
change of driver are those of another plan. Corrections under delay need an expert that continues
from any state, and whose speeds and heights change gradually with the distances: if neighbouring
states had opposite labels, a policy would learn to hesitate.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from vlagents_ray.interface import Obs

_STEP = 0.03  # m, travel of one unit of an action
_TRAVEL = 0.10  # m, height of a carried puck, and of the fingertips on the way to a puck
_GRASP = 0.006  # m, height of the fingertips above the underside of a puck that they grasp
_PUCK_HEIGHT = 0.03  # m
_LIFT = 0.13  # m, height of the fingertips at the end of a lift
_OPEN, _CLOSED = 1.0, -1.0
# The opening of fingers around a puck. No other opening comes near it: from open to closed, the
# fingers take two steps, and stop at 0.5 if they hold nothing.
_HOLDING, _HOLDING_TOLERANCE = 0.579, 0.03
# The grasp tolerates these offsets of the puck, m; fingers that are lower than the top of a puck
# at most `_STRADDLING` away move along it without pushing it.
_INSIDE = (0.012, 0.009)
_STRADDLING = (0.016, 0.0125)
_RELEASE = 0.014  # m, largest offset along each axis at which a puck is released
_RELEASE_ON_PUCK = 0.010  # m, the same for a stack
_RELEASE_ON_SLIDE = 0.012  # m, the same for a slide, which stays on the table


def expert_action(obs: Obs, instruction: str) -> np.ndarray:
    """Return the expert's action in the state of an observation, (4,) float32.

    Args:
        obs: An observation of the tabletop with `object_state`.
        instruction: The instruction of the episode.
    """
    tip, puck = obs.state["xyzrpy"][:3].tolist(), obs.state["puck"].tolist()
    target, opening = obs.state["target"].tolist(), obs.gripper or 0.0
    task = re.split(r"\W+", instruction)[0]
    holds = abs(opening - _HOLDING) < _HOLDING_TOLERANCE
    to_puck = (puck[0] - tip[0], puck[1] - tip[1])
    beside_fingers = not _is_within(to_puck, _STRADDLING)

    if holds and (beside_fingers or not -0.012 < tip[2] - puck[2] < 0.02):
        return _action((0.0, 0.0), 0.01, _OPEN)  # another puck
    if holds:
        return _carry(task, tip, puck, target)
    if task != "lift" and _is_placed(instruction, puck, target):
        return _action((0.0, 0.0), _TRAVEL - tip[2], _OPEN)
    return _approach(tip, puck, to_puck, opening)


def _carry(
    task: str,
    tip: Sequence[float],
    puck: Sequence[float],
    target: Sequence[float],
) -> np.ndarray:
    """Return the action with the instruction's puck between the fingers."""
    if task == "lift":
        return _action((0.0, 0.0), _LIFT - tip[2], _CLOSED)

    offset = (target[0] - puck[0], target[1] - puck[1])
    far = max(abs(offset[0]), abs(offset[1]))
    if task == "slide":
        if far < _RELEASE_ON_SLIDE:
            return _action((0.0, 0.0), 0.0, _OPEN)
        return _action(offset, _GRASP - tip[2], _CLOSED)

    is_stack = task == "stack"
    release = _RELEASE_ON_PUCK if is_stack else _RELEASE
    base = target[2]
    if far < release and puck[2] < base + 0.008:
        return _action((0.0, 0.0), 0.0, _OPEN)
    # The puck descends during the last centimetres of the way, and moves sideways as far as it is
    # above the table.
    heights = (base + 0.001, base + 0.012, _TRAVEL)
    wanted = float(np.interp(far - release, (0.0, 0.008, 0.035), heights))
    limit = 1.0 if far < release else _ramp(puck[2], 0.02 if is_stack else 0.012, 0.045)
    return _action(offset, wanted - puck[2], _CLOSED, limit)


def _approach(
    tip: Sequence[float], puck: Sequence[float], to_puck: tuple[float, float], opening: float
) -> np.ndarray:
    """Return the action with empty fingers."""
    low = puck[2] + _GRASP
    if _is_within(to_puck, _INSIDE) and tip[2] < puck[2] + 0.012:
        return _action(to_puck, low - tip[2], _CLOSED, 0.3)

    beside = max(abs(to_puck[0]) - 0.008, abs(to_puck[1]) - 0.006, 0.0)
    heights = (low, puck[2] + 0.036, max(_TRAVEL, puck[2] + 0.05))
    wanted = float(np.interp(beside, (0.0, 0.004, 0.035), heights))
    # Fingers that are not open stay above the puck.
    wanted = max(wanted, puck[2] + float(np.interp(opening, (0.6, 0.95), (0.045, 0.0))))
    # Low fingers move sideways only if the puck is between them.
    outside = max(abs(to_puck[0]) - _STRADDLING[0], abs(to_puck[1]) - _STRADDLING[1])
    limit = max(_ramp(tip[2], 0.02, 0.045), 1.0 - _ramp(outside, 0.0, 0.006))
    return _action(to_puck, wanted - tip[2], _OPEN, limit)


def _is_placed(instruction: str, puck: Sequence[float], target: Sequence[float]) -> bool:
    """Return whether the puck rests on its target."""
    reach = 0.022 if instruction.startswith("stack") else 0.037
    return _is_within((target[0] - puck[0], target[1] - puck[1]), (reach, reach)) and (
        abs(puck[2] - target[2]) < 1e-3
    )


def _action(
    offset: tuple[float, float], height: float, grip: float, limit: float = 1.0
) -> np.ndarray:
    """Return the action towards a position, (4,) float32.

    Args:
        offset: The horizontal way that is left, m; the motion stays on this line.
        height: The vertical way that is left, m.
        grip: The command of the gripper.
        limit: The largest horizontal motion along each axis, in units of an action.
    """
    x, y = offset[0] / _STEP, offset[1] / _STEP
    scale = min(1.0, limit / max(abs(x), abs(y), 1e-9))
    return np.array((x * scale, y * scale, np.clip(height / _STEP, -1, 1), grip), np.float32)


def _ramp(value: float, low: float, high: float) -> float:
    return min(max((value - low) / (high - low), 0.0), 1.0)


def _is_within(offset: tuple[float, float], bounds: tuple[float, float]) -> bool:
    return abs(offset[0]) < bounds[0] and abs(offset[1]) < bounds[1]
