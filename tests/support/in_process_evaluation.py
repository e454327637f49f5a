"""Evaluations that run in the test's process, without Ray."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from eval_fakes import ToZero

from vlagents_ray.evaluate import EvalConfig, Results
from vlagents_ray.evaluate.artifacts.recorder import Recording, save
from vlagents_ray.evaluate.artifacts.storage import versions
from vlagents_ray.evaluate.plan.jobs import plan_jobs
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.results.store import Store
from vlagents_ray.evaluate.workers.rollout import AgentFactory, Rollout
from vlagents_ray.interface import Agent


def rollout_by(config: EvalConfig, agents: AgentFactory) -> Rollout:
    """Return the code of a worker that records videos and trajectories as these settings
    require.
    """
    recorders = partial(Recording, config.video, config.record, images=config.record_images)
    return Rollout(agents, recorders)


def play(
    config: EvalConfig, make: Callable[[], Agent] = ToZero, *, left_out: Iterable[int] = ()
) -> Results:
    """Run the episodes of the plan one after another, except those with the numbers in `left_out`;
    return the results.
    """
    worker = rollout_by(config, lambda _policy: make())
    with Store(resolve(config)) as store:
        store.begin_run(versions())
        finished = store.finished()
        for job in plan_jobs(store.cases):
            if str(job.key) in finished or job.key.episode in left_out:
                continue
            [report] = worker.run((job,))
            assert report.result is not None, report.failure
            if report.policy is not None:
                store.note_policy(job.case.policy.name, report.policy)
            if report.env is not None:
                store.note_env(job.case.place, report.env)
            if report.worker is not None:
                store.note_worker(report.worker)
            store.record(
                report.result,
                job.attempt,
                *save(config.out, job.case, report.result, report.artifacts),
            )
        store.end_run("complete")
    worker.close()
    return Results.load(config.out)


_POLICY = {
    "policy": "name",
    "policy_url": "url",
    "policy_config": "config",
    "policy_options": "options",
    "checkpoint": "checkpoint",
    "steps": "steps",
    "execute": "execute",
    "codec": "codec",
    "transport": "transport",
}
_SUITE = {
    name: name
    for name in ("envs", "env_options", "reset_options", "episodes", "seeds", "num_envs", "clock")
}
_WORKER = {
    "cpus_per_worker": "cpus",
    "gpus_per_worker": "gpus",
    "threads": "threads",
    "runtime_env": "runtime_env",
}


def flat_config(**settings: Any) -> EvalConfig:
    """Return an evaluation of one policy in one suite, from flat settings; `seed` is the
    only seed.
    """
    if "seed" in settings:
        settings = settings | {"seeds": [settings["seed"]]}
        del settings["seed"]
    policy, suite, worker = (
        {one[k]: v for k, v in settings.items() if k in one} for one in (_POLICY, _SUITE, _WORKER)
    )
    rest = {k: v for k, v in settings.items() if k not in _POLICY | _SUITE | _WORKER}
    return EvalConfig.model_validate(
        {"policies": [policy], "suites": [suite], "worker": worker, **rest}
    )
