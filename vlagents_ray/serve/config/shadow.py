"""The settings under `shadow:` in a deployment file: a candidate beside the policy."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, field_validator


class ShadowArgs(BaseModel):
    """A candidate that acts on what the policy acts on; its actions are compared with the policy's, never executed."""

    model_config = ConfigDict(extra="forbid", hide_input_in_errors=True)  # errors are logged

    policy: str | dict[str, Any] = Field(
        description="the candidate: its deployment file, a registered name, 'module:Class', or the `args` of a "
        "deployment. It has one replica, with the file's resources and environment"
    )
    share: float = Field(default=0.1, gt=0, le=1, description="share of the sessions that the candidate follows")
    queue: int = Field(
        default=32, ge=1, description="observations that wait for the candidate at most; further ones are dropped"
    )
    record: str | None = Field(
        default=None,
        description="folder on the candidate's node, where each comparison becomes a line of JSON; a relative path is "
        "one from the working directory",
    )
    record_mb: int = Field(default=1000, ge=1, description="most MB of these files; the oldest ones are deleted")

    @field_validator("record")
    @classmethod
    def _absolute(cls, record: str | None) -> str | None:
        return None if record is None else os.path.abspath(Path(record).expanduser())
