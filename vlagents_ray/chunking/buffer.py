"""The buffer of action chunks, which selects the next row to execute, and the capture times of
observations.

The chunk player, episodes of an evaluation (`vlagents_ray.evaluate.episode.latency`), policies that
return the rows of their chunks one by one (`vlagents_ray.policies.base.policy`), and vla-eval's
sessions all use this buffer.
"""

from __future__ import annotations

import copy
import functools
import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from vlagents_ray.columns import Columns
from vlagents_ray.contract import ActionSpec
from vlagents_ray.errors import ConfigError, InvalidObservation, PolicyFailed
from vlagents_ray.interface import (
    AGE,
    AGE_MS,
    CAPTURED,
    CHUNK,
    DELAY,
    GIVEN,
    LEFTOVER,
    PLANNED,
    ROW,
    SILENT,
    Act,
    Obs,
)

Mode = Literal["open_loop", "ensemble", "async"]
Merge = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Combines the action of the older chunks with the action of a newer chunk for the same tick.

Both actions and the result are (D,).
"""

# The names and weights of LeRobot 0.4.4, `lerobot/async_inference/configs.py`, AGGREGATE_FUNCTIONS;
# its "latest_only" is called "newest" here.
MERGES: Mapping[str, float] = {
    "newest": 1.0,
    "average": 0.5,
    "weighted_average": 0.7,
    "conservative": 0.3,
}
"""The weight of a newer chunk's action in the mean with the action of the older chunks."""
ENSEMBLE = "ensemble"
ENSEMBLE_M = 0.01
"""The m of the weights exp(-m * i), where i = 0 is the oldest chunk, as in Zhao et al. 2023 (ACT,
https://arxiv.org/abs/2304.13705) and in `temporal_agg` of their code.
"""


# The number of motions that a plan remembers, more than an answer has rows. An answer from before
# them is too late: the way of the robot since its observation is unknown. There are more only if an
# operator moves the robot while the server is silent.
_REMEMBERED = 4096
# The sum of the parts of a row of float32 numbers differs from the row by this share of it.
_ROUNDING = 1e-6


class Origin(NamedTuple):
    """The pose of the robot at an observation, as a position in the motions of a plan."""

    motions: int  # the number of motions before the observation
    executed: int  # `ChunkBuffer.executed` at the observation
    # The part of the next row, (D,), that was executed before the observation in an ease-in, which
    # divides rows; None if there is none.
    part: np.ndarray | None = None


class Chunk(NamedTuple):
    """A chunk of actions in an answer of the policy."""

    number: int  # index of the chunk in its episode, from 0
    step: int  # `ChunkBuffer.executed` at the chunk's observation: the position of the first row
    rows: np.ndarray  # (H, D) float32
    done: bool = False
    # The info of the policy's Act. Not a `MappingProxyType`: when a session moves, its chunks are
    # pickled.
    info: Mapping[str, Any] = {}
    tick: int = 0  # the tick of the observation
    seen_at: float = 0.0  # capture time of the observation, s of `time.monotonic`
    # `ChunkBuffer.origin` at the observation; None: the pose before the action of `step`.
    origin: Origin | None = None

    @property
    def end(self) -> int:
        """The step after the last row."""
        return self.step + len(self.rows)


class Step(NamedTuple):
    """The action of one step of the plan."""

    action: np.ndarray  # (D,) float32
    chunk: Chunk  # newest chunk with a row for this step
    row: int  # index of the row in that chunk
    # Whether the action contains a part of the way back to the path of a chunk.
    is_corrected: bool = False
    age: int = 0  # the number of executed actions since the observation of the chunk
    is_fresh: bool = False  # whether no action was executed while the chunk was computed

    def with_action(self, action: np.ndarray, tick: int, silent_s: float) -> Act:
        """Return `action` in place of the planned action of a tick, with the info of the planned
        action's chunk.
        """
        chunk = self.chunk
        chunk_info = {
            AGE: tick - chunk.tick,
            AGE_MS: (time.monotonic() - chunk.seen_at) * 1e3,
            CHUNK: chunk.number,
            ROW: self.row,
            PLANNED: chunk.rows,
            SILENT: silent_s,
        }
        done = chunk.done and self.row == len(chunk.rows) - 1
        return Act(action.copy(), done, {**chunk.info, **chunk_info})


@dataclass(slots=True)
class _Planned:
    """A chunk of a plan, and the way from the robot to the path of the chunk."""

    chunk: Chunk
    counted: int  # the number of motions of the plan that `way` takes into account
    # The way from the robot to the pose that the chunk's rows up to now reach from the pose of its
    # observation, (D,); None if the robot is at this pose.
    way: np.ndarray | None
    observed: int  # `ChunkBuffer.executed` at the chunk's observation
    is_fresh: bool  # whether no action was executed while the chunk was computed


class _Motion(NamedTuple):
    """A motion of the robot."""

    action: np.ndarray  # (D,) float32
    # `ChunkBuffer.executed` before it; None if it was not executed in place of a row of the plan.
    step: int | None


class ChunkBuffer:
    """The chunks of a plan, positioned by the number of actions that the robot had executed at
    their observation.

    Row r of a chunk is to be executed after r further actions since the chunk's observation. Rows
    whose step was executed with rows of earlier chunks are therefore skipped, however late the
    answer arrives. While the robot holds still, the plan waits, and no row is skipped. If ticks
    were counted instead, the rows after a stall would begin ahead of the robot's position: absolute
    targets would make the robot jump, and relative targets would omit a part of the path.
    (LeRobot's real-time chunking has the same rule since huggingface/lerobot#4454.)

    *Anchored rows*: a row of motions stands for the pose that the rows of its chunk up to it reach
    from the pose of the observation, and is executed as the way from the robot's pose to that pose.
    Otherwise, the rows of a late answer would begin where the rows of earlier chunks have led the
    robot, and no row would correct the difference. Only motions of a contract that declares what
    its actions are have an anchor; targets need none. The buffer keeps the way from the robot to
    the path of each chunk. While the robot executes all rows of a chunk unchanged, there is no way
    back to its path, and its rows are executed bit by bit.

    A corrected motion is within the limits of the contract and of the guard. If there are none, it
    is at most as large as the largest motion of the plan, since the robot's speed is only known
    from the policy. The rest of the correction is left to the next rows.
    """

    def __init__(
        self,
        merge: str | Merge = "newest",
        ensemble_m: float = ENSEMBLE_M,
        action: ActionSpec | None = None,
    ) -> None:
        """Begin a plan without chunks; raises `ConfigError` if `merge` is an unknown name.

        Args:
            merge: The method that combines the rows of several chunks for one step: a name of
                `MERGES`, "ensemble", or a function that is folded over the rows from the oldest
                chunk to the newest.
            ensemble_m: The m of the ensemble's weights exp(-m * i), oldest first.
            action: The actions of the contract, if it is known; see `describe`.
        """
        if isinstance(merge, str) and merge not in MERGES and merge != ENSEMBLE:
            raise ConfigError(
                f"merge: expected one of {sorted([*MERGES, ENSEMBLE])} or a function, got {merge!r}"
            )
        self.executed = 0  # the number of executed actions of this plan
        self._merge = MERGES.get(merge) if isinstance(merge, str) else merge  # None: the ensemble
        self._newest = merge == "newest"
        self._m = ensemble_m
        self.describe(action or ActionSpec())

    def describe(
        self,
        action: ActionSpec,
        arm: ActionSpec | None = None,
        *,
        bounds: tuple[float | np.ndarray | None, float | np.ndarray | None] = (None, None),
    ) -> None:
        """Begin a plan without chunks, of actions with another meaning.

        Args:
            action: The actions of the contract.
            arm: The actions of the arm's contract, which may declare further grippers.
            bounds: The lower and the upper bound of the guard, for all numbers or (D,) each.
        """
        self._spec, self._arm, self._guard_bounds = action, arm, bounds
        self._step: Step | None = None  # `next`, once it is computed
        self._columns: Columns | None = None  # the meaning of the columns; None before any action
        self._is_anchored = False
        self._chunks: deque[_Planned] = deque()
        self._forgotten = 0  # the number of motions before those in `_motions`
        # The motions since the oldest observation that matters.
        self._motions: list[_Motion] = []
        self._observed: int | None = None  # motions before the observation of the last request
        self._part: np.ndarray | None = None  # see `Origin.part`
        # The bounds of all numbers, and those of motions only, (D,).
        self._low = self._high = self._least = self._most = np.zeros(0, np.float32)
        self._reach = np.zeros(0, np.float32)  # the largest motions of the plan, (D,)
        # If all motions are added, 1 in the columns of motions, (D,). Such ways are computed here
        # rather than by `Columns`: an ensemble has a way for each of its chunks, at each tick.
        self._added: np.ndarray | None = None
        self._relative = np.zeros(0, np.intp)  # the columns of motions
        self._is_bounded = False  # whether a motion has a bound

    def _set_columns(self, dim: int) -> Columns:
        """Set the meaning of the columns of actions with `dim` numbers, and return it."""
        columns = self._columns
        if columns is not None and columns.dim == dim:
            return columns

        self._columns = columns = Columns.from_spec(self._spec, dim, self._arm)
        self._is_anchored = columns.is_known and bool(columns.relative)
        guard_low, guard_high = self._guard_bounds
        self._low = _strictest(np.maximum, -math.inf, dim, self._spec.low, guard_low)
        self._high = _strictest(np.minimum, math.inf, dim, self._spec.high, guard_high)
        self._reach = np.zeros(dim, np.float32)
        self._relative = np.array(columns.relative, np.intp)
        are_added = all(one.is_linear for one in columns.rotations if one.is_relative)
        self._added = None
        if are_added:
            self._added = np.zeros(dim, np.float32)
            self._added[self._relative] = 1.0

        is_bounded = np.zeros(dim, bool)
        is_bounded[list(columns.relative)] = True
        for rotation in columns.rotations:
            # Only numbers that are proportional to the motion have its bounds.
            is_bounded[list(rotation.columns)] &= rotation.is_linear
        self._least = np.where(is_bounded, self._low, np.float32(-math.inf))
        self._most = np.where(is_bounded, self._high, np.float32(math.inf))
        self._is_bounded = bool(np.isfinite([self._least, self._most]).any())
        return columns

    def add(self, chunk: Chunk) -> bool:
        """Add a chunk; return False if it has no row left to execute, or arrived too late
        (`outruns`).

        If the last row is the only row left, it may be executed one step late: an answer with a
        single action has no other row, and arrives after the previous action was executed.

        Raises:
            InvalidAction: The contract declares relative rotations, and a row has numbers that are
                no rotation.
        """
        while self._chunks and self._chunks[0].chunk.end <= self.executed:
            self._chunks.popleft()

        if self.outruns(chunk.step, chunk.info):
            return False
        origin = chunk.origin or self._before(chunk.step)
        if chunk.end == self.executed and self.next is None:
            chunk = chunk._replace(step=chunk.step + 1)
        if chunk.end <= self.executed or origin.motions < self._forgotten:
            return False

        columns = self._set_columns(chunk.rows.shape[1])
        if self._is_anchored:
            self._reach = np.maximum(self._reach, columns.reach(chunk.rows))
        is_fresh = origin.executed == self.executed
        way = origin.part
        if way is not None and self._added is not None:
            way = way * self._added
        planned = _Planned(chunk, origin.motions, way, origin.executed, is_fresh)
        self._chunks.append(planned)
        self._step = None
        self._observed = None
        self._forget(min(planned.counted for planned in self._chunks))
        return True

    def origin(self) -> Origin:
        """Return the pose of the robot now, for the chunk that answers an observation of now.

        The motions since then are remembered until this chunk is added.
        """
        self._observed = self._forgotten + len(self._motions)
        return Origin(self._observed, self.executed, self._part)

    @property
    def next(self) -> Step | None:
        """The step to execute now; None if no chunk has a row for it."""
        step = self._step
        if step is None:
            step = self._step = self._next(is_anchored=self._is_anchored)
        return step

    @property
    def uncorrected(self) -> Step | None:
        """`next` as if the robot were on the paths of all chunks."""
        return self._next(is_anchored=False)

    @property
    def after(self) -> np.ndarray | None:
        """The action after `next`, (D,); None if no chunk has a row for it."""
        ahead = self._ahead()
        ahead.advance()
        step = ahead.next
        return None if step is None else step.action

    @property
    def columns(self) -> Columns | None:
        """The meaning of the columns of actions; None before the first action or chunk."""
        return self._columns

    def steps(self) -> Iterator[Step]:
        """Yield the steps from `next` on, if each is executed as planned."""
        ahead = self._ahead()
        while (step := ahead.next) is not None:
            yield step
            ahead.advance(step.action)

    @property
    def known(self) -> int:
        """The number of actions from `next` to the end of the plan."""
        ends = (planned.chunk.end for planned in self._chunks)
        return max(ends, default=self.executed) - self.executed

    def advance(self, action: np.ndarray | None = None) -> None:
        """Count `next`, or an action that replaces it, as executed.

        Args:
            action: The action that was sent to the robot, (D,); None: `next`, or no motion if there
                is no `next`.
        """
        step = self._step
        if action is None:
            step = self.next
            action = None if step is None else step.action
        if action is not None and (self._is_anchored or self._columns is None):
            self._set_columns(len(action))
        if action is not None and self._is_anchored:
            self.settle()
            self._record(action, self.executed)

            # A row that was executed unchanged adds nothing to the way to its chunk's path.
            if self._newest and step is not None and action is step.action:
                newest = self._chunks[-1]
                if newest.chunk is step.chunk and not step.is_corrected:
                    newest.counted = self._forgotten + len(self._motions)
        self.executed += 1
        self._step = None

    def move(self, action: np.ndarray) -> None:
        """Count the motion of an action that replaces no row of the plan, such as a safe action.

        Args:
            action: The action that was sent to the robot, (D,).
        """
        self._set_columns(len(action))
        if self._is_anchored and self._moves(action):
            self.settle()
            self._record(action, None)

    def ease(self, action: np.ndarray, *, completes: bool) -> None:
        """Count an action that executes a part of `next`, which remains the whole row until it is
        complete.

        Args:
            action: The action that was sent to the robot, (D,). If it completes the row, it may
                contain a part of the row after it.
            completes: Whether it completes the row.
        """
        step = self.next
        if self._is_anchored and step is not None:
            columns = self._set_columns(len(action))
            part = action if self._part is None else columns.joined(self._part, action)
            if completes:
                self._record(step.action, self.executed)
                part = columns.remaining(part, step.action)
            self._part = part
        if completes:
            self.executed += 1
            self._step = None

    def settle(self) -> None:
        """End an ease-in: `next` is the part of its row that is left."""
        part, self._part = self._part, None
        if part is not None and self._moves(part):
            self._record(part, None)

    def take(self) -> Step:
        """Return `next` and count it as executed; raises `PolicyFailed` if no chunk has a row for
        it.
        """
        step = self.next
        if step is None:
            raise PolicyFailed(f"chunk: no row is left for step {self.executed} of the plan")
        self.advance(step.action)
        return step

    def replace(
        self,
        rows: np.ndarray,
        step: int | None = None,
        tick: int = 0,
        origin: Origin | None = None,
        *,
        done: bool = False,
    ) -> None:
        """Replace all chunks with a single chunk.

        Args:
            rows: Its rows, (H, D).
            step: The step of its first row; None: the next step.
            tick: The tick of its observation.
            origin: `origin` at its observation; None: the pose before the action of `step`.
            done: Whether the policy ends the episode with its last row.
        """
        self._chunks.clear()
        self._step = None
        first = self.executed if step is None else step
        self.add(Chunk(0, first, rows, done, tick=tick, origin=origin))

    def leftover(self) -> np.ndarray | None:
        """Return the remaining actions as the robot will execute them, (H', D); None if there are
        none.

        They are within the limits of the contract and of the guard. Otherwise, a policy that
        continues them would amplify its own numbers from request to request.
        """
        rows = [step.action for step in self.steps()]
        return np.clip(np.stack(rows), self._low, self._high) if rows else None

    def continuation(self, delay: int) -> dict[str, Any]:
        """Return the `Obs.info` of a request with real-time chunking.

        The answer is expected in `delay` ticks.
        """
        leftover = self.leftover()
        if leftover is None:
            return {}
        return {LEFTOVER: leftover, DELAY: min(delay, len(leftover))}

    def outruns(self, step: int, info: Mapping[str, Any]) -> bool:
        """Return whether more rows were executed since the observation of an answer than the policy
        received as a leftover plan (`GIVEN`).

        Args:
            step: The number of executed actions at the observation.
            info: The info of the answer.
        """
        return bool(self.executed - step > info.get(GIVEN, math.inf))

    def drop(self, before: float = math.inf) -> bool:
        """Drop chunks whose observations are older than a time, s of `time.monotonic`; return
        whether any chunk was dropped.
        """
        count = len(self._chunks)
        kept = (planned for planned in self._chunks if planned.chunk.seen_at >= before)
        self._chunks = deque(kept)
        self._step = None
        if not self._chunks:
            self.settle()
            self._reach = np.zeros_like(self._reach)
        return len(self._chunks) < count

    def keep_newest(self) -> None:
        """Drop all chunks but the newest."""
        while len(self._chunks) > 1:
            self._chunks.popleft()
        self._step = None

    def _next(self, *, is_anchored: bool) -> Step | None:
        """Return the step to execute now, with or without the ways to the paths of the chunks."""
        index = self.executed
        for newest in reversed(self._chunks):
            if newest.chunk.step <= index < newest.chunk.end:
                break
        else:
            return None

        planned = [newest]
        if not self._newest:
            planned = [one for one in self._chunks if one.chunk.step <= index < one.chunk.end]
        rows = [one.chunk.rows[index - one.chunk.step] for one in planned]
        newest_row = rows[-1]
        has_way = False
        if is_anchored:
            for number, one in enumerate(planned):
                self._update(one)
                if one.way is not None:
                    rows[number] = self._joined(one.way, self._possible(rows[number]))
                    has_way = True

        action = self._merged(rows)
        if has_way:
            action = self._limited(action, newest_row)
        row = index - newest.chunk.step
        age = index - newest.observed
        return Step(action, newest.chunk, row, has_way, age, newest.is_fresh)

    def _merged(self, rows: Sequence[np.ndarray]) -> np.ndarray:
        """Return the action of the rows of several chunks for a step, oldest first, (D,)."""
        if len(rows) == 1:
            return rows[0]
        if callable(self._merge):
            return np.asarray(functools.reduce(self._merge, rows), np.float32)
        columns = self._set_columns(len(rows[0]))
        if self._merge is None:
            weights = np.exp(-self._m * np.arange(len(rows)))
            return columns.mean(rows, weights)
        mean = rows[0]
        for row in rows[1:]:
            mean = columns.mean([mean, row], [1.0 - self._merge, self._merge])
        return mean

    def _limited(self, action: np.ndarray, row: np.ndarray) -> np.ndarray:
        """Return a corrected action within the limits of motions, (D,).

        Args:
            action: The action, (D,).
            row: The row of the newest chunk, (D,). Its numbers beyond the bounds of the guard are
                not corrected, so that the guard rejects them.
        """
        columns = self._set_columns(len(row))
        low = np.where(np.isfinite(self._least), self._least, -self._reach)
        high = np.where(np.isfinite(self._most), self._most, self._reach)
        limited = columns.limited(action, low, high)
        if any(bound is not None for bound in self._guard_bounds):
            is_beyond = (row < self._least) | (row > self._most)
            limited[is_beyond] = row[is_beyond]
        return limited

    def _update(self, planned: _Planned) -> None:
        """Count the motions since the last update in the way to the path of a chunk."""
        chunk = planned.chunk
        for motion in self._motions[planned.counted - self._forgotten :]:
            executed = self._possible(motion.action)
            goal = planned.way  # the pose that the chunk reaches, from the robot before the motion
            if motion.step is not None and chunk.step <= motion.step < chunk.end:
                row = self._possible(chunk.rows[motion.step - chunk.step])
                goal = row if goal is None else self._joined(goal, row)
            elif goal is None:
                goal = self._set_columns(len(executed)).still(executed)

            is_there = (goal == executed)[self._relative].all()
            planned.way = None if is_there else self._remaining(goal, executed)
        planned.counted = self._forgotten + len(self._motions)

    def _joined(self, way: np.ndarray, row: np.ndarray) -> np.ndarray:
        """Return `Columns.joined`."""
        if self._added is None:
            return self._set_columns(len(row)).joined(way, row)
        joined: np.ndarray = row + way
        return joined

    def _remaining(self, goal: np.ndarray, executed: np.ndarray) -> np.ndarray:
        """Return `Columns.remaining`, without targets if motions are added."""
        if self._added is None:
            return self._set_columns(len(goal)).remaining(goal, executed)
        remaining: np.ndarray = (goal - executed) * self._added
        return remaining

    def _possible(self, row: np.ndarray) -> np.ndarray:
        """Return the motions of a row that the contract allows, which a robot does not exceed."""
        if not self._is_bounded:
            return row
        possible: np.ndarray = np.minimum(np.maximum(row, self._least), self._most)
        return possible

    def _moves(self, action: np.ndarray) -> bool:
        """Return whether an action is a motion, up to rounding."""
        columns = self._set_columns(len(action))
        return bool((columns.reach(action[np.newaxis]) > _ROUNDING * self._reach).any())

    def _record(self, action: np.ndarray, step: int | None) -> None:
        """Remember a motion; see `_Motion`."""
        self._motions.append(_Motion(action, step))
        self._step = None
        if len(self._motions) > _REMEMBERED:
            for planned in self._chunks:
                self._update(planned)
            self._observed = None
            self._forget(self._forgotten + _REMEMBERED // 2)

    def _forget(self, count: int) -> None:
        """Forget the first `count` motions, except those since the last request."""
        count = count if self._observed is None else min(count, self._observed)
        del self._motions[: count - self._forgotten]
        self._forgotten = count

    def _before(self, step: int) -> Origin:
        """Return the pose of the robot before the action of a step."""
        for number, motion in enumerate(self._motions, self._forgotten):
            if motion.step is not None and motion.step >= step:
                return Origin(number, step)
        return Origin(self._forgotten + len(self._motions), step)

    def _ahead(self) -> ChunkBuffer:
        """Return a copy of the plan, which may be executed while this one stays as it is."""
        ahead = copy.copy(self)
        ahead._chunks = deque(replace(planned) for planned in self._chunks)
        ahead._motions = list(self._motions)
        ahead._part = None  # the rows of an ease-in remain whole
        return ahead


def _strictest(
    stricter: np.ufunc, none: float, dim: int, *bounds: float | np.ndarray | None
) -> np.ndarray:
    """Return the strictest of bounds for each number, (dim,) float32; `none` without bounds."""
    strictest = np.full(dim, none, np.float32)
    for bound in bounds:
        if bound is not None and np.shape(bound) in ((), (dim,)):  # the guard rejects other shapes
            strictest = stricter(strictest, np.asarray(bound, np.float32))
    return strictest


# The number of answers that may include a cold start: the first answers that continue a plan may
# need forward passes and batch sizes that are not compiled yet.
_COLD_ANSWERS = 2
# The number of answers in the estimate. At 10 ms to 1 s for each answer, the estimate adapts to a
# slower network within seconds.
_RECENT_ANSWERS = 10
# The quantile of the estimate is above the median: an estimate that is too short makes the robot
# jump, while one that is too long only makes it react later.
_QUANTILE = 0.9


class DelayEstimate:
    """Estimates the delay of the next answer, in ticks, from the delays of recent answers.

    The estimate is their 0.9 quantile, rounded down to a measured delay, so that a single slow
    answer has no effect. The first two answers may include a cold start of several seconds. They
    are excluded as soon as there is a third answer.
    """

    def __init__(self) -> None:
        self._answers = 0
        self._recent: deque[int] = deque(maxlen=_RECENT_ANSWERS)

    def add(self, ticks: int) -> None:
        """Add the delay of an answer: the ticks from its observation to its arrival."""
        if self._answers == _COLD_ANSWERS:
            self._recent.clear()
        self._answers += 1
        self._recent.append(ticks)

    @property
    def ticks(self) -> int:
        """The expected delay in ticks; 0 before the first answer."""
        if not self._recent:
            return 0
        return sorted(self._recent)[int(_QUANTILE * (len(self._recent) - 1))]


SKEW_S = 0.1  # largest accepted lead of a sensor computer's clock over this machine's clock, s


class CaptureClock:
    """Computes the capture time of an observation, in s of `time.monotonic`.

    `captured_at` is a time of `time.time`, since it is sent to other machines. This clock may be
    set at any moment, so it is read only once, when a new `captured_at` first appears. After that,
    the age is measured with `time.monotonic`. If the same observation is passed again, for instance
    because a camera hangs, its age increases regardless of the clock. A jump of the clock affects
    only the observation during which it happens. After a jump forward, the observation is too old.
    After a jump backward by more than `SKEW_S`, the observation is in the future, and also counts
    as too old, since its age is unknown.
    """

    def __init__(self) -> None:
        self._stamp: float | None = None
        self._at = 0.0

    def __call__(self, obs: Obs) -> float:
        """Return the capture time, s of `time.monotonic`.

        It is the current time if the observation has no `captured_at`, and `-math.inf` if the
        `captured_at` is impossible.
        """
        now = time.monotonic()
        stamp = obs.info.get(CAPTURED)
        if stamp is None:
            return now
        if not isinstance(stamp, (int, float)) or not math.isfinite(stamp):
            raise InvalidObservation(
                f"info[{CAPTURED!r}]: expected seconds since 1970, as from time.time(), got "
                f"{stamp!r}"
            )
        if stamp != self._stamp:
            age_s = time.time() - stamp
            self._stamp = stamp
            self._at = now - max(age_s, 0.0) if age_s >= -SKEW_S else -math.inf
        return self._at


def stamped(obs: Obs, extras: Mapping[str, Any]) -> Obs:
    """Return a copy of the observation with its capture time and the `extras` of the request."""
    return replace(obs, info={CAPTURED: time.time(), **obs.info, **extras})
