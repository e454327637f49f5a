"""The settings of an evaluation: closed, typed; policies x checkpoints x suites x tasks x seeds."""

from __future__ import annotations

import hashlib
import itertools
import json
from pathlib import Path
from typing import Annotated, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
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

EpisodeChoice = Literal["none", "failures", "all"]
Tracker = Literal["wandb", "trackio", "tensorboard"]
Name = Annotated[str, Field(min_length=1)]


class _Closed(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class StepRange(_Closed):
    """Steps of training at equal distances, the last one included."""

    first: NonNegativeInt
    last: NonNegativeInt
    every: PositiveInt

    @property
    def steps(self) -> range:
        """All of them."""
        return range(self.first, self.last + 1, self.every)


class PolicyConfig(_Closed):
    """A policy, how it is reached, and which of its checkpoints are evaluated."""

    name: Name = "policy"  # for the record; two policies of one evaluation have two
    # A registered policy or a deployment file, which `vlagents-ray eval` serves for the length of the run; or else
    source: str | None = None
    url: str | None = None  # of its server, e.g. "http://gpu-box:8000", or "serve://NAME" in this cluster.
    config: dict[str, JsonValue] = {}  # what it is served with, over a deployment file's own
    options: dict[str, JsonValue] = {}  # handed to every `reset` of the policy
    checkpoint: str | None = None  # the server's own; what each episode was played by stands in its result
    # A sweep over checkpoints: a list, or {first, last, every}; each is chosen by the reset option `checkpoint_step`.
    steps: list[NonNegativeInt] = []
    execute: PositiveInt | None = None  # rows executed of each action chunk; None = all
    # How images reach a policy over a network. JPEG changes them a little, so it has to be asked for; the others
    # do not, and "exact" takes the faster of raw and lossless, so that results never depend on the link.
    codec: Literal["exact", "raw", "lossless", "jpeg"] = "exact"
    transport: TransportName = "auto"

    @field_validator("steps", mode="before")
    @classmethod
    def _range(cls, steps: object) -> object:
        if not isinstance(steps, dict):
            return steps
        return list(StepRange.model_validate(steps).steps)

    @field_validator("steps")
    @classmethod
    def _once(cls, steps: list[int]) -> list[int]:
        if repeated := sorted({step for step in steps if steps.count(step) > 1}):
            raise ValueError(f"{repeated} named twice; name each step once")
        return steps

    @model_validator(mode="after")
    def _not_ours(self) -> Self:
        ours = {"seed", "env", "contract"} | ({"checkpoint_step"} if self.steps else set())
        if taken := sorted(ours & self.options.keys()):
            raise ValueError(f"options: {taken} are set episode by episode; leave them out")
        return self


class WorkerConfig(_Closed):
    """What a worker takes, and where it runs."""

    cpus: NonNegativeFloat = 0.5  # low, so that workers and policy fit on a small machine
    gpus: NonNegativeFloat = 0.0
    threads: PositiveInt = 1  # of OpenMP, MKL, llvmpipe and the like
    # Ray's; its env_vars win over the thread settings. A simulator with packages of its own names their Python,
    # with Ray in it: {"py_executable": "/envs/rcs/bin/python"}.
    runtime_env: dict[str, JsonValue] = {}


class ClockConfig(_Closed):
    """Real-time mode: the env's clock runs on while the policy thinks (see `vlagents_ray.evaluate.clock`)."""

    # s that each answer takes: "measured" as it comes, transport included, or injected, which repeats exactly.
    latency: Literal["measured"] | Annotated[FiniteFloat, Field(ge=0)] = "measured"
    # What is executed between observation and answer. "chunk": what is left of the last chunk, then what stops the
    # robot: "zero" for relative actions, else "hold"; "hold": the last action again; "zero": no motion, the gripper
    # as it was commanded.
    meanwhile: Literal["chunk", "hold", "zero"] = "chunk"
    hz: Annotated[FiniteFloat, Field(gt=0)] | None = None  # ticks a second; None: the env's control_hz
    align: bool = True  # drop the rows whose ticks were over when the answer came
    # Tell the policy what is left of the last chunk, and for how many ticks it will be executed (`interface.DELAY`).
    real_time_chunking: bool = False
    # The action that is executed before the first answer, and by "zero"; None: zeros, and the gripper open at first.
    neutral: list[FiniteFloat] | None = None


class StopConfig(_Closed):
    """When a cell is certain enough to end early (see `vlagents_ray.evaluate.stopping`)."""

    error_rate: float = Field(default=0.05, gt=0, lt=1)  # of each cell's confidence sequence, over all looks together
    target: float | None = Field(default=None, ge=0, le=1)  # stop when this success rate is excluded
    width: float | None = Field(default=None, gt=0, lt=1)  # stop when the interval is narrower
    at_least: PositiveInt = 1  # episodes

    @model_validator(mode="after")
    def _some_end(self) -> Self:
        if self.target is None and self.width is None:
            raise ValueError("got neither target nor width; want one of them, or both: whichever comes first stops")
        return self


class SuiteConfig(_Closed):
    """Environments that are evaluated alike."""

    name: str = ""  # for the record; an env that stands in two suites needs two names, and other settings
    envs: list[Name] = Field(min_length=1)  # registered names, "maniskill/PushCube-v1", or patterns, "libero/*"
    env_options: dict[str, JsonValue] = {}  # for the constructor
    reset_options: dict[str, JsonValue] = {}  # handed to every `reset` of the env
    episodes: PositiveInt = 10  # of each env and seed
    seeds: list[NonNegativeInt] = Field(default=[0], min_length=1)  # episode i uses seed + i
    num_envs: PositiveInt = 1  # that one worker steps together, in one simulator where that can be (ManiSkill on a GPU)
    worker: WorkerConfig | None = None  # in place of the evaluation's
    clock: ClockConfig | None = None  # real-time mode; None: the env waits for the policy

    @field_validator("envs")
    @classmethod
    def _distinct(cls, envs: list[str]) -> list[str]:
        if repeated := sorted({name for name in envs if envs.count(name) > 1}):
            raise ValueError(f"{repeated} named twice; name each env once and raise `episodes`")
        return envs

    @model_validator(mode="after")
    def _alone_in_real_time(self) -> Self:
        if self.clock is not None and self.num_envs > 1:
            raise ValueError(f"num_envs: got {self.num_envs} with a clock, want 1: each env's time runs by itself")
        return self

    @model_validator(mode="after")
    def _apart(self) -> Self:
        ordered = sorted(self.seeds)
        for low, high in itertools.pairwise(ordered):
            if high - low < self.episodes:
                raise ValueError(
                    f"seeds: {low} and {high} with {self.episodes} episodes each would play some twice; "
                    f"want them {self.episodes} or more apart"
                )
        return self


class TrackingConfig(_Closed):
    """Under which names trackers show an evaluation."""

    project: Name = "vlagents-ray"
    group: str | None = None  # of runs; default: the name of the folder of results
    videos: NonNegativeInt = 4  # of each cell that are handed over, failures first


class EvalConfig(_Closed):
    """Which policies to evaluate, in what, and where the results go."""

    policies: list[PolicyConfig] = Field(min_length=1)
    suites: list[SuiteConfig] = Field(min_length=1)
    out: Path
    workers: PositiveInt = 1  # environments rolled out in parallel
    video: EpisodeChoice = "failures"  # of which episodes there are videos
    record: EpisodeChoice = "none"  # and of which trajectories: states, actions, rewards, and what the policy saw
    resume: bool = False
    worker: WorkerConfig = WorkerConfig()
    stop: StopConfig | None = None  # early stopping; None: every episode is played
    track: list[Tracker] = []  # where rates and videos are shown beside `out`, against the training step
    tracking: TrackingConfig = TrackingConfig()

    # What happens when something breaks.
    retries: NonNegativeInt = 3  # further attempts after an infrastructure failure
    abort_after: NonNegativeInt = 10  # stop after so many infrastructure failures in a row; 0 = never
    make_timeout_s: PositiveFloat = 300.0  # making an env, imports and shaders included
    env_timeout_s: PositiveFloat = 60.0  # one reset or step
    policy_timeout_s: PositiveFloat = 60.0  # one reset or act of the policy
    connect_timeout_s: PositiveFloat = 120.0  # reaching the policy, a restart of its server included
    place_timeout_s: PositiveFloat = 120.0  # the cluster finding room for a worker

    @field_validator("policies")
    @classmethod
    def _named_apart(cls, policies: list[PolicyConfig]) -> list[PolicyConfig]:
        names = [policy.name for policy in policies]
        if repeated := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"two policies are named {repeated}; give each a `name` of its own")
        return policies


def canonical(value: object) -> str:
    """JSON with sorted keys and no spaces: equal values give equal text."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def fingerprint(settings: object) -> str:
    """16 hexadecimal digits that stand for `settings`."""
    return hashlib.sha256(canonical(settings).encode()).hexdigest()[:16]
