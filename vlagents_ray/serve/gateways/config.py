"""The settings of the doors with their own port: what stands under `args.dialects` as `gr00t` and `vlagents`."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from vlagents_ray.wire.messages import RankName
from vlagents_ray.wire.presets import read_mapping

Mapping = str | dict[str, Any]


def _readable(value: Mapping) -> Mapping:
    read_mapping(value)
    return value


class GatewayArgs(BaseModel):
    """What every such door has."""

    model_config = ConfigDict(extra="forbid")

    port: int = Field(ge=1, le=65535, description="of the door; a taken one fails the deployment")
    host: str | None = Field(
        default=None,
        description="the address that it listens at; default: that of the server which `vlagents-ray serve` starts, "
        "and 127.0.0.1 under `serve deploy`",
    )
    rank: RankName = Field(default="robot", description="class of its requests: robots go before simulations")


class GR00TArgs(GatewayArgs):
    """GR00T's ZMQ protocol, as its `PolicyServer` answers it."""

    port: int = Field(default=5555, ge=1, le=65535)
    mapping: Mapping = Field(
        default="gr00t", description="a preset's name, or an object: see vlagents_ray.wire.mapping"
    )

    _mapping = field_validator("mapping")(_readable)


class GripperArgs(BaseModel):
    """Where a row of the policy's actions holds a robot's gripper."""

    model_config = ConfigDict(extra="forbid")

    column: int = Field(default=-1, description="as in Python: -1 is the last")
    open: float | None = Field(default=None, description="its value for open; default: the policy's contract, or 1")
    closed: float | None = Field(default=None, description="and for closed; default: the policy's contract, or 0")

    @model_validator(mode="after")
    def _two_values(self) -> GripperArgs:
        if self.open is not None and self.open == self.closed:
            raise ValueError(f"open and closed are both {self.open}; they must differ")
        return self


class RobotArgs(BaseModel):
    """Which columns of a row are one robot's."""

    model_config = ConfigDict(extra="forbid")

    start: int | None = None
    stop: int | None = None
    gripper: GripperArgs | None = Field(
        default=None, description="the column that goes into SingleAct.gripper; unset: none"
    )


class VlagentsArgs(GatewayArgs):
    """The RPyC protocol of the package `vlagents`, 0.2 and 0.3."""

    port: int = Field(default=8080, ge=1, le=65535)
    name: str | None = Field(
        default=None, description="the model's name, which clients must give; default: the application's"
    )
    mapping: Mapping | None = Field(
        default=None, description="theirs are cameras/NAME, state/NAME, gripper, info; unset: names stay as they are"
    )
    gripper: GripperArgs | None = Field(
        default=None, description="of the only robot: the column that goes into SingleAct.gripper; unset: none"
    )
    robots: dict[str, RobotArgs] = Field(default_factory=dict, description="with several, which columns are whose")
    shared_memory: bool = Field(default=True, description="read the cameras of clients on this machine in place")
    without_key: bool = Field(
        default=False, description="with API keys on: let everybody in here nevertheless, as the protocol has no key"
    )

    @field_validator("mapping")
    @classmethod
    def _mapping(cls, value: Mapping | None) -> Mapping | None:
        return None if value is None else _readable(value)

    @model_validator(mode="after")
    def _one_way(self) -> VlagentsArgs:
        if self.gripper is not None and self.robots:
            raise ValueError("gripper is for a single robot; with robots, state each robot's own")
        return self


class GatewayDialects(BaseModel):
    """Those of `args.dialects` that have a port of their own."""

    model_config = ConfigDict(extra="forbid")

    gr00t: GR00TArgs | None = None
    vlagents: VlagentsArgs | None = None

    def gateways(self) -> dict[str, GatewayArgs]:
        """Those that are on, by name."""
        found: dict[str, GatewayArgs | None] = {"gr00t": self.gr00t, "vlagents": self.vlagents}
        return {name: args for name, args in found.items() if args is not None}

    @model_validator(mode="after")
    def _ports_of_their_own(self) -> GatewayDialects:
        ports = {args.port for args in self.gateways().values()}
        if len(ports) < len(self.gateways()):
            raise ValueError(f"gr00t and vlagents share port {ports.pop()}; each needs one of its own")
        return self
