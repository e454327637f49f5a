"""What stands under `args.dialects` in a deployment file. A dialect that is not named is off."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from vlagents_ray.serve.gateways.config import GatewayDialects
from vlagents_ray.wire.mapping import KeyMapping
from vlagents_ray.wire.messages import RankName
from vlagents_ray.wire.presets import read_mapping

_MAPPING = "how its observations become ours: a preset's name, or an object, see vlagents_ray.wire.mapping"


class Dialect(BaseModel):
    """What all have."""

    model_config = ConfigDict(extra="forbid")

    mapping: str | dict[str, Any] = Field(description=_MAPPING)
    rank: RankName = Field(default="robot", description="whose requests go first: robot or simulation")

    @field_validator("mapping")
    @classmethod
    def _readable(cls, value: str | dict[str, Any]) -> str | dict[str, Any]:
        read_mapping(value)
        return value

    def keys(self) -> KeyMapping:
        """The mapping."""
        return read_mapping(self.mapping)


class OpenPi(Dialect):
    """`openpi-client`, over WebSocket."""

    metadata: dict[str, Any] = Field(
        default_factory=dict, description="added to what the client is told first, such as reset_pose"
    )


class RoboArena(Dialect):
    """RoboArena's client, openpi's with a reset; the fields are those of its PolicyServerConfig."""

    mapping: str | dict[str, Any] = Field(default="roboarena", description=_MAPPING)
    image_resolution: tuple[int, int] | None = Field(default=(224, 224), description="height, width; null: any")
    needs_wrist_camera: bool = True
    n_external_cameras: int = Field(default=1, ge=0, le=2)
    needs_stereo_camera: bool = False
    needs_session_id: bool = False
    action_space: Literal["joint_position", "joint_velocity", "cartesian_position", "cartesian_velocity"] = (
        "joint_position"
    )
    bare: bool = Field(default=False, description="answer the array itself, as older clients want it")

    def first(self) -> dict[str, Any]:
        """The PolicyServerConfig."""
        return self.model_dump(mode="json", exclude={"mapping", "rank", "bare"})


class OpenVLA(Dialect):
    """OpenVLA's REST clients, and those of its forks that post whole observations."""

    mapping: str | dict[str, Any] = Field(default="openvla", description=_MAPPING)
    chunk: bool = Field(default=False, description="answer all rows, as OFT's clients want it, not the first alone")


class VlaEval(Dialect):
    """vla-eval's benchmarks."""

    mapping: str | dict[str, Any] = Field(default="vla-eval", description=_MAPPING)
    rank: RankName = "simulation"
    execute: int | None = Field(default=None, ge=1, description="rows of each chunk that are executed; null: all")
    observation_params: dict[str, Any] = Field(
        default_factory=dict, description="what benchmarks are asked for, such as send_state: true"
    )


class DialectArgs(GatewayDialects):
    """Which are on: these on the server's own port, and those that have one of their own."""

    openpi: OpenPi | None = None
    roboarena: RoboArena | None = None
    openvla: OpenVLA | None = None
    vla_eval: VlaEval | None = None

    def on(self) -> Iterator[tuple[str, Dialect]]:
        """Those on the server's own port, by name."""
        for name in type(self).model_fields:
            if isinstance(dialect := getattr(self, name), Dialect):
                yield name, dialect
