"""The settings of the live page, under `live:` of a deployment."""

from __future__ import annotations

import os

from pydantic import BaseModel, ConfigDict, Field, field_validator


class LiveArgs(BaseModel):
    """The last seconds of each session, which a press on the live page saves; see `vlagents_ray.serve.live.ring`."""

    model_config = ConfigDict(extra="forbid", hide_input_in_errors=True)

    folder: str = Field(
        description="folder of the datasets, on each replica's own node or shared; each replica writes its own below it"
    )
    ring_s: float = Field(default=30.0, gt=0, le=600, description="how much of each session is held, s")
    memory_mb: float = Field(
        default=256.0, gt=0, description="memory that all sessions of a replica take at most, MB; the oldest goes first"
    )

    most_gb: float = Field(default=50.0, gt=0, description="size of the folder at which nothing more is saved, GB")

    @field_validator("folder")
    @classmethod
    def _absolute(cls, folder: str) -> str:
        return os.path.abspath(os.path.expanduser(folder))
