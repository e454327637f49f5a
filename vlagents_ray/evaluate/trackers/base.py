"""What all trackers are told, and in which words."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class About:
    """A tracker's run: one policy of one folder of results, whichever of its checkpoints."""

    out: Path
    project: str
    group: str
    name: str  # of the policy
    id: str  # the same whenever this folder is resumed
    config: dict[str, Any]  # of the evaluation, and the code by what it is of
    diffs: Sequence[Path]  # what differed from the commits


class TrackerRun(ABC):
    """One run in one tracker. What its methods raise is the caller's to bear."""

    @abstractmethod
    def __init__(self, about: About) -> None:
        """Begin the run, or go on with it."""

    @abstractmethod
    def log(self, metrics: Mapping[str, float], step: int | None) -> None:
        """Values at a training step; without one, as the run's only ones."""

    @abstractmethod
    def videos(self, label: str, paths: Sequence[Path], step: int | None) -> None:
        """Videos of episodes behind the values that begin with `label`."""

    @abstractmethod
    def finish(self) -> None:
        """Write what is left."""
