"""The protocol of a benchmark, under which results are comparable; `describe()["protocol"]` contains it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class BenchmarkProtocol:
    """The settings that published numbers of a benchmark share, and their source."""

    name: str
    source: str  # the publication or code with these settings
    max_steps: int
    control_hz: float
    control: str  # the quantity that an action commands
    success: str  # the condition under which an episode counts as solved
    begins: str  # the effect of an episode's seed and initial state
    ends_on_success: bool
    episodes: int | None = None  # episodes of a task in published tables; None if they differ

    def describe(self, **played: Any) -> dict[str, Any]:
        """Return the protocol as plain values; `deviations` lists the fields of `played` that differ from it."""
        deviations = [
            f"{name}: {value}, the protocol says {getattr(self, name)}"
            for name, value in played.items()
            if value != getattr(self, name)
        ]
        return asdict(self) | {"deviations": deviations}
