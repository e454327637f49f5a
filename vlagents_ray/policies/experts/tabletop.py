"""An expert for the tabletop that uses the image, the proprioception and the instruction.

It does not read the state of the simulator. As in a calibrated robot cell, the pose of the camera
(see `vlagents_ray.envs.tabletop`) and the height of a puck are known, and objects are located in
the image.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np

from vlagents_ray.errors import InvalidObservation, MissingCamera, MissingState, NotReset
from vlagents_ray.interface import Act, Obs

_VIEW = 0.66  # length that the image's shorter side shows, m
# Factors that project lengths along y and z onto the image's vertical axis.
_Y_FACTOR, _Z_FACTOR = math.sin(math.radians(70)), math.cos(math.radians(70))
_METRES_PER_UNIT = 0.03

_HUES = {"red": 1.0, "yellow": 46.0, "green": 133.0, "blue": 216.0, "purple": 274.0}  # degrees
_HUE_TOLERANCE = 20.0  # degrees
_PASTEL, _FULL = (0.15, 0.5), (0.55, 1.0)  # ranges of saturation of pads and of pucks
_PUCK_HEIGHT = 0.03  # m
# Largest distance of the pixels of a puck or a pad from its centre, m.
_PUCK_REACH, _PAD_REACH = 0.034, 0.06

_TRAVEL_Z, _GRASP_Z = 0.10, 0.006  # heights of the fingertips, m
_AWAY = (0.0, 0.20, 0.16)  # position in which the gripper occludes no objects, m
_ARRIVED = 0.003  # tolerance of reached positions, m
_HOLDING = 0.4  # opening of closed fingers above which they hold a puck
_OPEN, _CLOSED = 1.0, -1.0

_INSTRUCTIONS = {
    "place": re.compile(r"put the (\w+) puck on the (\w+) pad"),
    "slide": re.compile(r"slide the (\w+) puck onto the (\w+) pad"),
    "stack": re.compile(r"stack the (\w+) puck on the (\w+) puck"),
    "lift": re.compile(r"lift the (\w+) puck"),
}


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A position of the fingertips, and the action at that position."""

    xyz: tuple[float, float, float]  # m
    grip: float  # command of the gripper
    wait: int = 0  # steps to stay at the position
    grasps: bool = False  # whether a puck must be held when this waypoint is left
    looks: bool = False  # whether to plan again from a new image


class TabletopExpert:
    """Plans waypoints from one image and follows them. After a failed grasp, it plans again."""

    def __init__(self, env_name: str) -> None:
        self._env_name = env_name
        self._instruction = ""
        self._plan: list[Waypoint] = []
        self._waited = 0

    def reset(self, obs: Obs, instruction: str) -> None:
        """Plan an episode from its first image."""
        self._plan = plan(_image(obs), instruction)
        self._instruction = instruction
        self._waited = 0

    def act(self, obs: Obs) -> Act:
        """Return the next action along the plan, (4,); `done` after its last waypoint."""
        if not self._plan:
            raise NotReset(
                f"{self._env_name}: act was called before reset; call reset(obs, instruction) first"
            )
        if "xyzrpy" not in obs.state:
            raise MissingState("xyzrpy", have=obs.state)
        if obs.gripper is None:
            raise InvalidObservation(
                "gripper: expected a number in [0, 1] where 1 = open, got None; set it in the "
                "observation"
            )

        position, opening = obs.state["xyzrpy"][:3].astype(np.float64), obs.gripper
        done = False
        if self._has_arrived(position) and self._waited >= self._plan[0].wait:
            done = len(self._plan) == 1 and not self._plan[0].looks
            if not done:
                self._plan = self._after(self._plan, obs, position, opening)
                self._waited = 0
        if self._has_arrived(position):
            self._waited += 1

        offset = (np.array(self._plan[0].xyz) - position) / _METRES_PER_UNIT
        # All axes are scaled by the same factor, so that the motion stays on the straight line.
        offset /= max(1.0, float(np.abs(offset).max()))
        return Act(np.append(offset, self._plan[0].grip).astype(np.float32), done=done)

    def _after(
        self, plan_so_far: list[Waypoint], obs: Obs, position: np.ndarray, opening: float
    ) -> list[Waypoint]:
        """Return the remaining plan after its first waypoint has been reached."""
        if plan_so_far[0].looks:
            return plan(_image(obs), self._instruction)
        if plan_so_far[0].grasps and opening < _HOLDING:
            x, y, _ = position.tolist()
            return [Waypoint((x, y, _TRAVEL_Z), _OPEN), Waypoint(_AWAY, _OPEN, looks=True)]
        return plan_so_far[1:]

    def _has_arrived(self, position: np.ndarray) -> bool:
        """Return whether the fingertips are at the first waypoint of the plan."""
        return bool(np.abs(np.array(self._plan[0].xyz) - position).max() < _ARRIVED)


def plan(image: np.ndarray, instruction: str) -> list[Waypoint]:
    """Plan waypoints that fulfil an instruction.

    Args:
        image: The image of the scene, (H, W, 3) uint8.
        instruction: An instruction of the tabletop.

    Raises:
        InvalidObservation: The instruction is unknown, or an object is not in the image.
    """
    task, puck, target = _parse(instruction)
    objects = _ColouredObjects(image)
    x, y = objects.puck(puck)
    grasp = [
        Waypoint((x, y, _TRAVEL_Z), _OPEN),
        Waypoint((x, y, _GRASP_Z), _OPEN),
        Waypoint((x, y, _GRASP_Z), _CLOSED, wait=2, grasps=True),
    ]
    if task == "lift":
        return [*grasp, Waypoint((x, y, 0.13), _CLOSED, wait=1)]

    if task == "stack":
        to_x, to_y = objects.puck(target)
        low = _GRASP_Z + (_PUCK_HEIGHT + 0.003)
    else:
        to_x, to_y = objects.pad(target)
        low = _GRASP_Z
    carry = [Waypoint((x, y, _TRAVEL_Z), _CLOSED), Waypoint((to_x, to_y, _TRAVEL_Z), _CLOSED)]
    place = [
        Waypoint((to_x, to_y, low), _CLOSED),
        Waypoint((to_x, to_y, low), _OPEN, wait=2),
        Waypoint((to_x, to_y, _TRAVEL_Z), _OPEN),
    ]
    if task == "slide":
        return [*grasp, *place]
    return [*grasp, *carry, *place]


def _parse(instruction: str) -> tuple[str, str, str]:
    """Return the task, the colour of the puck, and the colour of the target.

    The target of a lift is the puck itself.
    """
    for task, pattern in _INSTRUCTIONS.items():
        match = pattern.fullmatch(instruction.strip().lower().rstrip("."))
        if match and all(colour in _HUES for colour in match.groups()):
            return task, match[1], match[match.re.groups]
    raise InvalidObservation(
        "tabletop expert: expected an instruction like 'put the red puck on the blue pad', "
        f"'slide ... onto ...', 'stack ...' or 'lift ...', with colours of {sorted(_HUES)}, got "
        f"{instruction!r}"
    )


class _ColouredObjects:
    """The positions on the table of the coloured objects in an image."""

    def __init__(self, image: np.ndarray) -> None:
        """Find the coloured pixels of an image, (H, W, 3) uint8, with their hue and saturation."""
        height, width = image.shape[:2]
        self._centre = (width / 2, height / 2)
        self._scale = min(width, height) / _VIEW  # px/m

        red, green, blue = (image[..., i].astype(np.float32) for i in range(3))
        brightest = np.maximum(np.maximum(red, green), blue)
        chroma = brightest - np.minimum(np.minimum(red, green), blue)
        rows, columns = np.nonzero((brightest > 50) & (chroma > _PASTEL[0] * brightest))
        # Coordinates of the pixels' centres, px.
        self._columns, self._rows = columns + 0.5, rows + 0.5

        red, green, blue = red[rows, columns], green[rows, columns], blue[rows, columns]
        brightest, chroma = brightest[rows, columns], chroma[rows, columns]
        self._saturation = chroma / brightest
        # https://en.wikipedia.org/wiki/HSL_and_HSV#Hue_and_chroma
        sextant = np.select(
            [brightest == red, brightest == green],
            [(green - blue) / chroma, (blue - red) / chroma + 2],
            (red - green) / chroma + 4,
        )
        self._hue = sextant * 60  # degrees, from -60

    def puck(self, colour: str) -> tuple[float, float]:
        """Return the position of the puck of a colour, (x, y) m."""
        return self._find(colour, "puck", _FULL, _PUCK_REACH, _PUCK_HEIGHT / 2)

    def pad(self, colour: str) -> tuple[float, float]:
        """Return the position of the pad of a colour, (x, y) m."""
        return self._find(colour, "pad", _PASTEL, _PAD_REACH, 0.0)

    def _find(
        self, colour: str, noun: str, saturation: tuple[float, float], reach: float, z: float
    ) -> tuple[float, float]:
        """Return the position of an object, (x, y) m, by its colour.

        Args:
            colour: A key of `_HUES`.
            noun: "puck" or "pad", for errors.
            saturation: The bounds of its pixels' saturation.
            reach: The largest distance of its pixels from its centre, m.
            z: The height of its pixels' centre, m.
        """
        hue_difference = np.abs((self._hue - _HUES[colour] + 180) % 360 - 180)
        fits = (
            (hue_difference < _HUE_TOLERANCE)
            & (self._saturation > saturation[0])
            & (self._saturation <= saturation[1])
        )
        if np.count_nonzero(fits) < 3:
            raise InvalidObservation(
                f"tabletop expert: sees no {colour} {noun}; is this image the tabletop's 'front'?"
            )

        columns, rows = self._columns[fits], self._rows[fits]
        # The blurred edge of a puck looks like a pad. The median is robust against these few
        # pixels. The mean of the pixels around it is more precise.
        distance = np.hypot(columns - np.median(columns), rows - np.median(rows))
        near = distance < reach * self._scale
        x = (float(columns[near].mean()) - self._centre[0]) / self._scale
        height = (self._centre[1] - float(rows[near].mean())) / self._scale
        return x, (height - z * _Z_FACTOR) / _Y_FACTOR


def _image(obs: Obs) -> np.ndarray:
    """Return the image of the camera "front"."""
    if "front" not in obs.cameras:
        raise MissingCamera("front", have=obs.cameras)
    return obs.cameras["front"]
