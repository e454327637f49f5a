"""The descriptions of a checkpoint to be written, and of a written checkpoint."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

SizeName = Literal["full", "small"]


@dataclass(frozen=True, slots=True)
class Recipe:
    """A checkpoint to be written."""

    family: str
    folder: Path  # absolute path of an existing folder
    size: SizeName
    dtype: str  # dtype of the weights


@dataclass(frozen=True, slots=True)
class WrittenCheckpoint:
    """A checkpoint that was written."""

    policy: str  # name of the policy that serves the checkpoint
    parameters: int
    config: dict[str, Any] = field(default_factory=dict)  # the policy's settings
