"""What one forward pass gets for each action it is asked for, and gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True)
class Row:
    """One chunk that is wanted: a session's own, or a sample of its distribution."""

    frames: tuple[Any, ...]  # what `ModelPolicy.perceive` made of the last observations, oldest first
    instruction: str
    rng: np.random.Generator  # the session's own, so that neighbours change nothing
    leftover: np.ndarray | None = None  # (H', D) float32, real-time chunking: see LEFTOVER in the interface
    delay: int = 0  # and DELAY: the chunk begins with so many rows of it
    info: Mapping[str, Any] = field(default_factory=dict)  # of the observation
    memory: dict[str, Any] = field(default_factory=dict)  # the session's, for families that keep more than frames
    sample: bool = False  # a draw of the distribution, also where the session's own answer is the likeliest one

    def noise(self, *shape: int) -> np.ndarray:
        """Standard normal draws, float32: the same on every device."""
        return self.rng.standard_normal(shape, dtype=np.float32)

    def history(self, length: int) -> tuple[Any, ...]:
        """The last `length` frames; at the beginning of an episode its first one stands for those before it."""
        return (self.frames[0],) * (length - len(self.frames)) + self.frames[-length:]


@dataclass(frozen=True, slots=True)
class Prediction:
    """A chunk, and how sure the model is of it where it can say so itself."""

    actions: np.ndarray  # (H, D) float32, in the units of the contract's action
    mean: np.ndarray | None = None  # (H, D), of the distribution that the model states
    std: np.ndarray | None = None  # (H, D)
    info: dict[str, Any] = field(default_factory=dict)  # for `Act.info`
