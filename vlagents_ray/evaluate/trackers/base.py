"""The interface of all trackers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class About:
    """What a tracker's run is about: one policy of one folder of results, with all its checkpoints."""

    out: Path
    project: str
    group: str
    name: str  # of the policy
    id: str  # stays the same when an evaluation resumes this folder
    config: dict[str, Any]  # `evaluation`: its settings; `served`: the policy's identity; `code`: git states
    diffs: Sequence[Path]  # of the working trees from their commits


class TrackerRun(ABC):
    """One run in one tracker. Its methods may raise anything; the caller handles it."""

    @abstractmethod
    def __init__(self, about: About) -> None:
        """Begin the run, or resume it."""

    @abstractmethod
    def log(self, metrics: Mapping[str, float], step: int | None) -> None:
        """Log values at a training step; without a step they are the only values of the run."""

    @abstractmethod
    def videos(self, label: str, paths: Sequence[Path], step: int | None) -> None:
        """Upload videos of episodes of the suite and env that `label` names, as the names of its values do."""

    @abstractmethod
    def finish(self) -> None:
        """Send what is buffered, and end the run."""
