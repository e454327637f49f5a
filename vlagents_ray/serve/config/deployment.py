"""The settings of a deployment, under `args:` in a deployment file; unknown keys are errors."""

from __future__ import annotations

import os
from dataclasses import fields
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from vlagents_ray.bounds import MOST_BYTES, MOST_CPUS, MOST_ROWS, MOST_S, MOST_WORKERS
from vlagents_ray.policies.base.program import Program, loaded_code, software
from vlagents_ray.policies.loading import Invariant
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, MessageLimits
from vlagents_ray.ray_tools.git_state import GitState, code_of
from vlagents_ray.ray_tools.runtime_env import require_no_secrets
from vlagents_ray.registry import target_of
from vlagents_ray.serve.access.api_keys import Keys, load_keys
from vlagents_ray.serve.config.dialects import DialectArgs
from vlagents_ray.serve.config.parts import PartArgs
from vlagents_ray.serve.queue.call_limits import CallLimits

POLICY, GATEWAY = "Policy", "Gateway"  # the deployments of an application

Port = Annotated[int, Field(ge=1, le=65_535)]
# Links are not followed, since the interpreter of a virtual environment is a link to the
# interpreter that created the environment.
AbsolutePath = Annotated[
    str, AfterValidator(lambda path: os.path.abspath(os.path.expanduser(path)))
]


class _DeploymentModel(BaseModel):
    # Errors are logged, so they contain no inputs, which may be secret.
    model_config = ConfigDict(extra="forbid", hide_input_in_errors=True)


class EnvironmentArgs(_DeploymentModel):
    """The Python environment of a policy; by default the policy runs in the replica, in the
    cluster's environment.
    """

    python: AbsolutePath | None = Field(
        default=None,
        description="Interpreter of a virtual environment, at the same path on every node. A "
        "relative path starts at the working directory.",
    )
    process: Literal["auto", "replica", "child"] = Field(
        default="auto",
        description="With `python`: where the policy runs. `replica`: in the replica itself, "
        "which needs the cluster's minor version of Python and its version of Ray. "
        "`child`: in a child process of the replica. `auto`: in the replica if "
        "possible.",
    )
    env_vars: dict[str, str] = Field(
        default_factory=dict,
        description="Environment variables of the policy's process, without secrets.",
    )

    @model_validator(mode="after")
    def _one(self) -> EnvironmentArgs:
        if self.python is None and self.process != "auto":
            raise ValueError(
                f"process: expected `python` to be set as well, got {self.process!r} alone; name "
                "an interpreter, or leave out `process`"
            )
        # The check also applies to a child process, since Serve shows the settings of the
        # deployment, and the policy may later run in the replica.
        require_no_secrets({"env_vars": self.env_vars})
        return self

    def runtime_env(self) -> dict[str, Any]:
        """Return Ray's `runtime_env` of the replica; empty if the policy runs in a child
        process.
        """
        if self.process == "child":
            return {}
        options = {"py_executable": self.python, "env_vars": self.env_vars}
        return {name: value for name, value in options.items() if value}


class BatchArgs(_DeploymentModel):
    """The settings of the batch queue of one replica."""

    max_size: int = Field(
        default=16,
        ge=1,
        le=MOST_ROWS,
        description="Largest number of observations in one forward pass.",
    )
    sizes: list[Annotated[int, Field(le=MOST_ROWS)]] | None = Field(
        default=None,
        description="For compiled models: the only batch sizes to run, ascending. Smaller batches "
        "are padded to the next size. The largest is `max_size`, which may then be "
        "omitted.",
    )
    invariant: Invariant = Field(
        default=False,
        description="Pad each forward pass to `max_size` rows, so that each bit of an action is "
        "the same alone, in any batch, after a restart and on an equal replica. A policy for which "
        "this does not hold is rejected. `auto`: pad, but accept any policy.",
    )
    patience: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="How long a batch may wait for the simulations of the previous batch, as a "
        "share of that batch's duration. 0 never waits.",
    )

    @model_validator(mode="after")
    def _consistent(self) -> BatchArgs:
        if self.sizes is None:
            return self
        if self.invariant:
            raise ValueError(
                f"sizes: expected none with `invariant`, whose only size is max_size, got "
                f"{self.sizes}; leave them out"
            )
        if not self.sizes or self.sizes[0] < 1 or self.sizes != sorted(set(self.sizes)):
            raise ValueError(
                "sizes: expected ascending positive numbers, such as [1, 2, 4, 8, 16], got "
                f"{self.sizes}"
            )
        if "max_size" in self.model_fields_set and self.max_size != self.sizes[-1]:
            raise ValueError(
                f"max_size: expected the largest of sizes {self.sizes}, got {self.max_size}; "
                "leave it out"
            )
        self.max_size = self.sizes[-1]
        return self


class SessionArgs(_DeploymentModel):
    """The limits of the sessions of one replica."""

    limit: int = Field(
        default=1000,
        ge=1,
        le=1_000_000,
        description="Largest number of sessions at the same time. The next reset returns 503.",
    )
    idle_s: float = Field(
        default=600.0,
        gt=0,
        le=MOST_S,
        description="Time without a request after which a session ends, in seconds.",
    )


class StreamArgs(_DeploymentModel):
    """The port of each replica for WebSockets, which bypasses the proxy.

    Clients get its address from the metadata; clients that cannot reach it, for example through a
    firewall or a tunnel, use the proxy.
    """

    enabled: bool = Field(
        default=True,
        description="Whether each replica has its own port.",
    )
    ports: tuple[Port, Port] | None = Field(
        default=None,
        description="First and last port to choose from, one for each replica of a node. null: "
        "any.",
    )

    @model_validator(mode="after")
    def _ascending(self) -> StreamArgs:
        if self.ports is not None and self.ports[0] > self.ports[1]:
            raise ValueError(
                "ports: expected the first and the last one, such as [9000, 9015], got "
                f"{list(self.ports)}"
            )
        return self


class LimitArgs(_DeploymentModel):
    """The size limits of a request, and the time limits of clients and of the policy. A larger
    request is answered with 413.
    """

    slow_s: float = Field(
        default=30.0,
        gt=0,
        le=MOST_S,
        description="Time in which a client has to send the body of a request, or to receive a "
        "message of a WebSocket, in seconds. Then its connection is closed.",
    )
    act_s: float = Field(
        default=CallLimits().act_s,
        gt=0,
        le=MOST_S,
        description="Time limit of a batch or a reset, in seconds. If one exceeds it, and ten "
        "times the longest duration so far, the replica is unhealthy: Serve replaces "
        "it, and its sessions continue in other replicas.",
    )
    warm_up_s: float = Field(
        default=CallLimits().warm_up_s,
        gt=0,
        le=MOST_S,
        description="Time limit of the first two resets, and of the first two batches of each of "
        "`batch.sizes`, which may compile, in seconds.",
    )
    load_s: float = Field(
        default=CallLimits().load_s,
        gt=0,
        le=MOST_S,
        description="Time limit for loading the policy, in seconds.",
    )
    body_bytes: int = Field(
        default=DEFAULT_LIMITS.body_bytes,
        ge=1024,
        le=MOST_BYTES,
        description="Largest body of a request, in bytes.",
    )
    decoded_bytes: int = Field(
        default=DEFAULT_LIMITS.decoded_bytes,
        ge=1024,
        le=MOST_BYTES,
        description="Largest decoded size of the images and bytes of one request, each counted "
        "as often as the request refers to it.",
    )
    in_flight_bytes: int = Field(
        default=DEFAULT_LIMITS.in_flight_bytes,
        ge=1024,
        le=MOST_BYTES,
        description="Largest size of all messages in a replica, encoded and decoded, in bytes. "
        "Above it, requests return 503. A quarter is reserved for robots.",
    )
    pixels: int = Field(
        default=DEFAULT_LIMITS.pixels,
        ge=1,
        le=MOST_BYTES,
        description="Largest number of pixels of one image.",
    )
    cameras: int = Field(
        default=DEFAULT_LIMITS.cameras,
        ge=0,
        le=1_000_000,
        description="Largest number of cameras of an observation.",
    )
    state_values: int = Field(
        default=DEFAULT_LIMITS.state_values,
        ge=0,
        le=1_000_000,
        description="Largest number of values in one part of the state.",
    )
    depth: int = Field(
        default=DEFAULT_LIMITS.depth,
        ge=1,
        le=1_000_000,
        description="Largest nesting depth of info and kwargs.",
    )
    items: int = Field(
        default=DEFAULT_LIMITS.items,
        ge=1,
        le=1_000_000,
        description="Largest number of values in info and kwargs.",
    )
    text: int = Field(
        default=DEFAULT_LIMITS.text,
        ge=1,
        le=1_000_000,
        description="Largest number of characters of an instruction.",
    )

    def limits(self) -> MessageLimits:
        """Return the limits of the decoders."""
        return MessageLimits(
            **self.model_dump(include={field.name for field in fields(MessageLimits)})
        )

    def call_limits(self) -> CallLimits:
        """Return the time limits of the engine's calls."""
        return CallLimits(self.act_s, self.warm_up_s, self.load_s)


class AccessArgs(_DeploymentModel):
    """The access settings of the server, see `vlagents_ray.serve.access.api_keys`."""

    keys_file: str | None = Field(
        default=None,
        description="Path of the file of API keys, the same on every node. null: the value of "
        "VLAGENTS_RAY_KEYS_FILE or VLAGENTS_RAY_KEYS of the replica.",
    )
    insecure: bool = Field(
        default=False,
        description="Accept clients on other machines without keys.",
    )
    plain_http: bool = Field(
        default=False,
        description="Do not warn that keys are sent unencrypted, because TLS ends elsewhere or "
        "the network is a VPN.",
    )
    hosts: list[Annotated[str, AfterValidator(str.lower)]] = Field(
        default_factory=list,
        description="Without keys: names in the public DNS with which clients reach the server. "
        "Its addresses, names without a dot, and names of private networks are always "
        "accepted.",
    )

    @model_validator(mode="after")
    def _one(self) -> AccessArgs:
        if self.keys_file is not None and self.insecure:
            raise ValueError("expected keys_file or insecure, got both; keep one")
        return self

    def keys(self) -> Keys | None:
        """Return the API keys of the file or the environment; None if requests need no key.

        Raises:
            ConfigError: The keys cannot be read.
        """
        return None if self.insecure else load_keys(self.keys_file)


class AutoscalingArgs(_DeploymentModel):
    """The settings of autoscaling, which derives the number of replicas from the load over all
    transports, see `vlagents_ray.serve.scaling.autoscaling`.
    """

    min_replicas: int = Field(
        default=1,
        ge=0,
        le=MOST_WORKERS,
        description="Smallest number of replicas, and their number at the start. With 0, an unused "
        "application has no replica.",
    )
    max_replicas: int = Field(
        default=1,
        ge=1,
        le=MOST_WORKERS,
        description="Largest number of replicas.",
    )
    target_utilisation: float = Field(
        default=0.7,
        gt=0,
        le=1,
        description="Share of the time for which clients may need a replica's policy. The "
        "remaining time absorbs bursts.",
    )
    target_sessions: float | None = Field(
        default=None,
        gt=0,
        le=1_000_000,
        description="Number of sessions of a replica, for policies that keep much memory for each, "
        "or compute elsewhere. null: any.",
    )
    look_back_s: float = Field(
        default=15.0,
        gt=0,
        le=MOST_S,
        description="Time over which the load is averaged, in seconds.",
    )
    upscale_delay_s: float = Field(
        default=10.0,
        ge=0,
        le=MOST_S,
        description="Time for which more replicas must be needed before they are added, in "
        "seconds. Replicas needed for sessions are added after at most 3 s.",
    )
    downscale_delay_s: float = Field(
        default=300.0,
        ge=0,
        le=MOST_S,
        description="Time for which fewer replicas, or none, must suffice before some are removed, "
        "in seconds. Choose it long if weights load slowly.",
    )

    @model_validator(mode="after")
    def _ordered(self) -> AutoscalingArgs:
        if self.min_replicas > self.max_replicas:
            raise ValueError(
                f"min_replicas {self.min_replicas} is over max_replicas {self.max_replicas}"
            )
        return self

    def options(self) -> dict[str, Any]:
        """Return Serve's `autoscaling_config`."""
        targets = {"target_utilisation", "target_sessions"}
        # Interval of the reports of a replica, s. Serve's default is 10 s.
        report_s = min(2.0, self.look_back_s / 5)
        # While a session moves, two replicas may count the session until both have reported again.
        all_reported_s = min(self.upscale_delay_s, 1.5 * report_s)
        kwargs = self.model_dump(include=targets) | {
            "busy_s": self.upscale_delay_s - all_reported_s
        }
        return {
            **self.model_dump(exclude_none=True, exclude=targets | {"look_back_s"}),
            "upscale_delay_s": all_reported_s,
            "look_back_period_s": self.look_back_s,
            "metrics_interval_s": report_s,
            "policy": {
                "policy_function": "vlagents_ray.serve.scaling.autoscaling:MeasuredLoad",
                "policy_kwargs": kwargs,
            },
        }


class ResourceArgs(_DeploymentModel):
    """The resources that Ray reserves for each replica."""

    num_cpus: float = Field(
        default=0.0,
        ge=0,
        le=MOST_CPUS,
        description="Number of CPUs that Ray reserves for each replica. With 0, a replica never "
        "competes with rollout workers for a slot.",
    )
    num_gpus: float = Field(
        default=0.0,
        ge=0,
        le=MOST_CPUS,
        description="Number of GPUs that Ray reserves for each replica, which may be a fraction.",
    )
    memory: float | None = Field(
        default=None,
        gt=0,
        le=MOST_BYTES,
        description="Memory that Ray reserves for each replica, in bytes.",
    )
    custom: dict[str, Annotated[float, Field(ge=0, le=1e12)]] = Field(
        default_factory=dict,
        description="Custom resources of the cluster, by name.",
    )


class ServerArgs(_DeploymentModel):
    """The settings of a server for one policy."""

    policy: str = Field(
        description="A registered name (`vlagents-ray policies` lists them) or `module:Class`.",
    )
    config: dict[str, Any] = Field(
        default_factory=dict,
        description="Settings of the policy.",
    )
    wrappers: list[str | dict[str, dict[str, Any]]] = Field(
        default=[],
        description="Wrappers of the policy, beginning with the wrapper that is nearest to the "
        "robot: names, or `{name: settings}`.",
    )
    replicas: int | None = Field(
        default=None,
        ge=1,
        le=MOST_WORKERS,
        description="Number of replicas, instead of `autoscaling`. null: 1.",
    )
    autoscaling: AutoscalingArgs | None = Field(
        default=None,
        description="Number of replicas according to the load, instead of `replicas`.",
    )
    batch: BatchArgs = Field(
        default=BatchArgs(),
        description="Batches of one replica.",
    )
    sessions: SessionArgs = Field(
        default=SessionArgs(),
        description="Sessions of one replica.",
    )
    limits: LimitArgs = Field(
        default=LimitArgs(),
        description="Limits of requests, and time limits of the policy.",
    )
    access: AccessArgs = Field(
        default=AccessArgs(),
        description="API keys, and clients without keys.",
    )
    stream: StreamArgs = Field(
        default=StreamArgs(),
        description="The port of each replica for WebSockets and HTTP, which bypasses the proxy.",
    )
    resources: ResourceArgs = Field(
        default=ResourceArgs(),
        description="Resources that Ray reserves for each replica.",
    )
    environment: EnvironmentArgs = Field(
        default=EnvironmentArgs(),
        description="Python environment of the policy.",
    )
    dialects: DialectArgs = Field(
        default=DialectArgs(),
        description="Protocols of other systems whose clients may connect, by name.",
    )
    parts: PartArgs = Field(
        default=PartArgs(),
        description="Parts of the replica that plug-ins add, by name. null turns off a part that "
        "is on by default.",
    )

    @property
    def initial_replicas(self) -> int:
        """The number of replicas that start without a request."""
        if self.autoscaling is None:
            return self.replicas or 1
        return self.autoscaling.min_replicas

    def code(self) -> tuple[GitState | None, Program]:
        """Return the git state of the policy's code, and its program: versions of software, and the
        digests of the files of the policy and its wrappers.
        """
        policy = target_of("policies", self.policy)
        program = software() | loaded_code(policy)
        for wrapper in self.wrappers:
            names = [wrapper] if isinstance(wrapper, str) else list(wrapper)
            for name in names:
                program.update(loaded_code(target_of("wrappers", name)))
        return code_of(policy), program

    @model_validator(mode="after")
    def _one_scaling(self) -> ServerArgs:
        if self.replicas is not None and self.autoscaling is not None:
            raise ValueError("expected replicas or autoscaling, got both; keep one")
        return self
