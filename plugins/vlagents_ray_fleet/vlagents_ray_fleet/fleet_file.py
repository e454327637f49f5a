"""The file of a fleet: its robots, the models that they need, and the available GPUs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from vlagents_ray import RemoteAgent
from vlagents_ray.bounds import MOST_ROWS, MOST_WORKERS
from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.naming import did_you_mean
from vlagents_ray.overrides import Override, read_config_file
from vlagents_ray.serve.fleet import USABLE, CostCurve
from vlagents_ray.settings import wrong_settings

MOST_LOAD = 0.8
"""The maximum load that a plan gives to a replica. It is the largest load at which, in the
simulation of six kinds of robots that all began within 3 s, each robot had at least 98 % of its
ticks in time (`python -m benchmarks.fleet_plans --loads`). At 0.85, robots of one kind had less;
the margin to `USABLE` is for these robots, and for replicas with more than their share of the
sessions.
"""

_SERVER_S = 10.0  # time limit for the request of the costs that a running replica has measured, s
_MOST_MS = 1e9
_MOST_HZ = 1e4
_MOST_GB = 1e6
_MOST_ROBOTS = 1_000_000

Milliseconds = Annotated[float, Field(gt=0, le=_MOST_MS)]
Hertz = Annotated[float, Field(gt=0, le=_MOST_HZ)]
Name = Annotated[str, Field(pattern=r"^[\w.@-]+$")]


class _FleetModel(BaseModel):
    model_config = ConfigDict(extra="forbid")


class ModelUse(_FleetModel):
    """How the robots of a group use one model."""

    rows: int = Field(
        default=1, ge=1, le=MOST_ROWS, description="number of rows of each chunk that are executed"
    )
    hz: Hertz | None = Field(
        default=None, description="rows per second; default: the rate of the robots"
    )
    age_ms: Milliseconds | None = Field(
        default=None,
        description="maximum age of an executed row; default: the maximum age of the robots",
    )


class RobotGroup(_FleetModel):
    """Robots with the same needs."""

    count: int = Field(ge=1, le=_MOST_ROBOTS, examples=[12])
    hz: Hertz = Field(examples=[10], description="ticks of the control loop per second")
    share: float = Field(
        default=0.98, gt=0, le=1, description="share of the ticks that must have an action in time"
    )
    age_ms: Milliseconds | None = Field(
        default=None, description="maximum age of an executed action; unset: any"
    )
    transport_ms: float = Field(
        default=5.0,
        ge=0,
        le=_MOST_MS,
        description="time for the transport, encoding and decoding of a request and its answer",
    )
    models: dict[Name, ModelUse] = Field(
        min_length=1,
        examples=["{pi0: {rows: 50}}"],
        description="how the robots use each model, by the model's name below `models`",
    )


class Costs(_FleetModel):
    """The duration of a batch over its number of rows, on a whole GPU."""

    fixed_ms: float | None = Field(
        default=None, ge=0, le=_MOST_MS, description="duration of a batch, independent of its size"
    )
    row_ms: float | None = Field(default=None, ge=0, le=_MOST_MS, description="of each row")
    table: dict[Annotated[int, Field(ge=1, le=MOST_ROWS)], Milliseconds] | None = Field(
        default=None,
        description="milliseconds by the size of the batch, as `vlagents-ray tune` prints them",
    )
    url: str | None = Field(
        default=None,
        description="address of a running server of the model, which measures the durations of "
        "its batches",
        examples=["http://gpu-box:8000/pi0"],
    )

    @model_validator(mode="after")
    def _one(self) -> Costs:
        is_line = self.fixed_ms is not None or self.row_ms is not None
        ways = [is_line, self.table is not None, self.url is not None]
        if sum(ways) != 1:
            raise ValueError(
                "expected one of `fixed_ms` with `row_ms`, `table` and `url`, got "
                f"{sorted(self.model_fields_set)}; keep one"
            )
        if is_line and None in (self.fixed_ms, self.row_ms):
            raise ValueError(
                f"expected fixed_ms with row_ms, got {sorted(self.model_fields_set)}; write both; "
                f"0 is allowed"
            )
        if is_line:
            self.curve()
        return self

    def curve(self) -> CostCurve:
        """Return the curve; with `url`, request it from the server.

        Raises:
            ConfigError: The costs are not above 0, or the server has measured too few batches.
        """
        if self.url is not None:
            return _curve_at(self.url)
        if self.table is not None:
            sizes = sorted(self.table.items())
            return CostCurve(table=tuple((size, duration / 1e3) for size, duration in sizes))
        return CostCurve((self.fixed_ms or 0.0) / 1e3, (self.row_ms or 0.0) / 1e3)


class FleetModel(_FleetModel):
    """A model that robots use, with its costs."""

    costs: Costs = Field(examples=["{fixed_ms: 29.3, row_ms: 8.06}"])
    memory_gb: float = Field(
        gt=0, le=_MOST_GB, examples=[9], description="GPU memory of one replica"
    )
    max_batch_size: int = Field(
        default=16, ge=1, le=MOST_ROWS, description="largest batch that was measured"
    )
    gpu_fraction: float | None = Field(
        default=None,
        gt=0,
        le=1,
        description="share of a GPU of each replica; unset: the plan chooses it",
    )
    max_load: float = Field(
        default=MOST_LOAD,
        gt=0,
        le=USABLE,
        description="maximum load of a replica: the requests per second that its robots need, as "
        "a share of the requests that it can answer",
    )
    deployment: str | None = Field(
        default=None,
        description="deployment file with the settings of the policy, relative to the file of the "
        "fleet",
    )
    policy: str | None = Field(
        default=None, description="in place of `deployment`: a registered name or 'module:Class'"
    )
    config: dict[str, Any] = Field(default_factory=dict, description="settings of `policy`")

    @model_validator(mode="after")
    def _one(self) -> FleetModel:
        if self.deployment is not None and (self.policy is not None or self.config):
            raise ValueError("expected deployment or policy with config, got both; keep one")
        return self


class GpuPool(_FleetModel):
    """The available GPUs, all of one kind."""

    count: int = Field(ge=1, le=MOST_WORKERS, examples=[4])
    memory_gb: float = Field(gt=0, le=_MOST_GB, examples=[80], description="of each")
    finest_fraction: float = Field(
        default=0.1,
        gt=0,
        le=1,
        description="smallest share of a GPU that the plan gives to a replica; with 1, GPUs are "
        "never shared",
    )


class FleetFile(_FleetModel):
    """The file of a fleet."""

    robots: dict[Name, RobotGroup] = Field(min_length=1)
    models: dict[Name, FleetModel] = Field(min_length=1)
    gpus: GpuPool = Field(examples=["{count: 4, memory_gb: 80}"])

    @model_validator(mode="after")
    def _consistent(self) -> FleetFile:
        used = set()
        for group, robots in self.robots.items():
            for name in robots.models:
                if name not in self.models:
                    raise ValueError(
                        f"robots.{group}.models: expected only {sorted(self.models)}, got "
                        f"{name!r}{did_you_mean(name, self.models)}"
                    )
                used.add(name)
        unused = sorted(self.models.keys() - used)
        if unused:
            raise ValueError(
                f"models: expected each to be used by some robots, got the unused {unused}; name "
                "them below `robots`, or leave them out"
            )
        for name, model in self.models.items():
            if model.memory_gb > self.gpus.memory_gb:
                raise ValueError(
                    f"models.{name}.memory_gb: expected at most the {self.gpus.memory_gb:g} of a "
                    f"GPU, got {model.memory_gb:g}"
                )
        return self


def read_fleet(file: Path | str, overrides: Sequence[Override] = ()) -> FleetFile:
    """Read the file of a fleet, and apply changes.

    Args:
        file: The file.
        overrides: The changes, as `parse_overrides` returns them.

    Raises:
        ConfigError: The file cannot be read, a change cannot be applied, or a setting is wrong.
    """
    keys = "`models`, `robots` and `gpus`"
    document = read_config_file(file, "file of a fleet", keys, overrides=overrides)
    try:
        return FleetFile(**document)
    except ValidationError as error:
        raise ConfigError(f"{file}: {wrong_settings(error, FleetFile)}") from error


def _curve_at(url: str) -> CostCurve:
    """Return the durations of batches that a running server has measured."""
    try:
        with RemoteAgent(url, timeout_s=_SERVER_S) as server:
            measured = server.metadata.get("batch_costs")
    except VLAgentsError as error:
        raise ConfigError(
            f"costs.url: expected the metadata of the server at {url}, got {error}; is the server "
            "running? Or write its costs into the file"
        ) from error

    sizes: dict[str, Any] = {}
    if isinstance(measured, dict) and isinstance(measured.get("ms_by_size"), dict):
        sizes = measured["ms_by_size"]
    if len(sizes) < 2:
        raise ConfigError(
            f"costs.url: expected batches of at least two sizes at {url}, got those of "
            f"{sorted(sizes) or 'none'}; let robots run first, or write the costs that "
            "`vlagents-ray tune` prints into the file"
        )
    try:
        return Costs.model_validate({"table": sizes}).curve()
    except ValidationError as error:
        raise ConfigError(
            f"costs.url: expected milliseconds by batch size from {url}: "
            f"{wrong_settings(error, Costs)}; is it a server of this project?"
        ) from error
