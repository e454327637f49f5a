"""What a client must know to begin an episode's session again on another replica."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlagents_ray.interface import Obs


@dataclass(slots=True)
class Episode:
    """An episode under way, as its client knows it."""

    obs: Obs  # the first
    instruction: str | None
    kwargs: dict[str, Any]
    contract: dict[str, Any] | None
    recent: deque[Obs] = field(default_factory=lambda: deque(maxlen=0))  # the last ones that were acted on
    step: int | None = 0  # acts behind it, as the server counts; None when an answer may have been lost

    def acted(self, obs: Obs, step: int | None) -> None:
        """`obs` was answered."""
        self.step = step
        if self.recent.maxlen:
            self.recent.append(copied(obs))


def copied(obs: Obs) -> Obs:
    """With arrays of its own: a caller may write its next observation into the same memory."""
    return Obs(
        {name: np.array(image) for name, image in obs.cameras.items()},
        obs.gripper,
        {name: np.array(part) for name, part in obs.state.items()},
        {key: np.array(value) if isinstance(value, np.ndarray) else value for key, value in obs.info.items()},
    )
