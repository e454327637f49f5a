"""The buffer of action chunks, which selects the next row to execute, and the capture times of
observations.

The chunk player, episodes of an evaluation (`vlagents_ray.evaluate.episode.latency`), policies that
return the rows of their chunks one by one (`vlagents_ray.policies.base.policy`), and vla-eval's
sessions all use this buffer.
"""

from __future__ import annotations

import functools
import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
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

    @property
    def end(self) -> int:
        """The step after the last row."""
        return self.step + len(self.rows)


class Step(NamedTuple):
    """The action of one step of the plan."""

    action: np.ndarray  # (D,) float32
    chunk: Chunk  # newest chunk with a row for this step
    row: int  # index of the row in that chunk

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


class ChunkBuffer:
    """The chunks of a plan, positioned by the number of actions that the robot had executed at
    their observation.

    Row r of a chunk is to be executed after r further actions since the chunk's observation. Rows
    whose step was executed with rows of earlier chunks are therefore skipped, however late the
    answer arrives. While the robot holds still, the plan waits, and no row is skipped. If ticks
    were counted instead, the rows after a stall would begin ahead of the robot's position: absolute
    targets would make the robot jump, and relative targets would omit a part of the path.
    (LeRobot's real-time chunking has the same rule since huggingface/lerobot#4454.)
    """

    action: ActionSpec
    """The actions of the contract; the mean of rows depends on their columns."""

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
            action: The actions of the contract, if it is known.
        """
        if isinstance(merge, str) and merge not in MERGES and merge != ENSEMBLE:
            raise ConfigError(
                f"merge: expected one of {sorted([*MERGES, ENSEMBLE])} or a function, got {merge!r}"
            )
        self.executed = 0  # the number of executed actions of this plan
        self.action = action or ActionSpec()
        self._merge = MERGES.get(merge) if isinstance(merge, str) else merge  # None: the ensemble
        self._newest = merge == "newest"
        self._m = ensemble_m
        self._chunks: deque[Chunk] = deque()

    def add(self, chunk: Chunk) -> bool:
        """Add a chunk; return False if it has no row left to execute, or arrived too late
        (`outruns`).

        If the last row is the only row left, it may be executed one step late: an answer with a
        single action has no other row, and arrives after the previous action was executed.
        """
        while self._chunks and self._chunks[0].end <= self.executed:
            self._chunks.popleft()

        if self.outruns(chunk.step, chunk.info):
            return False
        if chunk.end == self.executed and self.next is None:
            chunk = chunk._replace(step=chunk.step + 1)
        if chunk.end <= self.executed:
            return False
        self._chunks.append(chunk)
        return True

    @property
    def next(self) -> Step | None:
        """The step to execute now; None if no chunk has a row for it."""
        return self._at(self.executed)

    @property
    def after(self) -> np.ndarray | None:
        """The action after `next`, (D,); None if no chunk has a row for it."""
        step = self._at(self.executed + 1)
        return None if step is None else step.action

    @property
    def known(self) -> int:
        """The number of actions from `next` to the end of the plan."""
        return max((chunk.end for chunk in self._chunks), default=self.executed) - self.executed

    def advance(self) -> None:
        """Count `next`, or an action that replaces it, as executed."""
        self.executed += 1

    def take(self) -> Step:
        """Return `next` and count it as executed; raises `PolicyFailed` if no chunk has a row for
        it.
        """
        step = self.next
        if step is None:
            raise PolicyFailed(f"chunk: no row is left for step {self.executed} of the plan")
        self.advance()
        return step

    def replace(self, rows: np.ndarray, step: int | None = None, tick: int = 0) -> None:
        """Replace all chunks with a single chunk.

        Args:
            rows: Its rows, (H, D).
            step: The step of its first row; None: the next step.
            tick: The tick of its observation.
        """
        self._chunks.clear()
        self.add(Chunk(0, self.executed if step is None else step, rows, tick=tick))

    def leftover(self) -> np.ndarray | None:
        """Return the remaining actions, (H', D); None if there are none."""
        rows: list[np.ndarray] = []
        step = self._at(self.executed)
        while step is not None:
            rows.append(step.action)
            step = self._at(self.executed + len(rows))
        return np.stack(rows) if rows else None

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
        self._chunks = deque(chunk for chunk in self._chunks if chunk.seen_at >= before)
        return len(self._chunks) < count

    def _at(self, index: int) -> Step | None:
        """Return the step with this index in the plan; None if no chunk has a row for it."""
        for newest in reversed(self._chunks):
            if newest.step <= index < newest.end:
                break
        else:
            return None

        row = index - newest.step
        if self._newest:
            return Step(newest.rows[row], newest, row)

        chunks = (chunk for chunk in self._chunks if chunk.step <= index < chunk.end)
        rows = [chunk.rows[index - chunk.step] for chunk in chunks]
        if len(rows) == 1:
            action = rows[0]
        elif callable(self._merge):
            action = np.asarray(functools.reduce(self._merge, rows), np.float32)
        else:
            action = self._mean(rows, self._merge)
        return Step(action, newest, row)

    def _mean(self, rows: Sequence[np.ndarray], newer: float | None) -> np.ndarray:
        """Return the mean of the rows of several chunks for a step, oldest first, (D,) float32.

        Args:
            rows: The rows, (D,) each.
            newer: The weight of each newer row in the mean with the older ones; None for the
                weights of the ensemble.
        """
        columns = Columns.from_spec(self.action, len(rows[0]))
        if newer is None:
            weights = np.exp(-self._m * np.arange(len(rows)))
            return columns.mean(rows, weights)
        mean = rows[0]
        for row in rows[1:]:
            mean = columns.mean([mean, row], [1.0 - newer, newer])
        return mean


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
