"""The plan of an evaluation, of rollouts or of trials, resolved once from its configuration."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.plan.cases import EvalCase, plan_cases, require_envs
from vlagents_ray.evaluate.plan.config import (
    EpisodeChoice,
    EvalConfig,
    PolicyConfig,
    RecordedImages,
    StopConfig,
    TrackingConfig,
)
from vlagents_ray.ray_tools.private import node_of_this_process
from vlagents_ray.registry import registered_class, require_needs

VARIABLES = "env_vars"  # in Ray's runtime environment
# Planned steps up to which Ray's start, some seconds, is a large part of the time.
SHORT_STEPS = 10_000
_STEPS = 300  # of an episode, if the options of its environment name no `max_steps`


@dataclass(frozen=True, slots=True)
class TimeLimits:
    """The times after which a call is given up, in seconds."""

    make_s: float  # making an env, imports and shaders included
    env_s: float  # one reset or step
    policy_s: float  # one reset or act of the policy
    connect_s: float  # reaching the policy, a restart of its server included
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
    """Everything that is decided before the first episode; only `resolve` makes it.

    All code that runs, records or shows the episodes uses this value, and resolves nothing again.
    """

    # Each has its policy, checkpoint, environment, seeds, worker settings and fingerprint.
    cases: tuple[EvalCase, ...]
    # Ray actors, each with an environment; with 0, the episodes run in this process without Ray.
    workers: int
    limits: TimeLimits
    retries: int  # further attempts at an episode after an infrastructure failure
    # Lost episodes, or errors of policies, in a row that end everything; 0: no number of them does.
    abort_after: int
    video: EpisodeChoice
    record: EpisodeChoice
    record_images: RecordedImages
    stop: StopConfig | None  # the rule by which a case stops early
    trackers: Mapping[str, type[Any]]  # the classes of the trackers, by name
    tracking: TrackingConfig
    out: Path  # folder of the results
    resume: bool
    accept_changes: bool
    settings: EvalConfig  # for the record of the run, and for the plan of a training's next steps

    @property
    def policies(self) -> list[PolicyConfig]:
        """The policies of the cases."""
        return list({case.policy.name: case.policy for case in self.cases}.values())


def resolve(config: EvalConfig, workers: int | None = None) -> ResolvedPlan:
    """Return the plan of a configuration whose policies have their names and addresses.

    Args:
        config: The configuration.
        workers: The number of workers, where it is decided already; None: `chosen_workers`. A
            robot's trials need none.

    Returns:
        The plan, whose workers are decided and whose envs and trackers are known.

    Raises:
        ConfigError: Two cases are the same, an env does not take its options, a tracker is not
            registered, or `config.workers` is 0 and something needs Ray.
        MissingDependency: The package of a tracker is not installed.
        UnknownEnv: There is no such env.
    """
    cases = tuple(plan_cases(config))
    require_envs(cases)
    settings = config
    if config.real_robot is not None:  # its trials run in this process
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
    """Return `config.workers` or, if that is None, 0 for a short evaluation that needs no Ray, else
    1.

    A single worker runs one episode after another, as this process does, so that Ray adds its
    start and a message to each call of the policy. In return, a simulator that crashes or hangs is
    replaced, which a long evaluation needs. Ray is also chosen if this process is in a cluster or
    `RAY_ADDRESS` names one, and for workers with a GPU.

    Args:
        config: The configuration; its policies need not be resolved.
        cases: Its cases.

    Raises:
        ConfigError: `config.workers` is 0, and something needs Ray.
    """
    reasons = _reasons_for_ray(config, cases)
    if config.workers == 0 and reasons:
        raise ConfigError(
            f"workers: expected 1 or more, as {reasons[0]}, got 0, which runs the episodes in "
            "this process without Ray; raise it"
        )
    if config.workers is not None:
        return config.workers

    is_in_cluster = node_of_this_process() is not None or bool(os.environ.get("RAY_ADDRESS"))
    needs_gpu = any(case.worker.gpus for case in cases)
    steps = 0
    for case in cases:
        limit = case.suite.env_options.get("max_steps")
        steps += case.planned * (limit if isinstance(limit, int) else _STEPS)
    return 1 if reasons or is_in_cluster or needs_gpu or steps > SHORT_STEPS else 0


def _reasons_for_ray(config: EvalConfig, cases: Sequence[EvalCase]) -> list[str]:
    """Return why the evaluation cannot run without Ray, one reason an entry."""
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
    """Return the classes of trackers, each registered or given as "module:Class", by name."""
    classes = {}
    for name in names:
        classes[name] = registered_class("trackers", name)
        require_needs("trackers", name)
    return MappingProxyType(classes)
