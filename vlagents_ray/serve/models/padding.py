"""Padding of batches to fixed sizes with dummy rows, for models that are compiled for each batch size."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.messages import Request

logger = logging.getLogger(__name__)

_LIFE = 1000  # acts after which a padding session is replaced, since its agent may store every observation


@dataclass(slots=True)
class _DummySession:
    agent: Agent
    acts: int = 0


def powers_up_to(most: int) -> list[int]:
    """Return 1, 2, 4, … and, as the last of them, `most`."""
    return [*(2**power for power in range((most - 1).bit_length())), most]


class Padding:
    """Dummy sessions that pad a batch to the next of `sizes`. May only be used on the policy's thread.

    Each is a pristine copy of the agent, reset with the first reset request that the policy accepted, and acts on an
    observation of a real session in the same batch. Its actions and errors are dropped. If it cannot be created, the
    policy gets batches without padding.

    Args:
        sizes: Batch sizes for which the model is compiled.
        make: Returns a pristine copy of the agent.
    """

    def __init__(self, sizes: Sequence[int], make: Callable[[], Agent]) -> None:
        self._sizes = sorted(sizes)
        self._make = make
        self._first: tuple[Obs, str | None, dict[str, Any]] | None = None
        self._rows: list[_DummySession] = []

    def record_reset(self, request: Request, kwargs: dict[str, Any]) -> None:
        """Store the first reset that the policy accepted, with which padding sessions are reset."""
        if self._first is None and self._sizes and request.obs is not None:
            # The request is copied, since the observation may lie in memory that its sender needs back.
            self._first = copy.deepcopy((request.obs, request.instruction, kwargs))

    def sessions(self, rows: int) -> list[Agent]:
        """Return the dummy sessions that pad a batch of `rows` to the next size; none beyond the largest size."""
        missing = next((size for size in self._sizes if size >= rows), rows) - rows
        if self._first is None:  # all sessions so far were moved here from other replicas
            return []
        try:
            while len(self._rows) < missing:
                self._rows.append(_DummySession(self._begin()))
        except Exception:
            logger.exception("no padding for the batches: its session could not be reset")
            self._sizes.clear()
            self._rows.clear()
            return []
        return [row.agent for row in self._rows[:missing]]

    def check_results(self, results: Sequence[Act | Exception]) -> None:
        """Check the results of the dummy sessions, and discard those that failed or have made `_LIFE` acts."""
        used = self._rows[: len(results)]
        for row in used:
            row.acts += 1
        kept = [row for row, result in zip(used, results, strict=True) if isinstance(result, Act) and row.acts < _LIFE]
        self._rows[: len(results)] = kept

    def _begin(self) -> Agent:
        agent = self._make()
        obs, instruction, kwargs = copy.deepcopy(self._first)  # type: ignore[misc]  # `sessions` has checked it
        agent.reset(obs, instruction, **kwargs)
        return agent
