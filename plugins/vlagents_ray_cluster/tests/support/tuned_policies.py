"""Policies with settings that `vlagents-ray tune` tries, some of which fail."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import BaseModel

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Act, Agent, Obs


class TunableConfig(BaseModel, extra="forbid"):
    """The time of a batch, the deviation of types with fewer bits, and the number of rows beyond
    which a batch fails.
    """

    compile: bool = False
    dtype: Literal["auto", "float32", "bfloat16", "float16"] = "auto"
    quantization: Literal["int8", "float8"] | None = None
    batch_sizes: list[int] | None = None
    eager_ms: float = 60.0  # time of a batch that is not compiled, ms
    row_ms: float = 0.0  # additional time for each row of such a batch, ms
    off: float = 0.0  # deviation of all numbers in bfloat16 or if quantized
    most_rows: int | None = None  # larger batches raise MemoryError
    compiles: bool = True


class Tunable(Agent):
    """Computes actions from state, image and seed. A compiled batch takes no time; with float16,
    the process ends while it loads.
    """

    Config: ClassVar[type] = TunableConfig
    shared: ClassVar[tuple[str, ...]] = ("config",)
    contract = Contract(
        cameras={"front": CameraSpec(16, 16)},
        state={"joints": StateSpec(2)},
        action=ActionSpec(dim=2),
        chunk=3,
    )

    def __init__(self, config: TunableConfig) -> None:
        self.config = config

    def initialize(self) -> None:
        if self.config.dtype == "float16":
            os._exit(7)
        if self.config.compile and not self.config.compiles:
            raise ConfigError("compile: this one has no compiler")

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.seed = kwargs["seed"]
        return {}

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        if self.config.most_rows is not None and len(obs) > self.config.most_rows:
            raise MemoryError(f"{len(obs)} rows")
        time.sleep(
            0
            if self.config.compile
            else (self.config.eager_ms + self.config.row_ms * len(obs)) / 1000
        )
        off = (
            self.config.off if self.config.dtype == "bfloat16" or self.config.quantization else 0.0
        )
        return [
            Act(
                np.tile(
                    one.state["joints"] + session.seed + one.cameras["front"].mean() + off, (3, 1)
                )
            )  # type: ignore[attr-defined]
            for one, session in zip(obs, sessions, strict=True)
        ]


class Unseeded(Tunable):
    """Returns random actions, which do not depend on the seed."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.seed = int.from_bytes(os.urandom(2), "big")
        return {}


class Plain(Agent):
    """A policy without settings."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {}

    def act(self, obs: Obs) -> Act:
        return Act(np.zeros(3, np.float32))
