"""The physics of the table, and the goals of its episodes.

The physics is quasi-static: a puck that is not carried or pushed rests or falls. Positions are
plain floats, which are several times faster than arrays for so few bodies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

PUCK_RADIUS = 0.022  # m
PUCK_HEIGHT = 0.03  # m
PAD_HALF = 0.045  # m, half of the square's side
FINGER_RADIUS = 0.007  # m
# m, distance from the gripper's centre to the inner face of an open finger; 0 if closed.
GAP_OPEN = 0.038
REACH = ((-0.30, 0.30), (-0.23, 0.23), (0.0, 0.18))  # m, reach of the fingertips
HOME = (0.0, 0.20, 0.16)  # m, initial position of the fingertips
STEP_LIMIT = 0.03  # m, travel of one control step along each axis

_TABLE = (0.30, 0.24)  # m, half extents of the table, whose rim keeps the pucks on it
# Between two checks of contacts, a finger moves by at most 1 cm, which is less than its width.
_SUBSTEPS = 3
# Change of the opening per substep, as a share of the whole opening.
_OPENING_RATE = 0.5 / _SUBSTEPS
_CONTACT_PASSES = 4  # number of iterations, enough for a puck between two fingers to come to rest
_FALL = 0.06 / _SUBSTEPS  # m, distance that a puck falls per substep
# m, largest distance of a grasped puck's centre from the line between the fingers.
_GRASP_DEPTH = 0.012
_LIFTED = 0.01  # m, height above which a puck counts as lifted
_EPSILON = 1e-6  # m


@dataclass(slots=True)
class Puck:
    """A puck; x, y and z are the centre of its underside in the base frame, m."""

    colour: str
    x: float
    y: float
    z: float = 0.0
    lifted: bool = False  # whether it has left the table in this episode


@dataclass(frozen=True, slots=True)
class Pad:
    """A pad on the table; x and y are its centre in the base frame, m."""

    colour: str
    x: float
    y: float


class TabletopWorld:
    """The state of one episode."""

    def __init__(self, pucks: list[Puck], pads: list[Pad]) -> None:
        self.pucks, self.pads = pucks, pads
        self.x, self.y, self.z = HOME  # m, midway between the fingertips
        self.gap = GAP_OPEN  # m, from the gripper's centre to each finger
        self.held_puck: Puck | None = None

    @property
    def opening(self) -> float:
        """The gripper's opening in [0, 1]; about 0.58 while it holds a puck."""
        return self.gap / GAP_OPEN

    def puck(self, colour: str) -> Puck:
        """Return the puck of a colour."""
        return next(puck for puck in self.pucks if puck.colour == colour)

    def pad(self, colour: str) -> Pad:
        """Return the pad of a colour."""
        return next(pad for pad in self.pads if pad.colour == colour)

    def step(self, dx: float, dy: float, dz: float, opening: float) -> None:
        """Move the fingertips by (dx, dy, dz) m and the fingers towards `opening` in [0, 1]."""
        for _ in range(_SUBSTEPS):
            self._travel(dx / _SUBSTEPS, dy / _SUBSTEPS)
            self._raise(dz / _SUBSTEPS)
            self._grip(opening)
            for puck in sorted(self.pucks, key=lambda puck: puck.z):
                if puck is not self.held_puck and puck.z > 0.0:
                    puck.z = max(puck.z - _FALL, self._support(puck))
                puck.lifted = puck.lifted or puck.z > _LIFTED

    def _travel(self, dx: float, dy: float) -> None:
        """Move the fingertips and carried pucks horizontally, and push pucks that are in the
        way.
        """
        x, y = _clip(self.x + dx, REACH[0]), _clip(self.y + dy, REACH[1])
        dx, dy = x - self.x, y - self.y
        for puck in self._carried():
            puck.x += dx
            puck.y += dy
        self.x, self.y = x, y

        lowest = self.z if self.held_puck is None else min(self.z, self.held_puck.z)
        free_pucks = [puck for puck in self.pucks if puck is not self.held_puck]
        if any(lowest < puck.z + PUCK_HEIGHT for puck in free_pucks):
            self._push()

    def _push(self) -> None:
        """Move the pucks that the fingers touch, and the pucks that these pucks touch."""
        reach, offset = PUCK_RADIUS + FINGER_RADIUS, self.gap + FINGER_RADIUS
        for puck in self.pucks:
            if puck is self.held_puck or puck.z + PUCK_HEIGHT <= self.z + _EPSILON:
                continue
            if self._between_fingers(puck):
                slack = max(self.gap - PUCK_RADIUS, 0.0)
                puck.x = _clip(puck.x, (self.x - slack, self.x + slack))
                continue
            for _ in range(_CONTACT_PASSES):
                # Both fingers push at once: if they pushed in sequence, they would push a centred
                # puck aside.
                finger_xs = (self.x - offset, self.x + offset)
                overlaps = [_overlap(puck, finger_x, self.y, reach) for finger_x in finger_xs]
                pushes = [overlap for overlap in overlaps if overlap is not None]
                puck.x += sum(dx for dx, _ in pushes)
                puck.y += sum(dy for _, dy in pushes)
                if not pushes:
                    break

        for _ in range(len(self.pucks)):  # A pushed puck pushes the next one.
            if not self._separate():
                break

    def _separate(self) -> bool:
        """Move overlapping pucks apart, once for each pair; return whether any puck moved."""
        moved = False
        for i, first in enumerate(self.pucks):
            for second in self.pucks[i + 1 :]:
                if abs(first.z - second.z) >= PUCK_HEIGHT - _EPSILON:
                    continue
                still, loose = first, second
                if second is self.held_puck:
                    still, loose = second, first
                push = _overlap(loose, still.x, still.y, 2 * PUCK_RADIUS)
                if push is not None:
                    loose.x += push[0]
                    loose.y += push[1]
                    moved = True
        for puck in self.pucks:
            if puck is not self.held_puck:
                puck.x = _clip(puck.x, (PUCK_RADIUS - _TABLE[0], _TABLE[0] - PUCK_RADIUS))
                puck.y = _clip(puck.y, (PUCK_RADIUS - _TABLE[1], _TABLE[1] - PUCK_RADIUS))
        return moved

    def _raise(self, dz: float) -> None:
        """Move the fingertips and carried pucks vertically, down to the next obstacle."""
        z = _clip(self.z + dz, REACH[2])
        if self.held_puck is not None:
            z = max(z, self.z + self._support(self.held_puck) - self.held_puck.z)
        elif dz < 0:
            for puck in self.pucks:
                top = puck.z + PUCK_HEIGHT
                if z < top <= self.z + _EPSILON and self._finger_over(puck):
                    z = top
        for puck in self._carried():
            puck.z += z - self.z
        self.z = z

    def _grip(self, opening: float) -> None:
        """Move the fingers towards an opening in [0, 1], and grasp or release a puck."""
        change = _clip(opening - self.opening, (-_OPENING_RATE, _OPENING_RATE))
        gap = _clip(self.gap + change * GAP_OPEN, (0.0, GAP_OPEN))
        if self.held_puck is not None:
            if gap > PUCK_RADIUS + _EPSILON:
                self.held_puck = None
                self.gap = gap
            return
        if change < 0:
            for puck in self.pucks:
                if not self._between_fingers(puck):
                    continue
                slack = max(gap - PUCK_RADIUS, 0.0)
                puck.x = _clip(puck.x, (self.x - slack, self.x + slack))
                if gap <= PUCK_RADIUS:
                    gap, self.held_puck = PUCK_RADIUS, puck
                    break
        self.gap = gap

    def _support(self, puck: Puck) -> float:
        """Return the height at which `puck` rests, m: on the table, or on a puck.

        A puck supports another puck if it is below the other puck's centre of mass.
        """
        height = 0.0
        for lower in self.pucks:
            top = lower.z + PUCK_HEIGHT
            is_below = lower is not puck and top <= puck.z + _EPSILON
            if is_below and _distance(puck, lower) < PUCK_RADIUS:
                height = max(height, top)
        return height

    def _carried(self) -> list[Puck]:
        """Return the held puck and all pucks that are stacked on it."""
        if self.held_puck is None:
            return []

        carried = [self.held_puck]
        for puck in sorted(self.pucks, key=lambda puck: puck.z):
            for lower in carried:
                is_on_top = abs(puck.z - lower.z - PUCK_HEIGHT) < _EPSILON
                if is_on_top and _distance(puck, lower) < PUCK_RADIUS:
                    carried.append(puck)
                    break
        return carried

    def _between_fingers(self, puck: Puck) -> bool:
        """Return whether a puck's centre is between the fingers."""
        return (
            abs(puck.y - self.y) < _GRASP_DEPTH
            and abs(puck.x - self.x) < max(self.gap, _EPSILON)
            and puck.z - _LIFTED < self.z < puck.z + 0.6 * PUCK_HEIGHT
        )

    def _finger_over(self, puck: Puck) -> bool:
        """Return whether a finger is above or inside a puck, for any height of the finger."""
        reach = PUCK_RADIUS + FINGER_RADIUS - _EPSILON
        offset = self.gap + FINGER_RADIUS
        finger_xs = (self.x - offset, self.x + offset)
        return any(math.hypot(x - puck.x, self.y - puck.y) < reach for x in finger_xs)


def _overlap(puck: Puck, x: float, y: float, distance: float) -> tuple[float, float] | None:
    """Return the shift (dx, dy) that moves a puck to the given distance from the point (x, y),
    m.

    Returns:
        The shift; None if the puck is at least that far away.
    """
    dx, dy = puck.x - x, puck.y - y
    current = math.hypot(dx, dy)
    if current >= distance - _EPSILON:
        return None
    if current < _EPSILON:
        # If the puck is exactly at the point, any direction is valid, as long as it is always the
        # same.
        return 0.0, -distance
    return dx * (distance / current - 1), dy * (distance / current - 1)


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

PUCKS = 4  # largest number of pucks
_PADS = 3
_AREA = (0.22, 0.13)  # m, half extents of the area in which objects are placed
_CLEARANCE = 0.09  # m between the centres of two pucks: room for both pucks and an open finger
_PAD_CLEARANCE = 0.125  # m between the centres of two pads
_CORRIDOR = 0.065  # m, width of the zone on both sides of a slide that must be free of other pucks
# m, largest distance of a puck's centre from the pad's centre, along each axis.
_AT_PAD = PAD_HALF - 0.008
_LIFT_HEIGHT = 0.08  # m


@dataclass(frozen=True, slots=True)
class Goal:
    """The goal of an instruction."""

    task: Task
    puck: str  # colour of the puck
    target: str | None = None  # colour of the pad, or of the puck to stack on

    @property
    def instruction(self) -> str:
        """The goal in words."""
        return TEMPLATES[self.task].format(puck=self.puck, target=self.target)

    def is_reached(self, world: TabletopWorld) -> bool:
        """Return whether the puck is at the instruction's target and released."""
        puck = world.puck(self.puck)
        if self.target is None:
            return puck is world.held_puck and puck.z >= _LIFT_HEIGHT
        if puck is world.held_puck:
            return False
        x, y, z = self.target_position(world)
        if self.task == "stack":
            return math.hypot(puck.x - x, puck.y - y) < PUCK_RADIUS and abs(puck.z - z) < 1e-3
        at_pad = abs(puck.x - x) <= _AT_PAD and abs(puck.y - y) <= _AT_PAD and puck.z < 1e-3
        return at_pad and not (self.task == "slide" and puck.lifted)

    def target_position(self, world: TabletopWorld) -> tuple[float, float, float]:
        """Return the target position of the centre of the puck's underside in the base frame, (x,
        y, z), m.
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
    """Return the goals of a task that are possible in this scene, in a fixed order."""
    pucks = [puck.colour for puck in world.pucks]
    if task == "lift":
        return [Goal(task, puck) for puck in pucks]

    targets = pucks if task == "stack" else [pad.colour for pad in world.pads]
    possible = []
    for puck in pucks:
        for target in targets:
            if task != "stack" or puck != target:
                possible.append(Goal(task, puck, target))
    return possible


def draw_episode(
    task: Task, rng: np.random.Generator, pucks: int = PUCKS
) -> tuple[TabletopWorld, Goal]:
    """Draw a scene and a goal.

    A goal of the task "slide" is drawn only if no other puck is in the way of the slide.

    Args:
        task: The task of the goal.
        rng: Determines the scene and the goal.
        pucks: The number of pucks.
    """
    while True:
        world = _draw_scene(rng, pucks)
        possible = goals(world, task)
        if task == "slide":
            possible = [goal for goal in possible if _is_clear(world, goal)]
        if possible:
            return world, possible[rng.integers(len(possible))]


def _draw_scene(rng: np.random.Generator, count: int) -> TabletopWorld:
    """Draw the positions and colours of three pads and `count` pucks."""
    while True:
        positions = _draw_positions(rng, _PADS + count)
        if positions is None:
            continue

        pad_colours = rng.permutation(COLOURS)[:_PADS]
        puck_colours = rng.permutation(COLOURS)[:count]
        pads, pucks = [], []
        for colour, (x, y) in zip(pad_colours, positions[:_PADS], strict=True):
            pads.append(Pad(str(colour), x, y))
        for colour, (x, y) in zip(puck_colours, positions[_PADS:], strict=True):
            pucks.append(Puck(str(colour), x, y))
        return TabletopWorld(pucks, pads)


def _draw_positions(rng: np.random.Generator, count: int) -> list[tuple[float, float]] | None:
    """Draw the positions of pads and then pucks, m; return None if there is no room for one of
    them.
    """
    # Items: x, y, and the clearance from objects of the same kind.
    drawn: list[tuple[float, float, float]] = []
    for _ in range(200):
        if len(drawn) == count:
            break
        clearance = _PAD_CLEARANCE if len(drawn) < _PADS else _CLEARANCE
        x, y = rng.uniform(-1, 1, 2) * _AREA
        is_free = True
        for other_x, other_y, other_clearance in drawn:
            distance = math.hypot(x - other_x, y - other_y)
            is_free = is_free and distance >= min(clearance, other_clearance)
        if is_free:
            drawn.append((float(x), float(y), clearance))

    if len(drawn) < count:
        return None
    return [(x, y) for x, y, _ in drawn]


def _is_clear(world: TabletopWorld, goal: Goal) -> bool:
    """Return whether no other puck is in the way of a slide."""
    start, end = world.puck(goal.puck), world.pad(goal.target or "")
    dx, dy = end.x - start.x, end.y - start.y
    length = math.hypot(dx, dy)
    for other in world.pucks:
        if other is start:
            continue
        # The point on the slide that is nearest to the other puck, as a share of the slide's
        # length.
        share = ((other.x - start.x) * dx + (other.y - start.y) * dy) / length**2
        share = _clip(share, (0.0, 1.0))
        x, y = start.x + share * dx, start.y + share * dy
        if math.hypot(x - other.x, y - other.y) < _CORRIDOR:
            return False
    return True
