"""The teacher, which uses feedback from each observation to lift a puck, so that it can advise in
any state.
"""

from __future__ import annotations

import math

import numpy as np
from colours import named_colour, puck_position

from vlagents_ray.contract import Contract
from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.errors import MissingCamera, MissingState, NotReset
from vlagents_ray.interface import Act, Agent, Obs

_STEP = 0.03  # travel of the fingertips at an action of 1, m
_GRASP_Z = 0.006  # m
_FUNNEL = 3.0  # height per distance from the puck, m per m, outside of the radius `_CENTRED`
_CENTRED, _AT, _LOW = 0.004, 0.008, 0.012  # m
_HIGHEST = 0.08  # largest height above the height for grasps, m
# Heights and distances in m. If the fingers are lower, they hide a part of the puck, which shifts
# its measured position by up to 13 mm.
_CLEAR, _MOVED = 0.06, 0.02
_HELD = (0.5, 0.7)  # range of the opening of fingers around a puck
_OPEN, _CLOSED = 1.0, -1.0


class Teacher(Agent):
    """Descends to the last visible position of the puck in a funnel, closes the fingers, and
    lifts it.
    """

    def __init__(self) -> None:
        self._colour: str | None = None
        self._puck = (0.0, 0.0)  # m

    @property
    def contract(self) -> Contract:
        return Tabletop.known_contract({"width": None, "height": None})

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict[str, object]:
        """Begin an episode of `tabletop/lift`.

        Raises:
            InvalidObservation: The instruction names no puck.
        """
        self._colour, self._puck = named_colour(instruction), (0.0, 0.0)
        return {}

    def act(self, obs: Obs) -> Act:
        if self._colour is None:
            raise NotReset(
                "teacher: act was called before reset; call reset(obs, instruction) first"
            )
        if "front" not in obs.cameras:
            raise MissingCamera("front", have=obs.cameras)
        if "xyzrpy" not in obs.state:
            raise MissingState("xyzrpy", have=obs.state)
        x, y, z = obs.state["xyzrpy"][:3].tolist()
        seen = puck_position(obs.cameras["front"], self._colour)
        if seen and (z > _CLEAR or math.dist(seen, self._puck) > _MOVED):
            self._puck = seen
        opening = float(obs.gripper or 0.0)
        dx, dy = self._puck[0] - x, self._puck[1] - y
        distance = math.hypot(dx, dy)
        fingers = _OPEN
        if opening < _HELD[1]:  # closed, with or without the puck
            height, fingers = z + _STEP, _CLOSED if opening > _HELD[0] else _OPEN
        else:
            height = _GRASP_Z + min(max(_FUNNEL * (distance - _CENTRED), 0.0), _HIGHEST)
            if distance < _AT and z < _LOW:
                fingers = _CLOSED
        move = np.array([dx, dy, height - z]) / _STEP
        return Act(np.clip(np.append(move, fingers), -1.0, 1.0).astype(np.float32))
