"""What is to be done at which tick, out of chunks that overlap."""

from __future__ import annotations

import functools
import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError

Merge = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(D,) of the older chunks and (D,) of a newer one -> (D,), for one tick."""

# By the names and weights of LeRobot 0.4.4, `lerobot/async_inference/configs.py`, AGGREGATE_FUNCTIONS;
# its "latest_only" is our "newest".
MERGES: Mapping[str, Merge] = {
    "newest": lambda _, new: new,
    "average": lambda old, new: 0.5 * old + 0.5 * new,
    "weighted_average": lambda old, new: 0.3 * old + 0.7 * new,
    "conservative": lambda old, new: 0.7 * old + 0.3 * new,
}
ENSEMBLE = "ensemble"
ENSEMBLE_M = 0.01
"""Of the weights exp(-m * i), i = 0 for the oldest: Zhao et al. 2023 (ACT, https://arxiv.org/abs/2304.13705), and
`temporal_agg` in their code."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """An answer of the policy."""

    number: int  # 0 for an episode's first
    tick: int  # of the observation that it answers, and of its first row
    rows: np.ndarray  # (H, D) float32
    done: bool
    info: dict[str, Any]  # of the policy's Act
    asked_at: float = 0.0  # s, of `time.monotonic`

    @property
    def end(self) -> int:
        """The tick after its last row."""
        return self.tick + len(self.rows)


@dataclass(frozen=True, slots=True)
class Step:
    """What is to be done at one tick."""

    action: np.ndarray  # (D,) float32
    chunk: Chunk  # the newest that it was made from
    row: int  # of that chunk


class Plan:
    """Chunks by the tick of their observation: row r of a chunk is for r ticks later, whenever it arrived.

    So the rows of an answer that came late are dropped by themselves, as their ticks are over.
    """

    def __init__(self, merge: str | Merge = "newest", ensemble_m: float = ENSEMBLE_M) -> None:
        """`merge` says what becomes of a tick for which several chunks have a row: a name of `MERGES`,
        "ensemble", or a function that is folded over them from the oldest to the newest."""
        if isinstance(merge, str) and merge not in MERGES and merge != ENSEMBLE:
            raise ConfigError(f"merge: got {merge!r}, want one of {sorted([*MERGES, ENSEMBLE])} or a function")
        self._merge = MERGES.get(merge) if isinstance(merge, str) else merge  # None: the ensemble
        self._newest = merge == "newest"
        self._m = ensemble_m
        self._chunks: deque[Chunk] = deque()

    @property
    def newest(self) -> Chunk | None:
        """The chunk of the latest observation."""
        return self._chunks[-1] if self._chunks else None

    def add(self, chunk: Chunk, now: int) -> int:
        """Take an answer in at tick `now`; returns how many of its rows were late, and are dropped."""
        while self._chunks and self._chunks[0].end <= now:
            self._chunks.popleft()
        if chunk.end > now:
            self._chunks.append(chunk)
        return min(len(chunk.rows), now - chunk.tick)

    def at(self, tick: int, since: float = -math.inf) -> Step | None:
        """What is to be done at `tick`; None if no chunk that was asked for at `since` or later reaches that far."""
        covering = [c for c in self._chunks if c.tick <= tick < c.end and c.asked_at >= since]
        if not covering:
            return None
        newest = covering[-1]
        row = tick - newest.tick
        if self._newest or len(covering) == 1:
            return Step(newest.rows[row], newest, row)
        rows = [chunk.rows[tick - chunk.tick] for chunk in covering]
        if self._merge is None:
            weights = np.array([math.exp(-self._m * i) for i in range(len(rows))])
            action = (weights / weights.sum()) @ np.stack(rows)
        else:
            action = functools.reduce(self._merge, rows)
        return Step(np.asarray(action, np.float32), newest, row)

    def leftover(self, tick: int) -> np.ndarray | None:
        """What is to be done from `tick` on, (H', D); None if there is nothing."""
        rows: list[np.ndarray] = []
        while (step := self.at(tick + len(rows))) is not None:
            rows.append(step.action)
        return np.stack(rows) if rows else None

    def clear(self) -> None:
        """Forget everything."""
        self._chunks.clear()
