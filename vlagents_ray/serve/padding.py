"""Batches of fixed sizes, for models that are compiled for each: rows that stand in for missing sessions."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.wire.messages import Request

logger = logging.getLogger(__name__)

_LIFE = 1000  # acts after which a padding session begins anew, since one may keep all that it saw


@dataclass(slots=True)
class _Row:
    agent: Agent
    acts: int = 0


class Padding:
    """Sessions of nobody, which fill a batch up to the next of `sizes`.

    Each is a pristine copy of the agent, reset as the first session was that the policy took, and
    acts on what a real session of the same batch sees. Nobody gets its action or hears of its failure. Where none
    can be made, the batch goes to the policy as it is. For the policy's thread alone.
    """

    def __init__(self, sizes: Sequence[int], make: Callable[[], Agent]) -> None:
        self._sizes = sorted(sizes)
        self._make = make
        self._first: tuple[Obs, str | None, dict[str, Any]] | None = None
        self._rows: list[_Row] = []

    def remember(self, request: Request) -> None:
        """A reset that the policy took; the first one is how padding sessions begin."""
        if self._first is None and self._sizes and request.obs is not None:
            # A copy: the observation may lie in memory that its sender wants back.
            self._first = copy.deepcopy((request.obs, request.instruction, request.kwargs))

    def sessions(self, rows: int) -> list[Agent]:
        """As many as a batch of `rows` lacks to the next size; none beyond the largest."""
        missing = next((size for size in self._sizes if size >= rows), rows) - rows
        if self._first is None:  # all sessions so far came from other replicas
            return []
        try:
            while len(self._rows) < missing:
                self._rows.append(_Row(self._begin()))
        except Exception:
            logger.exception("no padding for the batches: its session could not be reset")
            self._sizes.clear()
            self._rows.clear()
            return []
        return [row.agent for row in self._rows[:missing]]

    def judge(self, results: Sequence[Act | Exception]) -> None:
        """What the sessions answered; one that failed, or is old, begins anew when it is next needed."""
        used = self._rows[: len(results)]
        for row in used:
            row.acts += 1
        kept = [row for row, result in zip(used, results, strict=True) if isinstance(result, Act) and row.acts < _LIFE]
        self._rows[: len(results)] = kept

    def _begin(self) -> Agent:
        agent = self._make()
        obs, instruction, kwargs = copy.deepcopy(self._first)  # type: ignore[misc]  # `sessions` has looked
        agent.reset(obs, instruction, **kwargs)
        return agent
