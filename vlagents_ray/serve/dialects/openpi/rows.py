"""Replies that have one row of a chunk, as BEHAVIOR-1K's client reads them.

The client is `WebsocketPolicy` or `MultiWebsocketPolicy` of BEHAVIOR-1K's OmniGibson/omnigibson/eval/policies.py at
020ca52, over utils/network_utils.py at c8a6cd8; docs/challenge/evaluation.md at 01f0ed2 describes its protocol.

It reads `action`, (D,). It may ask for K rows by `__action_chunk_size__`, to execute them without a further message:
they come as `action_chunk`, (K, D), whose first row equals `action`; if that is absent, it asks for single rows from
then on. The observations of B environments may be stacked, those of a single one included: `task_id` is then (B, 1),
and `action` (B, D). The client of the challenge of 2025 (omnigibson/learning) reads the same, without chunks and
stacks.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vlagents_ray.errors import MalformedMessage, shown

_NUMBER = "__action_chunk_size__"


class Rows:
    """The rows of a connection's chunks that its client has not got yet."""

    def __init__(self) -> None:
        self._left: np.ndarray | None = None  # (H, D), or (B, H, D) of stacked environments

    def replace(self, chunk: np.ndarray) -> None:
        """Let the next rows be those of a chunk, (H, D) or (B, H, D)."""
        self._left = chunk

    def has(self, number: int, *, stacked: bool) -> bool:
        """Return whether `number` rows are left, of stacked environments or of one."""
        return self._left is not None and self._left.ndim == 2 + stacked and self._left.shape[-2] >= number

    def take(self, number: int) -> dict[str, np.ndarray]:
        """Return the reply with the next `number` rows; it has a single one if fewer are left."""
        if self._left is None or not self._left.shape[-2]:
            raise IndexError("no row is left")
        number = number if number <= self._left.shape[-2] else 1
        taken, self._left = self._left[..., :number, :], self._left[..., number:, :]
        return {"action": taken[..., 0, :]} | ({"action_chunk": taken} if number > 1 else {})


def number_of_rows(message: dict[str, Any]) -> int:
    """Return how many rows the client executes before its next message."""
    number = message.get(_NUMBER, 1)
    if type(number) is not int or number < 1:
        raise MalformedMessage(f"{_NUMBER}: got {shown(number)}, want an integer, 1 or more")
    return number


def unstacked(message: dict[str, Any], most: int) -> list[dict[str, Any]] | None:
    """Return the observation of each environment, at most `most`, if they are stacked; None if they are not."""
    task = message.get("task_id")
    if not isinstance(task, np.ndarray) or task.ndim != 2:
        return None
    if not 1 <= len(task) <= most:
        raise MalformedMessage(f"task_id: got {task.shape}, want 1 to {most} environments, the limit of sessions")
    arrays = {key: value for key, value in message.items() if isinstance(value, np.ndarray)}
    for key, value in arrays.items():
        if value.shape[:1] != task.shape[:1]:
            raise MalformedMessage(f"{key[:80]}: got {value.shape}, want {len(task)} environments, as task_id has")
    return [message | {key: value[place] for key, value in arrays.items()} for place in range(len(task))]
