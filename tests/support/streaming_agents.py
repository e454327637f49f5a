"""Policies that give their chunks in parts, when a test lets them."""

from __future__ import annotations

import threading
from collections.abc import Generator
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from vlagents_ray import Act, ActionSpec, Agent, Contract, Obs
from vlagents_ray.interface import Parts

ROWS = 4


@dataclass
class Record:
    """What all sessions of a policy did."""

    computed: list[int] = field(default_factory=list)  # the row of each part that was computed
    closed: list[int] = field(default_factory=list)  # how many parts each stream gave


class InParts(Agent):
    """Row r of an observation with the value v is [v, r]; a part is a row. With a gate, each part takes a permit.

    `info["fail_at"]` names the row at which it fails, `info["broken_at"]` a row that is NaN, and `info["ends_at"]` one
    before which it stops without a word; with `info["done"]` the last part says `done`.
    """

    shared: ClassVar[tuple[str, ...]] = ("gate", "record")
    act_parts: Parts | None = "exact"
    continues_plans = True
    contract = Contract(action=ActionSpec(dim=2), chunk=ROWS)

    def __init__(self, *, gated: bool = False) -> None:
        self.gate = threading.Semaphore(0) if gated else None
        self.record = Record()

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.acts = 0
        return {}

    def act(self, obs: Obs) -> Act:
        parts = list(self.act_stream(obs))
        return Act(np.concatenate([part.rows() for part in parts]), parts[-1].done, parts[-1].info)

    def act_stream(self, obs: Obs) -> Generator[Act, None, None]:
        given = 0
        try:
            for row in range(ROWS):
                if self.gate is not None and not self.gate.acquire(timeout=60):
                    raise TimeoutError("the test let no further part pass")
                if row == obs.info.get("fail_at"):
                    raise RuntimeError("secret /path/of/the/server")
                if row == obs.info.get("ends_at"):
                    return
                self.record.computed.append(row)
                number = np.nan if row == obs.info.get("broken_at") else row
                last = row == ROWS - 1
                self.acts += last
                rows = np.array([[obs.info.get("value", 0.0), number]], np.float32)
                yield Act(rows, done=last and bool(obs.info.get("done")), info={"acts": self.acts}, more=not last)
                given += 1
        finally:
            self.record.closed.append(given)


class InPartsAtOnce(InParts):
    """Computes the parts of a whole batch at once, like a model; the sessions of a batch of n end one after another."""

    def act_batch_stream(self, obs: Any, sessions: Any) -> Generator[list[Act | Exception | None], None, None]:
        streams = [InParts.act_stream(session, one) for session, one in zip(sessions, obs, strict=True)]
        for step in range(ROWS + len(obs)):
            parts: list[Act | Exception | None] = []
            for i, stream in enumerate(streams):
                try:
                    parts.append(next(stream) if i <= step < i + ROWS else None)
                except Exception as error:  # noqa: BLE001 - of that session alone
                    parts.append(error)
            yield parts
