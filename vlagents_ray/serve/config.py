"""The settings of a deployment: what stands under `args:` in a deployment file. Unknown keys are errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

from vlagents_ray.interface import Agent
from vlagents_ray.serve.auth import Keys, load_keys
from vlagents_ray.serve.checkpoints import Checkpoints
from vlagents_ray.serve.dialects.config import DialectArgs
from vlagents_ray.serve.environments.config import EnvironmentArgs
from vlagents_ray.wire.messages import DEFAULT_LIMITS, Limits

POLICY, GATEWAY = "Policy", "Gateway"  # the deployments of an application


class _Closed(BaseModel):
    model_config = ConfigDict(extra="forbid")


class BatchArgs(_Closed):
    """The batch queue of one replica."""

    max_size: int = Field(default=16, ge=1, description="observations in one forward pass, at most")
    sizes: list[int] | None = Field(
        default=None,
        description="for compiled models: the only batch sizes to run, ascending; smaller batches are padded up to "
        "the next one. The largest is max_size, which may then be left out",
    )
    patience: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="how long a batch may wait for simulations that were in the batch before and are coming back, as "
        "a share of that batch's duration; 0 never waits. No robot waits, nor does a lone session",
    )

    @model_validator(mode="after")
    def _consistent(self) -> BatchArgs:
        if self.sizes is None:
            return self
        if not self.sizes or self.sizes[0] < 1 or self.sizes != sorted(set(self.sizes)):
            raise ValueError(f"sizes: got {self.sizes}, want ascending positive numbers, such as [1, 2, 4, 8, 16]")
        if "max_size" in self.model_fields_set and self.max_size != self.sizes[-1]:
            raise ValueError(f"max_size {self.max_size} is not the largest of sizes {self.sizes}; leave it out")
        self.max_size = self.sizes[-1]
        return self


class CheckpointArgs(_Closed):
    """Which checkpoints a session may choose for itself: `reset(..., checkpoint="late")`, `checkpoint_step=20000`."""

    choices: dict[str, dict[str, Any]] = Field(
        default_factory=dict, description="by name, the settings that take the place of those in `config`"
    )
    steps: bool = Field(default=False, description="any step of a checkpoint whose path holds {step}")
    loaded: int = Field(default=2, ge=1, description="checkpoints in the memory of one replica at once, at most")

    def of(self, make: Callable[[Mapping[str, Any]], Agent], config: Mapping[str, Any]) -> Checkpoints:
        """Those of the policy that `make` makes, whose own settings are `config`."""
        return Checkpoints(make, config, self.choices, steps=self.steps, loaded=self.loaded)


class SessionArgs(_Closed):
    """Sessions of one replica."""

    limit: int = Field(default=1000, ge=1, description="sessions held at once; the next reset gets 503")
    idle_s: float = Field(default=600.0, gt=0, description="a session that sends nothing for so long is forgotten")


class StreamArgs(_Closed):
    """Each replica's own port for WebSockets, which saves the way through the proxy.

    Clients find it by the metadata; those that do not reach it (a firewall, a tunnel) go through the proxy.
    """

    enabled: bool = True
    ports: tuple[int, int] | None = Field(
        default=None, description="first and last port to choose from; unset: any. Each replica of a node takes one"
    )

    @model_validator(mode="after")
    def _ascending(self) -> StreamArgs:
        if self.ports is not None and not 1 <= self.ports[0] <= self.ports[1] <= 65_535:
            raise ValueError(f"ports: got {list(self.ports)}, want the first and the last one, such as [9000, 9015]")
        return self


class LimitArgs(_Closed):
    """What one request may hold; anything over gets 413. And how long its client may take."""

    slow_s: float = Field(
        default=30.0,
        gt=0,
        description="a request's body has to be here, a WebSocket's reply to be taken in this time; else its "
        "connection is cut",
    )
    body_bytes: int = Field(default=DEFAULT_LIMITS.body_bytes, ge=1024)
    pixels: int = Field(default=DEFAULT_LIMITS.pixels, ge=1, description="of one image")
    cameras: int = Field(default=DEFAULT_LIMITS.cameras, ge=0)
    state_values: int = Field(
        default=DEFAULT_LIMITS.state_values, ge=0, description="of one part of the proprioception"
    )
    depth: int = Field(default=DEFAULT_LIMITS.depth, ge=1, description="nesting of info and kwargs")
    items: int = Field(default=DEFAULT_LIMITS.items, ge=1, description="values in info and kwargs")
    text: int = Field(default=DEFAULT_LIMITS.text, ge=1, description="characters of an instruction")

    def limits(self) -> Limits:
        """As the decoders take them."""
        return Limits(**self.model_dump(exclude={"slow_s"}))


class AccessArgs(_Closed):
    """Who may use the server: `vlagents_ray.serve.auth`."""

    keys_file: str | None = Field(
        default=None,
        description="path of the API keys, on every node the same; unset: what VLAGENTS_RAY_KEYS_FILE or "
        "VLAGENTS_RAY_KEYS say where the replica runs",
    )
    insecure: bool = Field(default=False, description="let in anybody who reaches the port from another machine")

    @model_validator(mode="after")
    def _one(self) -> AccessArgs:
        if self.keys_file is not None and self.insecure:
            raise ValueError("keys_file and insecure exclude each other; keep one")
        return self

    def keys(self) -> Keys | None:
        """Those that this process knows of; None lets everybody in. `ConfigError` if they cannot be read."""
        return None if self.insecure else load_keys(self.keys_file)


class AutoscalingArgs(_Closed):
    """Replicas by measured load, see `vlagents_ray.serve.autoscaling`; sessions over all transports count."""

    min_replicas: int = Field(default=1, ge=0)
    max_replicas: int = Field(default=1, ge=1)
    initial_replicas: int | None = Field(default=None, ge=0)
    target_utilisation: float = Field(
        default=0.7, gt=0, le=1, description="share of the time in which a replica's policy is busy"
    )
    target_waiting: float = Field(
        default=1.0, gt=0, description="mean number of requests in a replica's queue, in batches of the largest size"
    )
    target_sessions: float | None = Field(default=None, gt=0, description="sessions of a replica; unset: any number")
    look_back_s: float = Field(default=15.0, gt=0, description="load is averaged over this time")
    upscale_delay_s: float = Field(default=10.0, ge=0, description="more must be wanted for this long")
    downscale_delay_s: float = Field(default=300.0, ge=0, description="less must be wanted for this long")

    @model_validator(mode="after")
    def _ordered(self) -> AutoscalingArgs:
        if self.min_replicas > self.max_replicas:
            raise ValueError(f"min_replicas {self.min_replicas} is over max_replicas {self.max_replicas}")
        return self

    def options(self) -> dict[str, Any]:
        """As Serve's `autoscaling_config` takes them."""
        chosen = {"target_utilisation", "target_waiting", "target_sessions"}
        return {
            **self.model_dump(exclude_none=True, exclude=chosen | {"look_back_s"}),
            "look_back_period_s": self.look_back_s,
            # How often a replica reports: as often as it measures, where Serve's own default is every 10 s.
            "metrics_interval_s": min(2.0, self.look_back_s / 5),
            "policy": {
                "policy_function": "vlagents_ray.serve.autoscaling:MeasuredLoad",
                "policy_kwargs": self.model_dump(include=chosen),
            },
        }


class ResourceArgs(_Closed):
    """What Ray reserves for each replica."""

    num_cpus: float = Field(default=0.0, ge=0, description="0 never competes with the rollouts for a slot")
    num_gpus: float = Field(default=0.0, ge=0)
    memory: float | None = Field(default=None, gt=0, description="bytes")
    custom: dict[str, float] = Field(default_factory=dict, description="the cluster's own resources, by name")


class ServerArgs(_Closed):
    """One policy, served."""

    policy: str = Field(description="a registered name (`vlagents-ray policies`) or 'module:Class'")
    config: dict[str, Any] = Field(default_factory=dict, description="the policy's own settings")
    wrappers: list[str | dict[str, dict[str, Any]]] = Field(
        default=[],
        description="what changes the policy's observations, the first being the nearest to the robot: names, or "
        "{name: settings}",
    )
    checkpoints: CheckpointArgs = CheckpointArgs()
    replicas: int | None = Field(default=None, ge=1, description="a fixed number; excludes `autoscaling`")
    autoscaling: AutoscalingArgs | None = None
    answer_while_loading: bool = Field(
        default=True,
        description="an application's first replica runs at once, and says 503 until its policy has loaded; false: it "
        "runs only then, for whoever sends robots to a new cluster as soon as that runs",
    )
    batch: BatchArgs = BatchArgs()
    sessions: SessionArgs = SessionArgs()
    limits: LimitArgs = LimitArgs()
    access: AccessArgs = AccessArgs()
    stream: StreamArgs = StreamArgs()
    resources: ResourceArgs = ResourceArgs()
    environment: EnvironmentArgs = Field(default=EnvironmentArgs(), description="the Python that the policy runs in")
    dialects: DialectArgs = Field(default=DialectArgs(), description="other systems' clients that may connect")

    @model_validator(mode="after")
    def _one_scaling(self) -> ServerArgs:
        if self.replicas is not None and self.autoscaling is not None:
            raise ValueError("replicas and autoscaling exclude each other; keep one")
        return self
