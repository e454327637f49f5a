"""The checkpoint to write, and the written one."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

SizeName = Literal["full", "small"]


@dataclass(frozen=True, slots=True)
class Recipe:
    """A checkpoint to be written."""

    family: str
    folder: Path  # absolute; it exists
    size: SizeName
    dtype: str  # dtype of the weights


@dataclass(frozen=True, slots=True)
class WrittenCheckpoint:
    """A checkpoint that was written."""

    policy: str  # that serves it
    parameters: int
    config: dict[str, Any] = field(default_factory=dict)  # the policy's settings
