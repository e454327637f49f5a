"""`vlagents-ray eval FILE --watch DIR`: evaluate each new checkpoint of a training run that goes on."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

from vlagents_ray.cli.console import out
from vlagents_ray.cli.doctor.listing import require_packages
from vlagents_ray.cli.evaluation.policies import policy_deployment, resolve_policies, served
from vlagents_ray.cli.evaluation.run import evaluate_and_print, require_results, shown_progress
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig, PolicyConfig
from vlagents_ray.evaluate.checkpoint_watcher import CheckpointWatcher, rounds
from vlagents_ray.evaluate.results.database import FILE
from vlagents_ray.evaluate.workers.cluster import ray_cluster
from vlagents_ray.policies.base.checkpoint import STEP
from vlagents_ray.serve.launch.deployment_file import own_settings
from vlagents_ray.serve.models.checkpoints import CHOICE

LOOK_S = 1.0  # between two looks at the folder


def watch_training(
    config: EvalConfig,
    folder: Path,
    address: str | None = None,
    *,
    until: int | None = None,
    settle_s: float = 10.0,
    marker: str | None = None,
    live: tuple[str, int] | None = None,
) -> None:
    """Evaluate each step of the one policy whose checkpoint holds `{step}` once it is whole.

    All go into one folder, and one server stays up for them. Policies without `{step}` are evaluated in the first
    round. `live` is the address of the live page, as for `live_progress`. Ends as `rounds` does, or by Ctrl-C; to go
    on, resume. An episode without a result ends the command with status 1, after the last round.
    """
    place, pattern = _watched(config)
    if (config.out / FILE).is_file() and not config.resume:  # said now, not when the first checkpoint is there
        raise ConfigError(f"{config.out} already has results: resume them (--resume), or choose another out folder")
    if address is None:
        for part in resolve_policies(_at(config, place, [0]), ask=False)[1].values():
            require_packages(part)
    watcher = CheckpointWatcher(pattern, folder, settle_s=settle_s, marker=marker)
    shown: dict[int, str] = {}

    def pause() -> None:
        for step, why in watcher.waiting().items():
            if shown.get(step) != why:
                shown[step] = why
                out.print(f"step {step}: not yet: {why}")
        threading.Event().wait(LOOK_S)

    out.print(f"watching {watcher.folder}{'' if watcher.folder.is_dir() else ', which is not there yet'}")
    found = rounds(watcher, until, pause)
    first = next(found, None)
    if first is None:
        raise ConfigError(f"{watcher.folder}: watching ended without a checkpoint; still waiting: {watcher.waiting()}")
    with (
        served(_at(config, place, first), address) as ready,
        ray_cluster(ready),
        shown_progress(ready, live, goes_on=True) as progress,
    ):
        summary = evaluate_and_print(ready, progress)
        every = [*first]
        for steps in found:
            every += steps
            summary = evaluate_and_print(_at(ready, place, steps).model_copy(update={"resume": True}), progress)
    require_results(_at(ready, place, every), summary)


def _watched(config: EvalConfig) -> tuple[int, str]:
    """Find the index of the policy that is trained, and the pattern of its checkpoints."""
    found = {place: pattern for place, one in enumerate(config.policies) if (pattern := _pattern(one)) is not None}
    if len(found) != 1:
        raise ConfigError(
            f"--watch: got {STEP} in the checkpoints of {len(found)} policies, want it in that of one, such as "
            f"checkpoint: /runs/a/{STEP}"
        )
    [(place, pattern)] = found.items()
    if config.policies[place].steps:
        raise ConfigError(f"policy {config.policies[place].name!r}: --watch finds its steps; leave `steps` out")
    return place, pattern


def _pattern(policy: PolicyConfig) -> str | None:
    settings: dict[str, Any] = {CHOICE: policy.checkpoint}
    if policy.source is not None and "://" not in policy.source:
        settings |= own_settings(policy_deployment(policy, policy.source, step_follows=True).applications[0])
    checkpoint = settings[CHOICE]
    return checkpoint if isinstance(checkpoint, str) and STEP in checkpoint else None


def _at(config: EvalConfig, place: int, steps: list[int]) -> EvalConfig:
    policies = list(config.policies)
    policies[place] = policies[place].model_copy(update={"steps": steps})
    return config.model_copy(update={"policies": policies})
