"""Models that compute the first rows of a chunk before the last ones."""

from __future__ import annotations

import abc
import copy
from collections.abc import Generator, Sequence

import numpy as np

from vlagents_ray.interface import LEFTOVER, SAMPLES, WANT, Act, Agent, Obs
from vlagents_ray.policies.base import ModelPolicy, Row
from vlagents_ray.policies.determinism import require_deterministic


class StreamingPolicy(ModelPolicy):
    """A `ModelPolicy` that may give its chunks in parts; a family also defines `act_parts` and `predict_parts`.

    A session that asks for samples or for statements about its action, or that sends the rest of its plan, gets the
    whole chunk as one part.
    """

    @abc.abstractmethod
    def predict_parts(self, rows: Sequence[Row]) -> Generator[np.ndarray, None, None]:
        """Compute one chunk for each row, and yield the next rows of all chunks, (B, h, D), as soon as they are known.

        A row's result must not depend on the others.
        """

    def initialize(self) -> None:
        """See `ModelPolicy.initialize`; with `deterministic`, the parts are checked as the whole chunks are."""
        super().initialize()
        if self.config.deterministic and self.act_parts is not None:
            require_deterministic(self._joined, self._example, self.config.rows)

    def act_batch_stream(
        self, obs: Sequence[Obs], sessions: Sequence[Agent]
    ) -> Generator[list[Act | Exception | None], None, None]:
        """Yield the next rows of each session's chunk; see `Agent.act_batch_stream`."""
        whole = [i for i, one in enumerate(obs) if self.act_parts is None or _needs_whole(one)]
        found: list[Act | Exception | None] = [None] * len(obs)
        acts = self.act_batch([obs[i] for i in whole], [sessions[i] for i in whole])
        for i, act in zip(whole, acts, strict=True):
            found[i] = act
        rows: dict[int, Row] = {}
        for i, (one, session) in enumerate(zip(obs, sessions, strict=True)):
            if i in whole:
                continue
            try:
                [rows[i]] = self._rows(one, session)  # type: ignore[arg-type]
            except Exception as error:  # noqa: BLE001 - handed to the session whose request failed
                found[i] = error
        if any(one is not None for one in found):
            yield found
        places = list(rows)
        for start in range(0, len(places), self.most_rows):
            some = places[start : start + self.most_rows]
            for actions, more in self._parts([rows[i] for i in some]):
                parts: list[Act | Exception | None] = [None] * len(obs)
                for i, action in zip(some, actions, strict=True):
                    parts[i] = Act(action, info=self.adapters.stated(rows[i].adapter), more=more)
                yield parts

    def _joined(self, rows: Sequence[Row]) -> list[np.ndarray]:
        """Return the chunks of rows, computed in parts."""
        parts = [actions for actions, _ in self._parts(list(rows))]
        return [np.concatenate(of_row) for of_row in zip(*parts, strict=True)]

    def _parts(self, rows: list[Row]) -> Generator[tuple[list[np.ndarray], bool], None, None]:
        """Yield the next rows of each chunk that are used, (h, D) float32, and whether more follow."""
        size = next((s for s in self.config.batch_sizes or () if s >= len(rows)), len(rows))
        padding = [copy.deepcopy(rows[-1]) for _ in range(size - len(rows))]
        left = self.contract.chunk  # type: ignore[union-attr]
        for computed in self.predict_parts([*rows, *padding]):
            used = np.ascontiguousarray(computed[: len(rows), :left], dtype=np.float32)
            left -= used.shape[1]
            yield list(used), left > 0
            if not left:
                return


def _needs_whole(obs: Obs) -> bool:
    return bool(obs.info.get(SAMPLES) or obs.info.get(WANT)) or obs.info.get(LEFTOVER) is not None
