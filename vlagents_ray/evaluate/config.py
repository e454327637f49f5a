"""The settings of an evaluation: closed, typed, and what of them decides an episode's outcome."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    JsonValue,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    field_validator,
    model_validator,
)
from typing_extensions import Self

from vlagents_ray.client.ways import TransportName

Video = Literal["none", "failures", "all"]
Name = Annotated[str, Field(min_length=1)]


class EvalConfig(BaseModel):
    """What to evaluate, in what, how many episodes, and where the results go."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    # What decides an episode's outcome, together with its number (see `outcome_settings`).
    envs: list[Name] = Field(min_length=1)  # registered names, e.g. "maniskill/PushCube-v1"
    env_options: dict[str, JsonValue] = {}  # for every env's constructor; a key in `envs` holds that env's own
    reset_options: dict[str, JsonValue] = {}  # handed to every `reset` of every env
    policy: Name = "policy"  # its name, for the record
    policy_config: dict[str, JsonValue] = {}
    policy_options: dict[str, JsonValue] = {}  # handed to every `reset` of the policy, e.g. {"checkpoint_step": 20000}
    checkpoint: str | None = None  # the server's own; what each episode was played by stands in its result
    execute: PositiveInt | None = None  # rows executed of each action chunk; None = all
    seed: NonNegativeInt = 0  # episode i of an env uses seed + i
    # How images reach a policy over a network. JPEG changes them a little, so it has to be asked for; the others
    # do not, and "exact" takes the faster of raw and lossless, so that results never depend on the link.
    codec: Literal["exact", "raw", "lossless", "jpeg"] = "exact"

    # How much of it, and how.
    episodes: PositiveInt = 10  # per env
    workers: PositiveInt = 1
    out: Path
    video: Video = "failures"
    resume: bool = False
    policy_url: str | None = None
    transport: TransportName = "auto"

    # What happens when something breaks.
    retries: NonNegativeInt = 3  # further attempts after an infrastructure failure
    abort_after: NonNegativeInt = 10  # stop after so many infrastructure failures in a row; 0 = never
    make_timeout_s: PositiveFloat = 300.0  # making an env, imports and shaders included
    env_timeout_s: PositiveFloat = 60.0  # one reset or step
    policy_timeout_s: PositiveFloat = 60.0  # one reset or act of the policy
    connect_timeout_s: PositiveFloat = 120.0  # reaching the policy, a restart of its server included
    place_timeout_s: PositiveFloat = 120.0  # the cluster finding room for a worker

    # What a worker takes.
    cpus_per_worker: NonNegativeFloat = 0.5  # low, so that workers and policy fit on a small machine
    gpus_per_worker: NonNegativeFloat = 0.0
    threads: PositiveInt = 1  # of OpenMP, MKL, llvmpipe and the like, in each worker
    runtime_env: dict[str, JsonValue] = {}  # Ray's; its env_vars win over the thread settings

    @field_validator("envs")
    @classmethod
    def _distinct(cls, envs: list[str]) -> list[str]:
        repeated = sorted({name for name in envs if envs.count(name) > 1})
        if repeated:
            raise ValueError(f"{repeated} named twice; name each env once and raise `episodes`")
        return envs

    @field_validator("policy_options")
    @classmethod
    def _not_ours(cls, options: dict[str, JsonValue]) -> dict[str, JsonValue]:
        if taken := sorted({"seed", "env", "contract"} & options.keys()):
            raise ValueError(f"{taken} are set episode by episode; leave them out")
        return options

    @model_validator(mode="after")
    def _options_are_mappings(self) -> Self:
        for env in self.envs:
            own = self.env_options.get(env, {})
            if not isinstance(own, dict):
                raise ValueError(f"env_options[{env!r}]: got {own!r}, want a mapping, the options of that env")  # noqa: TRY004 (pydantic wants ValueError)
        return self

    def options_for(self, env: str) -> dict[str, JsonValue]:
        """The constructor's options of `env`: those for every env, then its own."""
        common = {k: v for k, v in self.env_options.items() if k not in self.envs}
        own = self.env_options.get(env)
        return common | own if isinstance(own, dict) else common


def outcome_settings(config: EvalConfig, env: str) -> dict[str, Any]:
    """All settings that an episode of `env` depends on, apart from its number."""
    return {
        "env": env,
        "env_options": config.options_for(env),
        "reset_options": config.reset_options,
        "policy": config.policy,
        "policy_config": config.policy_config,
        "policy_options": config.policy_options,
        "checkpoint": config.checkpoint,
        "execute": config.execute,
        "codec": "jpeg" if config.codec == "jpeg" else "exact",
    }


def canonical(value: object) -> str:
    """JSON with sorted keys and no spaces: equal values give equal text."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def fingerprint(settings: object) -> str:
    """16 hexadecimal digits that stand for `settings`."""
    return hashlib.sha256(canonical(settings).encode()).hexdigest()[:16]
