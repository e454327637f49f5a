"""The largest number of rows of a forward pass that fits into the memory of an accelerator."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

# Time without an error after which more rows are tried, s. A shortage often ends within a minute,
# for example while another checkpoint is loaded.
FIRST_WAIT_S = 60.0
LONGEST_WAIT_S = 3600.0


@dataclass(slots=True)
class RowLimit:
    """A limit that falls when memory is exhausted, and rises again when some time has passed.

    A failed attempt with more rows delays one batch. The waiting time therefore doubles with each
    failure that follows a rise.
    """

    rows: int | None = None  # None if memory has not been exhausted yet
    clock: Callable[[], float] = time.monotonic
    _wait_s: float = FIRST_WAIT_S
    _changed_s: float = 0.0  # time of the last fall or rise
    _has_risen: bool = False  # whether the last change was a rise

    def lower(self, rows: int) -> None:
        """Set a smaller limit after memory was exhausted."""
        now = self.clock()
        if self._has_risen and now - self._changed_s < self._wait_s:
            self._wait_s = min(2 * self._wait_s, LONGEST_WAIT_S)
        elif self._has_risen:
            self._wait_s = FIRST_WAIT_S
        self.rows, self._changed_s, self._has_risen = rows, now, False

    def recover(self, most: int, sizes: Sequence[int] = ()) -> bool:
        """Double the limit if enough time has passed since it changed.

        Args:
            most: The largest number of rows that the settings permit.
            sizes: The only permitted numbers of rows, ascending; empty if any number is permitted.

        Returns:
            Whether the limit has changed.
        """
        rows = self.rows
        if rows is None or rows >= most or self.clock() - self._changed_s < self._wait_s:
            return False
        larger_sizes = [size for size in sizes if size > rows]
        fitting_sizes = [size for size in larger_sizes if size <= 2 * rows]
        doubled = 2 * rows
        if larger_sizes:
            doubled = fitting_sizes[-1] if fitting_sizes else larger_sizes[0]
        self.rows, self._changed_s, self._has_risen = min(doubled, most), self.clock(), True
        return True
