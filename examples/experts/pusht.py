"""An expert for PushT, which tries pushes from all sides of the block in its own simulator, and
executes the best one.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from vlagents_ray.interface import Act, Obs
from vlagents_ray.policies.experts import sim_vector
from vlagents_ray.registry import require

# Numbers of the state: position (2) and velocity (2) of the agent, position (2) and angle (1) of
# the block.
_SIZE = 7
_FIELD_PX = 512.0
_CLEAR_PX = 6.0  # distance between agent and block on the path around the block
_APART_PX = 30.0  # distance between two positions from which pushes are tried
_WALK_PX = 50.0  # length of each step of the path around the block
_PUSHES_PX = (16.0, 6.0, 2.0)  # step lengths of a push, from coarse to fine
_PUSH_STEPS = 12
_STEP_COSTS_PX = 0.15  # smallest reduction of the error that justifies a further step
_WORSE_PX = 5.0  # a trial ends when its error exceeds its lowest error by this amount
_ASTRAY_PX = 2.0  # error of the block's predicted corners above which a new push is planned
# The agent follows its target as a critically damped spring of 10 rad/s. In a step of 0.1 s, the
# agent covers this share of the distance, and then continues with its velocity for this time.
_COVERED = 1 - 2 / math.e
_CARRIED_S = 0.1 / math.e


class _Step(NamedTuple):
    action: np.ndarray  # (2,) float32, px
    expected: np.ndarray  # state after the action, (7,)
    solves: bool


class PushTExpert:
    """Solves PushT with `info["sim_state"]` of `vlagents_ray.envs.gymnasium`.

    Actions are (2,) in [0, 512] px.

    A push moves straight towards the block, from one of several positions around the block, at one
    of three speeds. The expert chooses the push and its last step so that the block's corners come
    as near as possible to the target's corners.
    """

    def __init__(self, env_name: str) -> None:
        self._name = env_name
        self._sim: Any = require("gym_pusht.envs.pusht").PushTEnv()
        self._shapely: Any = require("shapely")
        self._sim.reset(seed=0)
        parts = [self._shapely.Polygon(part.get_vertices()) for part in self._sim.block.shapes]
        outline = self._shapely.union_all(parts).normalize()
        # The corners of the block in the block's frame, (N, 2) px.
        self._corners: np.ndarray = self._shapely.get_coordinates(outline)
        self._target = self._placed(self._sim.goal_pose)
        [disc] = self._sim.agent.shapes
        # Smallest distance from the block to the agent's centre.
        self._reach = disc.radius + _CLEAR_PX
        self._plan: deque[_Step] = deque()
        self._expected = np.zeros(_SIZE)

    def reset(self, obs: Obs, instruction: str) -> None:
        sim_vector(obs, _SIZE, self._name)
        self._plan.clear()

    def act(self, obs: Obs) -> Act:
        """Compute the next action, (2,) float32. Choosing a new push takes longer."""
        state = sim_vector(obs, _SIZE, self._name)
        if not self._plan or self._error(state, self._placed(self._expected[4:])) > _ASTRAY_PX:
            self._plan = deque(self._best_push(state))
        step = self._plan.popleft()
        self._expected = step.expected
        return Act(step.action)

    def _best_push(self, state: np.ndarray) -> list[_Step]:
        block = self._shapely.Polygon(self._placed(state[4:]))
        around = block.buffer(self._reach)
        still = np.clip(state[:2], 0, _FIELD_PX).astype(np.float32)
        best = [_Step(still, state, solves=False)]  # remains the best if the block is out of reach
        lowest = math.inf
        for share in np.arange(0, 1, _APART_PX / around.length):
            place = around.exterior.interpolate(share, normalized=True)
            begin, touched = self._shapely.get_coordinates(
                self._shapely.shortest_line(place, block)
            )
            if begin.min() < 0 or begin.max() > _FIELD_PX:
                continue
            way = list(self._play(state, self._way(around, state[:2], begin)))
            for stride in _PUSHES_PX:
                ahead = _CLEAR_PX + stride * np.arange(1, _PUSH_STEPS + 1)
                places = begin + np.outer(ahead, (touched - begin) / self._reach)
                steps, nearest = list(way), math.inf
                for step in self._play(way[-1].expected, places):
                    steps.append(step)
                    error = 0.0 if step.solves else self._error(step.expected, self._target)
                    nearest = min(nearest, error)
                    cost = error + _STEP_COSTS_PX * len(steps)
                    if cost < lowest:
                        best, lowest = list(steps), cost
                    if step.solves or error > nearest + _WORSE_PX:
                        break
        return best

    def _way(self, around: Any, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Return the positions of the steps from `start` to `end`, (N, 2) px, along a polygon
        around the block.
        """
        ring = around.exterior
        first, last = (ring.project(self._shapely.Point(place)) for place in (start, end))
        sides = []
        for sign in (1, -1):
            along = np.arange(0, sign * (last - first) % ring.length, _CLEAR_PX)
            line = self._shapely.line_interpolate_point(ring, (first + sign * along) % ring.length)
            sides.append(np.vstack([self._shapely.get_coordinates(line), end]))
        rest = min(sides, key=lambda side: (np.sum((side < 0) | (side > _FIELD_PX)), len(side)))
        inside = around.buffer(-_CLEAR_PX / 4)
        corners = [start]
        # Move straight to the farthest position in sight, or out of the polygon if there is none.
        while len(rest):
            lines = self._shapely.linestrings([[corners[-1], place] for place in rest])
            seen = np.flatnonzero(~self._shapely.crosses(lines, inside))
            chosen = int(seen[-1]) if len(seen) else 0
            corners.append(rest[chosen])
            rest = rest[chosen + 1 :]
        line = self._shapely.LineString(corners)
        steps = max(math.ceil(line.length / _WALK_PX), 1)
        places = self._shapely.line_interpolate_point(
            line, np.arange(1, steps + 1) / steps, normalized=True
        )
        return np.asarray(self._shapely.get_coordinates(places))

    def _play(self, state: np.ndarray, places: np.ndarray) -> Iterator[_Step]:
        """Simulate steps that move the agent to each of `places`, (N, 2) px, one after another."""
        sim = self._sim
        sim._setup()  # a new physics space, since a used space keeps its contacts
        sim.agent.position, sim.agent.velocity = tuple(state[:2]), tuple(state[2:4])
        # The angle is set before the position, since setting it turns the block about its centre of
        # gravity.
        sim.block.angle = state[6]
        sim.block.position = tuple(state[4:6])
        for place in places:
            towards = state[:2] + (place - state[:2] - _CARRIED_S * state[2:4]) / _COVERED
            action = np.clip(towards, 0, _FIELD_PX).astype(np.float32)
            solves = sim.step(action)[2]
            state = np.array(
                [*sim.agent.position, *sim.agent.velocity, *sim.block.position, sim.block.angle]
            )
            yield _Step(action, state, solves)

    def _placed(self, pose: np.ndarray) -> np.ndarray:
        """Return the corners of a block at x, y and angle, (N, 2) px."""
        x, y, angle = pose
        cos, sin = math.cos(angle), math.sin(angle)
        placed: np.ndarray = self._corners @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
        return placed

    def _error(self, state: np.ndarray, corners: np.ndarray) -> float:
        """Return the root mean square distance of the block's corners from `corners`, px."""
        return float(np.sqrt(np.sum((self._placed(state[4:]) - corners) ** 2, axis=1).mean()))
