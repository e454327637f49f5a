"""The physics of the table, and the goals of its episodes.

Quasi-static: a puck moves where it is carried or pushed and otherwise rests or falls. Plain floats
replace arrays: for a handful of bodies they are several times faster.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

PUCK_RADIUS = 0.022  # m
PUCK_HEIGHT = 0.03  # m
PAD_HALF = 0.045  # m, half the side of the square
FINGER_RADIUS = 0.007  # m
GAP_OPEN = 0.038  # m, from the gripper's centre to the inner face of a finger; closed it is 0
REACH = ((-0.30, 0.30), (-0.23, 0.23), (0.0, 0.18))  # m, reach of the fingertips
HOME = (0.0, 0.20, 0.16)  # m, initial position of the fingertips
STEP_LIMIT = 0.03  # m, travel of one control step along each axis

_TABLE = (0.30, 0.24)  # m, half extents; a rim keeps the pucks on it
_SUBSTEPS = 3  # so that between contact checks a finger moves at most 1 cm, less than its width
_OPENING_RATE = 0.5 / _SUBSTEPS  # share of the whole opening
_CONTACT_PASSES = 4  # enough for a puck cradled by two fingers to come to rest
_FALL = 0.06 / _SUBSTEPS  # m
# m, largest distance of a grasped puck's centre from the line between the fingers.
_GRASP_DEPTH = 0.012
_LIFTED = 0.01  # m
_EPSILON = 1e-6  # m


@dataclass(slots=True)
class Puck:
    colour: str
    x: float
    y: float
    z: float = 0.0  # m, of its underside
    lifted: bool = False  # whether it has left the table in this episode


@dataclass(frozen=True, slots=True)
class Pad:
    colour: str
    x: float
    y: float


class TabletopWorld:
    """The state of one episode."""

    def __init__(self, pucks: list[Puck], pads: list[Pad]) -> None:
        self.pucks, self.pads = pucks, pads
        self.x, self.y, self.z = HOME  # m, midway between the fingertips
        self.gap = GAP_OPEN  # m
        self.held: Puck | None = None

    @property
    def opening(self) -> float:
        """The gripper's opening in [0, 1]; about 0.58 while it holds a puck."""
        return self.gap / GAP_OPEN

    def puck(self, colour: str) -> Puck:
        return next(p for p in self.pucks if p.colour == colour)

    def pad(self, colour: str) -> Pad:
        return next(p for p in self.pads if p.colour == colour)

    def step(self, dx: float, dy: float, dz: float, opening: float) -> None:
        """Move the fingertips by (dx, dy, dz) m and the fingers towards `opening` in [0, 1]."""
        for _ in range(_SUBSTEPS):
            self._travel(dx / _SUBSTEPS, dy / _SUBSTEPS)
            self._raise(dz / _SUBSTEPS)
            self._grip(opening)
            for puck in sorted(self.pucks, key=lambda p: p.z):
                if puck is not self.held and puck.z > 0.0:
                    puck.z = max(puck.z - _FALL, self._support(puck))
                puck.lifted = puck.lifted or puck.z > _LIFTED

    def _travel(self, dx: float, dy: float) -> None:
        x, y = _clip(self.x + dx, REACH[0]), _clip(self.y + dy, REACH[1])
        dx, dy = x - self.x, y - self.y
        for puck in self._carried():
            puck.x += dx
            puck.y += dy
        self.x, self.y = x, y
        lowest = self.z if self.held is None else min(self.z, self.held.z)
        if any(lowest < puck.z + PUCK_HEIGHT for puck in self.pucks if puck is not self.held):
            self._push()

    def _push(self) -> None:
        reach, offset = PUCK_RADIUS + FINGER_RADIUS, self.gap + FINGER_RADIUS
        for puck in self.pucks:
            if puck is self.held or puck.z + PUCK_HEIGHT <= self.z + _EPSILON:
                continue
            if self._between_fingers(puck):
                slack = max(self.gap - PUCK_RADIUS, 0.0)
                puck.x = _clip(puck.x, (self.x - slack, self.x + slack))
                continue
            for _ in range(_CONTACT_PASSES):
                # both fingers push at once: in sequence they would push a centred puck aside
                pushes = [
                    _overlap(puck, self.x + side * offset, self.y, reach) for side in (-1.0, 1.0)
                ]
                puck.x += sum(push[0] for push in pushes if push)
                puck.y += sum(push[1] for push in pushes if push)
                if not any(pushes):
                    break
        for _ in range(len(self.pucks)):  # a pushed puck pushes the next
            if not self._separate():
                break

    def _separate(self) -> bool:
        moved = False
        for i, a in enumerate(self.pucks):
            for b in self.pucks[i + 1 :]:
                if abs(a.z - b.z) >= PUCK_HEIGHT - _EPSILON:
                    continue
                still, loose = (b, a) if b is self.held else (a, b)
                if push := _overlap(loose, still.x, still.y, 2 * PUCK_RADIUS):
                    loose.x += push[0]
                    loose.y += push[1]
                    moved = True
        for puck in self.pucks:
            if puck is not self.held:
                puck.x = _clip(puck.x, (PUCK_RADIUS - _TABLE[0], _TABLE[0] - PUCK_RADIUS))
                puck.y = _clip(puck.y, (PUCK_RADIUS - _TABLE[1], _TABLE[1] - PUCK_RADIUS))
        return moved

    def _raise(self, dz: float) -> None:
        z = _clip(self.z + dz, REACH[2])
        if self.held is not None:
            z = max(z, self.z + self._support(self.held) - self.held.z)
        elif dz < 0:
            for puck in self.pucks:
                top = puck.z + PUCK_HEIGHT
                if z < top <= self.z + _EPSILON and self._finger_over(puck):
                    z = top
        for puck in self._carried():
            puck.z += z - self.z
        self.z = z

    def _grip(self, opening: float) -> None:
        change = _clip(opening - self.opening, (-_OPENING_RATE, _OPENING_RATE))
        gap = _clip(self.gap + change * GAP_OPEN, (0.0, GAP_OPEN))
        if self.held is not None:
            if gap > PUCK_RADIUS + _EPSILON:
                self.held = None
                self.gap = gap
            return
        if change < 0:
            for puck in self.pucks:
                if not self._between_fingers(puck):
                    continue
                slack = max(gap - PUCK_RADIUS, 0.0)
                puck.x = _clip(puck.x, (self.x - slack, self.x + slack))
                if gap <= PUCK_RADIUS:
                    gap, self.held = PUCK_RADIUS, puck
                    break
        self.gap = gap

    def _support(self, puck: Puck) -> float:
        """Return the height of the support of `puck`, m: the table, or a puck under its centre
        of mass.
        """
        height = 0.0
        for other in self.pucks:
            top = other.z + PUCK_HEIGHT
            if (
                other is not puck
                and top <= puck.z + _EPSILON
                and _distance(puck, other) < PUCK_RADIUS
            ):
                height = max(height, top)
        return height

    def _carried(self) -> list[Puck]:
        if self.held is None:
            return []
        carried = [self.held]
        for puck in sorted(self.pucks, key=lambda p: p.z):
            below = [one for one in carried if abs(puck.z - one.z - PUCK_HEIGHT) < _EPSILON]
            if any(_distance(puck, one) < PUCK_RADIUS for one in below):
                carried.append(puck)
        return carried

    def _between_fingers(self, puck: Puck) -> bool:
        return (
            abs(puck.y - self.y) < _GRASP_DEPTH
            and abs(puck.x - self.x) < max(self.gap, _EPSILON)
            and puck.z - _LIFTED < self.z < puck.z + 0.6 * PUCK_HEIGHT
        )

    def _finger_over(self, puck: Puck) -> bool:
        reach = PUCK_RADIUS + FINGER_RADIUS - _EPSILON
        offset = self.gap + FINGER_RADIUS
        return any(
            math.hypot(self.x + s * offset - puck.x, self.y - puck.y) < reach for s in (-1.0, 1.0)
        )


def _overlap(puck: Puck, x: float, y: float, distance: float) -> tuple[float, float] | None:
    """Return the shift (dx, dy) that moves a puck to `distance` from (x, y); None if it is far
    enough away.
    """
    dx, dy = puck.x - x, puck.y - y
    if (have := math.hypot(dx, dy)) >= distance - _EPSILON:
        return None
    if have < _EPSILON:
        # At the centre any direction is valid, as long as it is always the same.
        return 0.0, -distance
    return dx * (distance / have - 1), dy * (distance / have - 1)


def _distance(a: Puck, b: Puck) -> float:
    return math.hypot(a.x - b.x, a.y - b.y)


def _clip(value: float, bounds: tuple[float, float]) -> float:
    return min(max(value, bounds[0]), bounds[1])


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
_AT_PAD = PAD_HALF - 0.008  # m, largest distance of a puck's centre from the pad's, along each axis
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
        """Return whether the puck is at the instruction's target and released."""
        puck = world.puck(self.puck)
        if self.target is None:
            return puck is world.held and puck.z >= _LIFT_HEIGHT
        if puck is world.held:
            return False
        x, y, z = self.place(world)
        if self.task == "stack":
            return math.hypot(puck.x - x, puck.y - y) < PUCK_RADIUS and abs(puck.z - z) < 1e-3
        at_pad = abs(puck.x - x) <= _AT_PAD and abs(puck.y - y) <= _AT_PAD and puck.z < 1e-3
        return at_pad and not (self.task == "slide" and puck.lifted)

    def place(self, world: TabletopWorld) -> tuple[float, float, float]:
        """Return the target of the centre of the puck's underside: x, y, z in m, in the base
        frame.
        """
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


def draw_episode(
    task: Task, rng: np.random.Generator, pucks: int = PUCKS
) -> tuple[TabletopWorld, Goal]:
    """Draw a scene with `pucks` pucks, and a goal; a slide is drawn only if no puck is in its
    way.
    """
    while True:
        world = _draw_scene(rng, pucks)
        wanted = [goal for goal in goals(world, task) if task != "slide" or _is_clear(world, goal)]
        if wanted:
            return world, wanted[rng.integers(len(wanted))]


def _draw_scene(rng: np.random.Generator, count: int) -> TabletopWorld:
    while True:
        # x, y, and the clearance from objects of the same kind.
        places: list[tuple[float, float, float]] = []
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
        pucks = [
            Puck(str(c), x, y) for c, (x, y, _) in zip(puck_colours, places[_PADS:], strict=True)
        ]
        return TabletopWorld(pucks, pads)


def _is_clear(world: TabletopWorld, goal: Goal) -> bool:
    start, end = world.puck(goal.puck), world.pad(goal.target or "")
    dx, dy = end.x - start.x, end.y - start.y
    length = math.hypot(dx, dy)
    for other in world.pucks:
        if other is start:
            continue
        along = min(
            max(((other.x - start.x) * dx + (other.y - start.y) * dy) / length**2, 0.0), 1.0
        )
        if math.hypot(start.x + along * dx - other.x, start.y + along * dy - other.y) < _CORRIDOR:
            return False
    return True
