"""The settings of an evaluation, which are policies x checkpoints x suites x tasks x seeds. All
models are typed and reject unknown fields.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    JsonValue,
    field_validator,
    model_validator,
)
from typing_extensions import Self

from vlagents_ray.bounds import (
    MOST_CPUS,
    MOST_EPISODES,
    MOST_HZ,
    MOST_RETRIES,
    MOST_ROWS,
    MOST_S,
    MOST_SEED,
    MOST_STEP,
    MOST_STEPS_NAMED,
    MOST_WORKERS,
)
from vlagents_ray.chunking.careful import FRESH_GRIP
from vlagents_ray.chunking.choice import Choice, ChosenMode
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.ray_tools.runtime_env import require_no_secrets

EpisodeChoice = Literal["none", "failures", "all"]
RecordedImages = Literal["small", "exact"]
Name = Annotated[str, Field(min_length=1)]
Count = Annotated[int, Field(ge=1, le=MOST_EPISODES)]
Retries = Annotated[int, Field(ge=0, le=MOST_RETRIES)]
Rows = Annotated[int, Field(ge=1, le=MOST_ROWS)]
Seed = Annotated[int, Field(ge=0, le=MOST_SEED)]
Step = Annotated[int, Field(ge=0, le=MOST_STEP)]  # training step, or version of weights
Workers = Annotated[int, Field(ge=0, le=MOST_WORKERS)]
Resources = Annotated[float, Field(ge=0, le=MOST_CPUS)]  # number of CPUs or GPUs
Seconds = Annotated[float, Field(gt=0, le=MOST_S)]
Hertz = Annotated[float, Field(gt=0, le=MOST_HZ)]


Latency = Annotated[float, Field(ge=0, le=3600)]  # s
Latencies = Annotated[list[Latency], Field(min_length=1, max_length=MOST_ROWS)]


class _PlanModel(BaseModel):
    # Errors are logged, so they must not contain the input.
    model_config = ConfigDict(extra="forbid", frozen=True, hide_input_in_errors=True)


class StepRange(_PlanModel):
    """Training steps at equal distances, including the last step."""

    first: Step = Field(
        description="The first step.",
    )
    last: Step = Field(
        description="The last step, which is included.",
    )
    every: Annotated[int, Field(ge=1, le=MOST_STEP)] = Field(
        description="The distance between two steps.",
    )


class PushedWeights(_PlanModel):
    """Weights that a learner pushed, as `act.info["policy"]` names them."""

    version: Step = Field(
        description="The version of the weights.",
    )
    fingerprint: str = Field(
        description="The fingerprint of the weights.",
    )


class PolicyConfig(_PlanModel):
    """A policy, its source or address, and the checkpoints to evaluate."""

    name: Name = Field(
        default="policy",
        description="The name in the results. Without it, a policy that is served has the served "
        "policy's name. Two policies of one run have different names.",
    )
    source: str | None = Field(
        default=None,
        description="A registered policy or a deployment file, which `vlagents-ray eval` serves "
        "during the run.",
    )
    url: str | None = Field(
        default=None,
        description="The URL of a running server instead of `source`: `http://gpu-box:8000`, or "
        "`serve://NAME` in this cluster.",
    )
    config: dict[str, JsonValue] = Field(
        default={},
        description="Settings of the policy, which override the settings of a deployment file.",
    )
    options: dict[str, JsonValue] = Field(
        default={},
        description="Options that are passed to every `reset` of the policy.",
    )
    checkpoint: str | None = Field(
        default=None,
        description="The checkpoint to record if the server does not report one.",
    )
    steps: list[Step] = Field(
        default=[],
        max_length=MOST_STEPS_NAMED,
        description="Checkpoints to compare: a list of training steps, or `{first, last, every}`. "
        "Each is loaded with the setting `checkpoint_step`, in place of the one before it, once "
        "the episodes of that one are done. Only for a `source`.",
    )
    pushed_weights: PushedWeights | None = Field(
        default=None,
        description="The weights that the policy must have. They replace the checkpoint in the "
        "results, as `NAME@VERSION`. The run stops if an episode uses other weights.",
    )
    execute: Rows | None = Field(
        default=None,
        description="Number of rows of each action chunk that are executed before the next "
        "request. null: all; in real time and on a robot, as the mode requires.",
    )
    codec: Literal["exact", "raw", "lossless", "jpeg"] = Field(
        default="exact",
        description="Codec of images over a network. `exact` chooses the faster of `raw` and "
        "`lossless`. `jpeg` changes the images slightly.",
    )
    transport: TransportName = Field(
        default="auto",
        description="Transport to the server. `auto`: the fastest that works.",
    )

    @field_validator("steps", mode="before")
    @classmethod
    def _range(cls, steps: object) -> object:
        if not isinstance(steps, dict):
            return steps

        bounds = StepRange.model_validate(steps)
        steps_in_range = range(bounds.first, bounds.last + 1, bounds.every)
        if len(steps_in_range) > MOST_STEPS_NAMED:
            raise ValueError(
                f"expected at most {MOST_STEPS_NAMED} steps, got {len(steps_in_range)}; raise "
                "`every`"
            )
        return list(steps_in_range)

    @field_validator("steps")
    @classmethod
    def _once(cls, steps: list[int]) -> list[int]:
        repeated = sorted({step for step in steps if steps.count(step) > 1})
        if repeated:
            raise ValueError(
                f"expected each step once, got {repeated} twice; remove the repetition"
            )
        return steps

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.steps and self.pushed_weights is not None:
            raise ValueError(
                "expected steps or pushed_weights, got both; leave out one of these, as each names "
                "checkpoints in the results"
            )

        conflicts = sorted({"seed", "env", "contract"} & self.options.keys())
        if conflicts:
            raise ValueError(
                f"options: expected no options that the evaluation sets for each episode, got "
                f"{conflicts}; leave them out"
            )
        return self


class WorkerConfig(_PlanModel):
    """The resources of a worker, and its runtime environment."""

    cpus: Resources = Field(
        default=0.5,
        description="Number of CPUs that Ray reserves for each worker.",
    )
    gpus: Resources = Field(
        default=0.0,
        description="Number of GPUs that Ray reserves for each worker. 0: images are rendered in "
        "software.",
    )
    threads: Annotated[int, Field(ge=1, le=MOST_CPUS)] = Field(
        default=1,
        description="Number of threads of OpenMP, MKL, llvmpipe and similar libraries.",
    )
    runtime_env: dict[str, JsonValue] = Field(
        default={},
        description="Ray's runtime environment, such as `{py_executable: /envs/rcs/bin/python}` "
        "for a simulator with other packages. Its `env_vars` override the thread "
        "settings, and must contain no secrets, as Ray logs them.",
    )

    @field_validator("runtime_env")
    @classmethod
    def _public(cls, runtime_env: dict[str, JsonValue]) -> dict[str, JsonValue]:
        require_no_secrets(runtime_env)
        return runtime_env


class ClockConfig(_PlanModel):
    """Real-time mode: the env's clock runs while the policy computes (see
    `vlagents_ray.evaluate.episode.latency`).
    """

    latency: Literal["measured"] | Latency | Latencies = Field(
        default="measured",
        description="Latency of each answer: `measured`, with the transport; or seconds, with "
        "which an episode is reproducible: a number, or a list, whose numbers the answers of an "
        "episode have in turn, such as a recorded series.",
    )
    mode: Literal["auto", "open_loop", "async"] = Field(
        default="auto",
        description="Mode in which chunks are executed. `open_loop`: the robot stands until the "
        "answer arrives. `async`: it executes the remaining rows of the last chunk, and stands if "
        "there are none. `auto`: chosen for the policy, as for a robot.",
    )
    real_time_chunking: bool = Field(
        default=False,
        description="Send the policy the remaining rows of the last chunk, and the number of "
        "ticks of the delay. Requires `mode: async`.",
    )
    fresh_grip: Rows | None = Field(
        default=FRESH_GRIP,
        description="Age in rows from which the observation of a row is too old to open or close a "
        "gripper: the robot stands and waits for a new answer. It has an effect if answers are as "
        "late. null: the robot never waits.",
    )
    neutral: list[FiniteFloat] | None = Field(
        default=None,
        description="Action before the first answer. null: no motion, with the gripper open at "
        "first.",
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.real_time_chunking and self.mode != "async":
            raise ValueError(
                f"real_time_chunking: expected mode: async with it, got {self.mode}; set the mode"
            )
        return self

    def choice(self, execute: int | None, hz: float | None) -> dict[str, Any]:
        """Return the arguments with which `vlagents_ray.chunking.choice.choose` chooses the mode.

        Args:
            execute: The `execute` of the policy's settings.
            hz: The rate of the environment, 1/s.

        Returns:
            The arguments by name.
        """
        return {
            "mode": self.mode,
            "hz": hz,
            "delay_s": self.latency if isinstance(self.latency, (int, float)) else None,
            "execute": execute,
            "real_time_chunking": self.real_time_chunking,
            "fresh_grip": self.fresh_grip,
        }

    def chosen(self, choice: Choice) -> ClockConfig:
        """Return this clock with the chosen mode in place of `auto`.

        Args:
            choice: The mode that was chosen with the arguments of `choice`.

        Returns:
            The clock.
        """
        chunking = choice.settings.real_time_chunking
        return self.model_copy(update={"mode": choice.mode, "real_time_chunking": chunking})


class StopConfig(_PlanModel):
    """The rule for stopping a case early (see `confidence_sequence`): by `target`, by `width`, or
    by the one that is reached first.
    """

    error_rate: float = Field(
        default=0.05,
        gt=0,
        lt=1,
        description="Error rate of the confidence sequence of each case, over all looks together.",
    )
    target: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="Stop when this success rate is excluded.",
    )
    width: float | None = Field(
        default=None,
        gt=0,
        lt=1,
        description="Stop when the interval is narrower than this.",
    )
    at_least: Count = Field(
        default=1,
        description="Smallest number of episodes of a case.",
    )

    @model_validator(mode="after")
    def _some_end(self) -> Self:
        if self.target is None and self.width is None:
            raise ValueError(
                "expected a target, a width or both, got neither; give at least one of these, as "
                "the first one that is reached ends the case"
            )
        return self


class SuiteConfig(_PlanModel):
    """Environments that are evaluated with the same settings."""

    name: str = Field(
        default="",
        description="The name in the results. An environment may be in two suites with different "
        "names and settings.",
    )
    envs: list[Name] = Field(
        min_length=1,
        description="Names of environments, such as `maniskill/PushCube-v1`, or patterns, such as "
        "`libero/libero_spatial/*`.",
    )
    env_options: dict[str, JsonValue] = Field(
        default={},
        description="Options that are passed to the constructor of the environment.",
    )
    reset_options: dict[str, JsonValue] = Field(
        default={},
        description="Options that are passed to every `reset` of the environment.",
    )
    episodes: Count = Field(
        default=10,
        description="Number of episodes of each environment and seed.",
    )
    seeds: list[Seed] = Field(
        default=[0],
        min_length=1,
        description="Seeds of the first episodes. Episode i uses seed + i.",
    )
    num_envs: Rows = Field(
        default=1,
        description="Number of environments that one worker steps together, with one request for "
        "all. ManiSkill runs them in one simulator on a GPU.",
    )
    worker: WorkerConfig | None = Field(
        default=None,
        description="Resources of the workers of this suite, which replace the run's `worker`.",
    )
    clock: ClockConfig | None = Field(
        default=None,
        description="Settings of the real-time mode. null: the environment waits for the policy.",
    )

    @field_validator("envs")
    @classmethod
    def _distinct(cls, envs: list[str]) -> list[str]:
        repeated = sorted({name for name in envs if envs.count(name) > 1})
        if repeated:
            raise ValueError(
                f"expected each env once, got {repeated} twice; remove the repetition, and raise "
                "`episodes`"
            )
        return envs

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.clock is not None and self.clock.latency == "measured" and self.num_envs > 1:
            raise ValueError(
                f"num_envs: expected 1 with a measured clock.latency, as a batch has only one "
                f"latency, got {self.num_envs}; set 1, or give the latency in seconds"
            )
        for low, high in itertools.pairwise(sorted(self.seeds)):
            if high - low < self.episodes:
                raise ValueError(
                    f"seeds: expected seeds at least {self.episodes} apart, as each runs "
                    f"{self.episodes} episodes, got {low} and {high}, with which some episodes "
                    f"would run twice"
                )
        return self


class TrackingConfig(_PlanModel):
    """The names under which trackers show an evaluation."""

    project: Name = Field(
        default="vlagents-ray",
        description="Name of the project.",
    )
    group: str | None = Field(
        default=None,
        description="Group of runs. null: the name of the folder of results.",
    )
    videos: Annotated[int, Field(ge=0, le=MOST_EPISODES)] = Field(
        default=4,
        description="Number of videos of each case that are uploaded, failures first.",
    )


class RobotTask(_PlanModel):
    """A task of a real robot, which suites name in their `envs`."""

    instruction: Name = Field(
        description="The task in words, for the policy and the operator.",
    )
    setup: str = Field(
        default="",
        description="How the operator sets the scene.",
    )
    max_steps: Count = Field(
        default=600,
        description="Number of control ticks after which a trial ends.",
    )
    rubric: dict[Name, Annotated[float, Field(gt=0, le=1e6)]] = Field(
        default={},
        description="Points for each part of the task, for a partial success.",
    )


class RobotConfig(_PlanModel):
    """The robot of an evaluation, its control loop, and its tasks (see
    `vlagents_ray.evaluate.robot`).
    """

    arm: str | None = Field(
        default=None,
        description="`module:Class` of the robot, or an arm by name. `--robot` sets it. null: the "
        "file runs in simulation.",
    )
    tasks: dict[Name, RobotTask] = Field(
        min_length=1,
        description="The tasks, by the names that suites have in `envs`.",
    )
    key: Annotated[str, Field(min_length=8)] | None = Field(
        default=None,
        description="Key from which the order of the policies is drawn. null: a new key, which is "
        "kept in `trials.key` in the folder of results.",
    )
    hz: Hertz = Field(
        default=10.0,
        description="Control rate.",
    )
    mode: ChosenMode = Field(
        default="auto",
        description="Mode of the chunk player. `auto`: chosen for the policy.",
    )
    deadline_s: Annotated[float, Field(ge=0, le=3600)] | None = Field(
        default=None,
        description="Time for which a tick waits for an action, in seconds. null: 0 in mode "
        "`async`, otherwise 1.",
    )
    max_age_s: Seconds | None = Field(
        default=None,
        description="Largest age, in seconds, of the observation from which an executed action "
        "was computed.",
    )
    safe: Literal["auto", "hold", "zero"] = Field(
        default="auto",
        description="Action at a tick for which the policy has none.",
    )
    max_step: Annotated[float, Field(gt=0, le=1e6)] | None = Field(
        default=None,
        description="Largest change of an action value from one tick to the next.",
    )
    measure: list[str] = Field(
        default=[],
        description="Parts of the state with the measured pose, in the order of an action, such as "
        "`[joints]`.",
    )
    limits: str | None = Field(
        default=None,
        description="File with limits of motion, without the soft start.",
    )
    ignore_mismatch: bool = Field(
        default=False,
        description="Move even if the statistics of the training data do not fit the arm, and log "
        "the misfits.",
    )
    silent_s: Seconds = Field(
        default=2.0,
        description="Silence of the server, in seconds, after which the trial ends. It is "
        "repeated.",
    )


class EvalConfig(_PlanModel):
    """The settings of an evaluation: the policies, the envs, and the folder of results."""

    policies: list[PolicyConfig] = Field(
        min_length=1,
        description="The policies.",
    )
    suites: list[SuiteConfig] = Field(
        min_length=1,
        description="The suites of environments. Every policy runs in every suite.",
    )
    out: Path = Field(
        description="Folder of the results. A run file NAME.yaml without it uses `runs/NAME`.",
    )
    workers: Workers | None = Field(
        default=None,
        description="Number of environments that run in parallel, each in a Ray actor. 0: one "
        "after another in this process, without Ray. null: 0 for a short evaluation, "
        "otherwise 1.",
    )
    video: EpisodeChoice = Field(
        # A video needs the images of each step, whose rendering in software takes two to four times
        # the CPU time of the episode.
        default="none",
        description="Episodes whose video is written, which needs the images of each step.",
    )
    record: EpisodeChoice = Field(
        default="none",
        description="Episodes whose trajectory is written.",
    )
    record_images: RecordedImages = Field(
        default="small",
        description="Images of trajectories: `small`, lossy H.264 as in videos, or `exact`, each "
        "pixel, which browsers cannot show.",
    )
    resume: bool = Field(
        default=False,
        description="Continue the results in `out`.",
    )
    accept_changes: bool = Field(
        default=False,
        description="Continue even if files of the policy or the environment have changed. The "
        "report lists the changes.",
    )
    worker: WorkerConfig = Field(
        default=WorkerConfig(),
        description="Resources of each worker.",
    )
    stop: StopConfig | None = Field(
        default=None,
        description="Rule by which a case stops early. null: every episode runs.",
    )
    track: list[Name] = Field(
        default=[],
        description="Trackers that show rates and videos: `wandb`, `trackio`, `tensorboard`, or "
        "those of a plug-in.",
    )
    tracking: TrackingConfig = Field(
        default=TrackingConfig(),
        description="Names under which trackers show the evaluation.",
    )
    robot: RobotConfig | None = Field(
        default=None,
        description="A real robot and its tasks.",
    )
    retries: Retries = Field(
        default=3,
        description="Number of further attempts at an episode that infrastructure lost.",
    )
    abort_after: Annotated[int, Field(ge=0, le=MOST_EPISODES)] = Field(
        default=10,
        description="Stop after this number of lost episodes, or of errors of policies, in a row. "
        "0: never.",
    )
    make_timeout_s: Seconds = Field(
        default=300.0,
        description="Time limit for creating an environment, with imports and shaders, in seconds.",
    )
    env_timeout_s: Seconds = Field(
        default=60.0,
        description="Time limit of one reset or step of the environment, in seconds.",
    )
    policy_timeout_s: Seconds = Field(
        default=60.0,
        description="Time limit of one call of the policy, in seconds.",
    )
    connect_timeout_s: Seconds = Field(
        default=120.0,
        description="Time limit for connecting to the policy, with a restart of its server, in "
        "seconds.",
    )
    place_timeout_s: Seconds = Field(
        default=120.0,
        description="Time limit until the cluster has resources for a worker, in seconds.",
    )

    @field_validator("policies")
    @classmethod
    def _named_apart(cls, policies: list[PolicyConfig]) -> list[PolicyConfig]:
        names = [policy.name for policy in policies]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ValueError(
                f"policies: expected different names, got {repeated} twice; give each policy a "
                f"different `name`"
            )
        return policies

    @property
    def real_robot(self) -> RobotConfig | None:
        """The robot, if the episodes run on a real robot; otherwise None."""
        return self.robot if self.robot is not None and self.robot.arm is not None else None


def canonical(value: object) -> str:
    """Return JSON with sorted keys and no spaces, so that equal values have equal texts."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def fingerprint(settings: object) -> str:
    """Return 16 hexadecimal digits that identify `settings`."""
    return hashlib.sha256(canonical(settings).encode()).hexdigest()[:16]
