"""The records of an episode and of its worker in the results, and the observer of an episode."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal

import numpy as np

from vlagents_ray.chunking.timeliness import TimeShare
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.interface import POLICY, Act, Obs
from vlagents_ray.ray_tools.git_state import GitState

Status = Literal["done", "policy_error", "infra_failed"]
Ending = Literal["terminated", "truncated", "policy_done", "error"]

_DIGITS = 16  # number of digits of a digest in a key
INIT_STATE = "init_state "  # beginning of the name of a start that the benchmark numbers


@dataclass(frozen=True, slots=True)
class EpisodeResult:
    """The result of an episode. If infrastructure failed, success is None, neither True nor
    False.
    """

    key: EpisodeKey
    status: Status
    success_once: bool | None = None  # the task was solved after some step
    success_at_end: bool | None = None  # the task was solved after the last step
    first_success: int | None = None  # number of steps after which the task was first solved
    steps: int = 0  # number of executed actions
    episode_return: float = 0.0  # sum of rewards
    ending: Ending = "error"
    instruction: str = ""  # the instruction; several instructions are joined with semicolons
    error: str | None = None
    seconds: float = 0.0  # duration from the reset to the last step
    reset_ms: float | None = None  # duration of the environment's reset
    env_step_ms: float | None = None  # median duration of a step
    env_seconds: float | None = None  # duration of the reset and all steps; None on a robot
    acts: int = 0  # number of the policy's answers; with action chunks, fewer than steps
    policy_ms: float | None = None  # median duration of a call of `act`, including transport
    policy_p95_ms: float | None = None
    policy_seconds: float | None = None  # computing time that the policy spent on this episode
    latency_ms: float | None = None  # real-time mode: median latency of an answer
    # real-time mode: number of steps executed between observations and their answers.
    ticks_waited: int = 0
    # The next five fields are the fields of a `TimeShare`. They are None if the environment waits
    # for the policy.
    ticks: int | None = None  # number of ticks that needed an action of the policy
    starved: int | None = None  # number of these ticks without a row of an answer
    age_p50_ms: float | None = None  # median age of the executed actions
    age_p95_ms: float | None = None
    age_p99_ms: float | None = None
    # Medians of the durations in `act.info["timing"]`.
    timing_ms: dict[str, float] = field(default_factory=dict)
    transport: str = "local"
    checkpoint: str | None = None  # name of the checkpoint, from the policy's reset
    weights: str | None = None  # digest of the loaded weights, if the policy reports one
    # The weights' commit on the hub, if they were loaded from the hub's cache.
    revision: str | None = None
    # Version of the weights that computed the last action; 0 is the loaded checkpoint.
    policy_version: int | None = None
    # Fingerprint of that version, which the replica computes from the weights in memory.
    policy_fingerprint: str | None = None
    first_policy_version: int | None = None  # version of the weights that computed the first action
    # Digest of the executed actions, (steps, D) little-endian float32, row by row.
    actions_sha256: str | None = None
    # Name of the initial state. Episodes with equal names begin in the same state (see `start_of`);
    # None on a robot.
    start: str | None = None

    @property
    def time_share(self) -> TimeShare | None:
        """The numbers of ticks with and without an action in time; None if the environment waits
        for the policy.
        """
        if self.ticks is None or self.starved is None:
            return None
        return TimeShare(
            self.ticks, self.starved, self.age_p50_ms, self.age_p95_ms, self.age_p99_ms
        )

    @property
    def full_key(self) -> str:
        """The key, followed by the beginning of the digest of the weights, which is not known
        before the episode.
        """
        digits = (self.weights or "").rpartition(":")[2][:_DIGITS]
        return f"{self.key}~{digits}" if digits else str(self.key)

    @property
    def outcome(self) -> dict[str, Any]:
        """Return the fields that are equal in all runs of one key, i.e. all fields except times and
        transport.
        """
        names = [field.name for field in fields(self) if field.name not in _CIRCUMSTANCES]
        return {name: getattr(self, name) for name in names}


# Fields that may differ between two runs of one key. "weights" is checked separately, and another
# version of the weights would change the actions.
_CIRCUMSTANCES = {
    "seconds",
    "reset_ms",
    "env_step_ms",
    "env_seconds",
    "policy_ms",
    "policy_p95_ms",
    "policy_seconds",
    "timing_ms",
    "transport",
    "weights",
    "revision",
    "policy_version",
    "policy_fingerprint",
    "first_policy_version",
    "start",  # another renderer gives other pictures
}


@dataclass(frozen=True, slots=True)
class EnvInfo:
    """The description of an environment by the worker that made it."""

    described: dict[str, Any]  # `EvalEnv.describe()`
    contract: dict[str, Any]
    code: GitState | None = None  # git state of the environment's code, if git tracks it
    # Digests of the environment's files on the worker's machine.
    program: dict[str, str] | None = None
    host: str = ""


@dataclass(frozen=True, slots=True)
class WorkerInfo:
    """A worker, with one policy and one environment."""

    host: str
    node: str | None  # Ray's node id; None for a process outside Ray
    pid: int
    policy: str  # name of the policy in the evaluation
    transport: str
    renderer: str | None  # the driver's name of the rendering device; None if no device renders


def start_of(obs: Obs, instruction: str, options: Mapping[str, Any] | None) -> str:
    """Return the name of an episode's initial state.

    It is the number of the state, if the environment has a fixed number of states; otherwise the
    beginning of the SHA-256 digest of the instruction and the first observation.

    Args:
        obs: The first observation.
        instruction: The first instruction.
        options: The options of the environment's reset.
    """
    state = (options or {}).get("init_state")
    if isinstance(state, int | np.integer):
        return f"{INIT_STATE}{state}"

    digest = hashlib.sha256(instruction.encode())
    named = [("gripper", obs.gripper), *obs.state.items(), *obs.cameras.items()]
    # Simulators give their whole state in this way.
    named += [(name, value) for name, value in obs.info.items() if isinstance(value, np.ndarray)]
    for name, value in named:
        array = np.ascontiguousarray(0.0 if value is None else value)
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(array.data)
    return digest.hexdigest()[:_DIGITS]


class EpisodeObserver:
    """The callbacks of one episode. This class does nothing; subclasses override some methods."""

    request_info: Mapping[str, Any] = {}  # added to the `Obs.info` of every request to the policy

    def add_instruction(self, instruction: str) -> None:
        """Add the instruction of a task, with which the policy is reset, before its actions."""

    def add_observation(self, obs: Obs) -> None:
        """Add an observation; the first one is the observation of the reset."""

    def add_act(self, act: Act, ticks_waited: int = 0) -> None:
        """Add an answer of the policy; `ticks_waited` other actions are executed before its
        rows.
        """

    def add_action(self, action: np.ndarray, reward: float, success: bool) -> None:
        """Add an executed action, (D,), with its reward and success; the observation after the
        action has already been added.
        """


def version_of(act: Act) -> int | None:
    """Return the version of the weights that chose an action; None if the policy reports no
    version.
    """
    policy = act.info.get(POLICY)
    version = policy.get("version") if isinstance(policy, Mapping) else None
    return int(version) if isinstance(version, int | np.integer) else None
