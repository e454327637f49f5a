"""The viewers of a deployment's episodes, under `viewers:` in a deployment file."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, field_validator

from vlagents_ray.viewers.targets import is_live, require_no_server


class ViewerArgs(BaseModel):
    """Where the episodes of all sessions are shown; unset: nowhere."""

    model_config = ConfigDict(extra="forbid", hide_input_in_errors=True)  # errors are logged

    rerun: str | None = Field(
        default=None, description="an absolute folder for `.rrd` files, or the address of a viewer of Rerun"
    )
    foxglove: str | None = Field(default=None, description="an absolute folder for `.mcap` files")

    @field_validator("foxglove")
    @classmethod
    def _no_server(cls, foxglove: str | None) -> str | None:
        return require_no_server(foxglove)

    @field_validator("rerun", "foxglove")
    @classmethod
    def _absolute(cls, target: str | None) -> str | None:
        if target is not None and not is_live("rerun", target) and not Path(target).is_absolute():
            raise ValueError(f"got {target!r}, want an absolute folder: replicas run in another one than this command")
        return target

    def targets(self) -> dict[str, str]:
        """Return the target of each viewer that has one."""
        return {name: target for name, target in self.model_dump().items() if target is not None}
