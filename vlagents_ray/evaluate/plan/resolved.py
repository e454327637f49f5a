"""The plan of an evaluation, of rollouts or of trials, which is resolved once from the
configuration.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from vlagents_ray.errors import ConfigError, MissingDependency
from vlagents_ray.evaluate.plan.cases import EvalCase, plan_cases, require_envs
from vlagents_ray.evaluate.plan.config import (
    EpisodeChoice,
    EvalConfig,
    PolicyConfig,
    RecordedImages,
    StopConfig,
    TrackingConfig,
    WorkerConfig,
)
from vlagents_ray.ray_tools.private import node_of_this_process
from vlagents_ray.registry import env_class, registered_class, require_needs

VARIABLES = "env_vars"  # key of Ray's runtime environment
# Number of planned steps up to which the start of Ray, some seconds, is a large part of the
# duration.
SHORT_STEPS = 10_000
_STEPS = 300  # assumed steps of an episode if the environment's options have no `max_steps`


@dataclass(frozen=True, slots=True)
class TimeLimits:
    """The time limits of calls, in seconds."""

    make_s: float  # creating an env, including imports and shaders
    env_s: float  # one reset or step
    policy_s: float  # one call of the policy's `reset` or `act`
    connect_s: float  # connecting to the policy, including a restart of its server
    place_s: float  # until the cluster has resources for a worker

    def of_phase(self, phase: str) -> float:
        """Return the limit of a phase of an episode (`Phase`), s."""
        if phase == "connect":
            return self.connect_s + self.policy_s
        if phase == "make":
            return self.make_s
        return self.policy_s if phase.startswith("policy") else self.env_s


@dataclass(frozen=True, slots=True)
class ResolvedPlan:
    """All decisions that are made before the first episode; only `resolve` creates a plan.

    All code that runs, records or shows the episodes uses this plan, and resolves nothing again.
    """

    # Each case contains its policy, checkpoint, environment, seeds, worker settings and
    # fingerprint.
    cases: tuple[EvalCase, ...]
    # Number of Ray actors, each with an environment; 0: the episodes run in this process without
    # Ray.
    workers: int
    limits: TimeLimits
    retries: int  # number of further attempts at an episode after an infrastructure failure
    # Number of lost episodes, or of policy errors, in a row that ends the run; 0: no limit.
    abort_after: int
    video: EpisodeChoice
    record: EpisodeChoice
    record_images: RecordedImages
    stop: StopConfig | None  # the rule for stopping a case early
    trackers: Mapping[str, type[Any]]  # the classes of the trackers, by name
    tracking: TrackingConfig
    out: Path  # the folder of results
    resume: bool
    accept_changes: bool
    # For the record of the run, and for the plans of later steps of a training.
    settings: EvalConfig

    @property
    def policies(self) -> list[PolicyConfig]:
        """The policies of the cases."""
        return list({case.policy.name: case.policy for case in self.cases}.values())


def resolve(config: EvalConfig, workers: int | None = None) -> ResolvedPlan:
    """Return the plan of a configuration whose policies have their names and addresses.

    Args:
        config: The configuration.
        workers: The number of workers, if it is already decided; None: `chosen_workers`. Trials on
            a robot need no workers.

    Returns:
        The plan, whose workers are decided and whose envs and trackers are known.

    Raises:
        ConfigError: Two cases are equal, an env rejects its options, a tracker is not registered,
            or `config.workers` is 0 although the evaluation needs Ray.
        MissingDependency: The package of a tracker is not installed.
        UnknownEnv: An env is unknown.
    """
    cases = tuple(plan_cases(config))
    require_envs(cases)
    settings = config
    if config.real_robot is not None:  # trials run in this process
        workers = 0
    else:
        workers = chosen_workers(config, cases) if workers is None else workers
        settings = config.model_copy(update={"workers": workers})

    limits = TimeLimits(
        make_s=config.make_timeout_s,
        env_s=config.env_timeout_s,
        policy_s=config.policy_timeout_s,
        connect_s=config.connect_timeout_s,
        place_s=config.place_timeout_s,
    )
    return ResolvedPlan(
        cases=cases,
        workers=workers,
        limits=limits,
        retries=config.retries,
        abort_after=config.abort_after,
        video=config.video,
        record=config.record,
        record_images=config.record_images,
        stop=config.stop,
        trackers=_tracker_classes(config.track),
        tracking=config.tracking,
        out=config.out,
        resume=config.resume,
        accept_changes=config.accept_changes,
        settings=settings,
    )


def chosen_workers(config: EvalConfig, cases: Sequence[EvalCase]) -> int:
    """Return `config.workers`. If it is None, return 0 for a short evaluation that needs no Ray,
    otherwise 1.

    A single worker runs one episode after another, like this process, but Ray adds its start-up
    time and a message to each call of the policy. In return, Ray replaces a simulator that crashes
    or hangs, which a long evaluation needs. Ray is also chosen if this process is in a cluster or
    `RAY_ADDRESS` names one, and for workers with a GPU.

    Args:
        config: The configuration; its policies need not be resolved.
        cases: Its cases.

    Raises:
        ConfigError: `config.workers` is 0, although the evaluation needs Ray.
    """
    reasons = _reasons_for_ray(config, cases)
    if config.workers == 0 and reasons:
        raise ConfigError(
            f"workers: expected 1 or more, as {reasons[0]}, got 0, which runs the episodes in "
            "this process without Ray; raise it"
        )
    if config.workers is not None:
        return config.workers

    is_in_cluster = may_use_cluster()
    needs_gpu = any(case.worker.gpus for case in cases)
    steps = 0
    for case in cases:
        limit = case.suite.env_options.get("max_steps")
        steps += case.planned * (limit if isinstance(limit, int) else _STEPS)
    return 1 if reasons or is_in_cluster or needs_gpu or steps > SHORT_STEPS else 0


def require_installed(cases: Iterable[EvalCase]) -> None:
    """Check that this Python has the simulators of the cases whose workers use it, before anything
    starts.

    Raises:
        MissingDependency: A package of a simulator is not installed; the message has the cure.
    """
    for case in cases:
        if case.robot is not None or _may_use_other_packages(case.worker):
            continue
        reason = env_class(case.env).not_installed()
        if reason is not None:
            raise MissingDependency(f"env {case.env!r} cannot run here: {reason}")


def _may_use_other_packages(worker: WorkerConfig) -> bool:
    """Return whether a worker may have other packages than this process."""
    variables = worker.runtime_env.get(VARIABLES)
    has_path = isinstance(variables, Mapping) and "PYTHONPATH" in variables
    return has_path or bool(worker.runtime_env.keys() - {VARIABLES})


def may_use_cluster() -> bool:
    """Return whether Ray would join a running cluster, whose nodes may differ from this one."""
    return node_of_this_process() is not None or bool(os.environ.get("RAY_ADDRESS"))


def _reasons_for_ray(config: EvalConfig, cases: Sequence[EvalCase]) -> list[str]:
    """Return the reasons why the evaluation needs Ray."""
    reasons = []
    for policy in config.policies:
        for url in (policy.url, policy.source):
            if url and url.startswith("serve://"):
                reasons.append(f"{url} is inside a Ray cluster")

    settings: set[str] = set()
    for case in cases:
        settings |= case.worker.runtime_env.keys()
    reasons += [f"a worker's runtime_env has {name!r}" for name in sorted(settings - {VARIABLES})]
    return reasons


def _tracker_classes(names: Sequence[str]) -> Mapping[str, type[Any]]:
    """Return the classes of trackers by name; each name is registered or "module:Class"."""
    classes = {}
    for name in names:
        classes[name] = registered_class("trackers", name)
        require_needs("trackers", name)
    return MappingProxyType(classes)
