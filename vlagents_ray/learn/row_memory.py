"""Memory for the images of episodes, which is used again when nobody views it any more."""

from __future__ import annotations

import math
import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np

_SMALL = 2**20  # bytes of memory that `malloc` provides as fast


class RowMemory:
    """The memory of one worker's episodes.

    The kernel clears fresh memory page by page, which takes longer than copying images to it. A block of memory is free
    again once the last view of it is gone, such as the last Arrow buffer.
    """

    def __init__(self, most_free: int) -> None:
        """Begin without memory.

        Args:
            most_free: Blocks that are kept while nobody views them.
        """
        self._most_free = most_free
        self._free: list[bytearray] = []

    def rows(self, number: int, shape: Sequence[int], dtype: Any) -> np.ndarray:
        """Return an array of at least `number` rows, (N, *shape), whose values are undefined."""
        row_bytes = math.prod(shape) * np.dtype(dtype).itemsize
        if number * row_bytes < _SMALL:
            return np.empty((number, *shape), dtype)
        fitting = [block for block in self._free if len(block) >= number * row_bytes]
        if fitting:
            self._free.remove(block := max(fitting, key=len))
        else:
            block = bytearray(number * row_bytes)
        number = len(block) // row_bytes
        lent = np.frombuffer(block, np.uint8, number * row_bytes)  # all views of it refer to this array
        weakref.finalize(lent, self._take_back, block).atexit = False
        rows: np.ndarray = lent.view(dtype).reshape(number, *shape)
        return rows

    def _take_back(self, block: bytearray) -> None:
        if len(self._free) < self._most_free:
            self._free.append(block)
