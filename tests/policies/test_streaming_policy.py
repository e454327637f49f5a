"""What model families with parts inherit, shown on a model of two lines."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import Any

import numpy as np
import pytest

from vlagents_ray import Contract, Obs
from vlagents_ray.contract import ActionSpec
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Parts
from vlagents_ray.policies.base import ModelConfig, Prediction, Row
from vlagents_ray.policies.streaming import StreamingPolicy
from vlagents_ray.testing import check_agent

HORIZON, DIM = 4, 2


class Halves(StreamingPolicy):
    """Gives the two halves of a chunk of the session's noise."""

    Config = ModelConfig
    act_parts: Parts | None = "exact"
    contract = Contract(action=ActionSpec(dim=DIM), chunk=HORIZON)

    def load(self) -> Any:
        return {}

    def perceive(self, obs: Obs) -> Any:
        return None

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        return [Prediction(row.noise(HORIZON, DIM)) for row in rows]

    def predict_parts(self, rows: Sequence[Row]) -> Generator[np.ndarray, None, None]:
        chunks = np.stack([row.noise(HORIZON, DIM) for row in rows])
        yield chunks[:, : HORIZON // 2]
        yield chunks[:, HORIZON // 2 :]


class LooksBackLater(Halves):
    """The second half changes with the place of a row."""

    def predict_parts(self, rows: Sequence[Row]) -> Generator[np.ndarray, None, None]:
        first, second = super().predict_parts(rows)
        yield first
        yield second + np.arange(len(rows), dtype=np.float32)[:, None, None]


def test_it_keeps_what_an_agent_promises() -> None:
    check_agent(Halves.from_config({"checkpoint": "none"}), steps=2)


def test_parts_are_deterministic_too() -> None:
    """The whole chunks of each are."""
    settings = {"checkpoint": "none", "deterministic": True, "batch_sizes": [4]}
    Halves.from_config(settings).initialize()
    with pytest.raises(ConfigError, match=r"deterministic: a row's actions change by up to .* in a batch of 4"):
        LooksBackLater.from_config(settings).initialize()
    LooksBackLater.from_config({**settings, "batch_sizes": [1]}).initialize()
    without = LooksBackLater.from_config(settings)
    without.act_parts = None
    without.initialize()
