"""Success rates with their uncertainty."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from vlagents_ray.errors import InvalidInput

Z_95 = 1.959963984540054  # two-sided 95 % quantile of the standard normal distribution


def wilson(successes: int, trials: int, z: float = Z_95) -> tuple[float, float]:
    """Wilson score interval of a success probability; (0, 1) when there are no trials.

    E. B. Wilson, "Probable Inference, the Law of Succession, and Statistical Inference", JASA 22
    (1927). Unlike the textbook interval it stays inside [0, 1] and is honest for few episodes and
    for rates of 0 % and 100 %.
    """
    if not 0 <= successes <= trials:
        raise InvalidInput(f"wilson: got {successes} successes in {trials} trials, want 0 <= successes <= trials")
    if trials == 0:
        return 0.0, 1.0
    rate = successes / trials
    scale = 1 + z * z / trials
    centre = (rate + z * z / (2 * trials)) / scale
    half = z / scale * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    # The bounds are exactly 0 and 1 there; floating point would leave 1e-17.
    low = 0.0 if successes == 0 else centre - half
    high = 1.0 if successes == trials else centre + half
    return low, high


@dataclass(frozen=True, slots=True)
class Rate:
    """Successes among episodes, with an interval of the true rate."""

    successes: int
    episodes: int
    # Where episodes could stop early, bounds that hold nevertheless, and the chance that they ever miss the rate.
    bounds: tuple[float, float] | None = None
    error_rate: float | None = None

    @property
    def rate(self) -> float | None:
        """In [0, 1]; None without episodes."""
        return self.successes / self.episodes if self.episodes else None

    @property
    def interval(self) -> tuple[float, float]:
        """(low, high): the Wilson 95 % interval, unless there are other `bounds`."""
        return wilson(self.successes, self.episodes) if self.bounds is None else self.bounds

    def to_json(self) -> dict[str, Any]:
        """`successes`, `episodes`, `rate` and `wilson_95`, or in its place `confidence_sequence` and `error_rate`."""
        counts = {"successes": self.successes, "episodes": self.episodes, "rate": self.rate}
        if self.bounds is None:
            return counts | {"wilson_95": list(self.interval)}
        return counts | {"confidence_sequence": list(self.bounds), "error_rate": self.error_rate}

    def __str__(self) -> str:
        if self.rate is None:
            return "-"
        low, high = self.interval
        return f"{self.rate:.0%} [{100 * low:.0f}, {100 * high:.0f}]"
