"""The policy's answer to the chunk player's last request, which may come in parts."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import numpy as np

from vlagents_ray.chunking.buffer import Chunk
from vlagents_ray.interface import Act


class LastAnswer:
    """The last request of an episode, and what its answer has so far."""

    def __init__(self) -> None:
        """Begin an episode without requests."""
        self.tick = -1  # of the request
        self.seen_at = 0.0  # s, of `time.monotonic`: when its observation was captured
        self.step = 0  # the position of the answer's first row in the plan
        self.parts = 0  # how many parts of the answer have come
        self.dropped = False  # whether what still comes of the answer is not executed
        self.rest: Generator[Act, None, None] | None = None  # the parts that are to be read, if the player reads them
        self._number = -1
        self._rows: list[np.ndarray] = []
        self._info: dict[str, Any] = {}

    def ask(self, tick: int, step: int, seen_at: float) -> None:
        """Note a new request, of whose answer nothing has come yet."""
        self.tick, self.step, self.seen_at = tick, step, seen_at
        self.parts, self.dropped, self.rest = 0, False, None
        self._rows, self._info = [], {}

    def drop(self) -> None:
        """Let nothing of what still comes of the answer be executed."""
        self.dropped, self.rest = True, None

    def add(self, act: Act, rows: np.ndarray, horizon: int | None) -> Chunk:
        """Add the next part of the answer, or all of it, and return the chunk so far.

        Args:
            act: The part.
            rows: Its checked rows, (h, D) float32.
            horizon: The largest number of rows of the chunk; None: no limit.
        """
        self._number += not self.parts
        self.parts += 1
        self._rows.append(rows)
        self._info |= act.info
        joined = np.concatenate(self._rows)[:horizon]
        done = act.done and not act.more
        return Chunk(self._number, self.step, joined, done, dict(self._info), self.tick, self.seen_at, act.more)
