"""How a benchmark is played, so that its numbers can be compared: what `describe()["protocol"]` holds."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Protocol:
    """The settings that published numbers of a benchmark share, and who says so."""

    name: str
    source: str  # where these settings are written down
    max_steps: int
    control_hz: float
    control: str  # what an action commands
    success: str  # when an episode counts as solved
    begins: str  # what an episode's seed and initial state decide
    ends_on_success: bool
    episodes: int | None = None  # of a task, in published tables; None where they differ

    def describe(self, **played: Any) -> dict[str, Any]:
        """The protocol as plain values, and in `deviations` what of `played`, by the fields' names, differs from it."""
        deviations = [
            f"{name}: {value}, the protocol says {getattr(self, name)}"
            for name, value in played.items()
            if value != getattr(self, name)
        ]
        return asdict(self) | {"deviations": deviations}
