"""The goals of episodes, and their scenes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vlagents_ray.envs.tabletop.world import PAD_HALF, PUCK_HEIGHT, PUCK_RADIUS, Pad, Puck, TabletopWorld

Task = Literal["pick_place", "slide", "stack", "lift"]
TEMPLATES: dict[Task, str] = {
    "pick_place": "put the {puck} puck on the {target} pad",
    "slide": "slide the {puck} puck onto the {target} pad",
    "stack": "stack the {puck} puck on the {target} puck",
    "lift": "lift the {puck} puck",
}
COLOURS = ("red", "green", "blue", "yellow", "purple")

PUCKS = 4  # at most
_PADS = 3
_AREA = (0.22, 0.13)  # m, half extents of the area in which objects are placed
_CLEARANCE = 0.09  # m between centres: a puck's own radius, an open finger, and the neighbour
_PAD_CLEARANCE = 0.125  # m between the centres of two pads
_CORRIDOR = 0.065  # m on both sides of a slide that no other puck may be in
_AT_PAD = PAD_HALF - 0.008  # m, how far off the pad's centre a puck's may be, along each axis
_LIFT_HEIGHT = 0.08  # m


@dataclass(frozen=True, slots=True)
class Goal:
    """The goal of an instruction; `target` is the colour of a pad, or of the puck to stack on."""

    task: Task
    puck: str
    target: str | None = None

    @property
    def instruction(self) -> str:
        return TEMPLATES[self.task].format(puck=self.puck, target=self.target)

    def reached(self, world: TabletopWorld) -> bool:
        """Whether the puck is at the instruction's target and released."""
        puck = world.puck(self.puck)
        if self.target is None:
            return puck is world.held and puck.z >= _LIFT_HEIGHT
        if puck is world.held:
            return False
        if self.task == "stack":
            below = world.puck(self.target)
            near = math.hypot(puck.x - below.x, puck.y - below.y) < PUCK_RADIUS
            return near and abs(puck.z - below.z - PUCK_HEIGHT) < 1e-3
        pad = world.pad(self.target)
        at_pad = abs(puck.x - pad.x) <= _AT_PAD and abs(puck.y - pad.y) <= _AT_PAD and puck.z < 1e-3
        return at_pad and not (self.task == "slide" and puck.lifted)

    def place(self, world: TabletopWorld) -> tuple[float, float, float]:
        """Where the middle of the puck's underside is to be: x, y, z in m, in the base frame."""
        if self.target is None:
            puck = world.puck(self.puck)
            return puck.x, puck.y, _LIFT_HEIGHT
        if self.task == "stack":
            below = world.puck(self.target)
            return below.x, below.y, below.z + PUCK_HEIGHT
        pad = world.pad(self.target)
        return pad.x, pad.y, 0.0


def goals(world: TabletopWorld, task: Task) -> list[Goal]:
    """List the goals of a task that are possible in this scene, in a fixed order."""
    pucks, pads = [p.colour for p in world.pucks], [p.colour for p in world.pads]
    if task == "lift":
        return [Goal(task, puck) for puck in pucks]
    targets = pucks if task == "stack" else pads
    return [Goal(task, a, b) for a in pucks for b in targets if task != "stack" or a != b]


def draw_episode(task: Task, rng: np.random.Generator, pucks: int = PUCKS) -> tuple[TabletopWorld, Goal]:
    """Draw a scene with so many pucks, and a goal; a slide is drawn only if no puck is in its way."""
    while True:
        world = _draw_scene(rng, pucks)
        wanted = [goal for goal in goals(world, task) if task != "slide" or _is_clear(world, goal)]
        if wanted:
            return world, wanted[rng.integers(len(wanted))]


def _draw_scene(rng: np.random.Generator, count: int) -> TabletopWorld:
    while True:
        places: list[tuple[float, float, float]] = []  # x, y, and the clearance from another of its kind
        for _ in range(200):
            if len(places) == _PADS + count:
                break
            clearance = _PAD_CLEARANCE if len(places) < _PADS else _CLEARANCE
            x, y = rng.uniform(-1, 1, 2) * _AREA
            if all(math.hypot(x - p[0], y - p[1]) >= min(clearance, p[2]) for p in places):
                places.append((float(x), float(y), clearance))
        if len(places) < _PADS + count:
            continue  # no free place is left: draw again
        pad_colours = rng.permutation(COLOURS)[:_PADS]
        puck_colours = rng.permutation(COLOURS)[:count]
        pads = [Pad(str(c), x, y) for c, (x, y, _) in zip(pad_colours, places[:_PADS], strict=True)]
        pucks = [Puck(str(c), x, y) for c, (x, y, _) in zip(puck_colours, places[_PADS:], strict=True)]
        return TabletopWorld(pucks, pads)


def _is_clear(world: TabletopWorld, goal: Goal) -> bool:
    start, end = world.puck(goal.puck), world.pad(goal.target or "")
    dx, dy = end.x - start.x, end.y - start.y
    length = math.hypot(dx, dy)
    for other in world.pucks:
        if other is start:
            continue
        along = min(max(((other.x - start.x) * dx + (other.y - start.y) * dy) / length**2, 0.0), 1.0)
        if math.hypot(start.x + along * dx - other.x, start.y + along * dy - other.y) < _CORRIDOR:
            return False
    return True
