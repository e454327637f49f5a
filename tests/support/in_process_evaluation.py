"""Evaluations that run in the test's process, without Ray."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from eval_fakes import ToZero

from vlagents_ray.evaluate import EvalConfig, Results
from vlagents_ray.evaluate.artifacts.recorder import save
from vlagents_ray.evaluate.artifacts.storage import versions
from vlagents_ray.evaluate.plan.jobs import plan
from vlagents_ray.evaluate.results.store import Store
from vlagents_ray.evaluate.workers.rollout import Rollout
from vlagents_ray.interface import Agent


def play(config: EvalConfig, make: Callable[[], Agent] = ToZero, *, left_out: Iterable[int] = ()) -> Results:
    """Play the plan, apart from the episodes of those numbers, one after another."""
    worker = Rollout(config, lambda _policy: make())
    with Store(config) as store:
        store.begin_run(config, versions())
        finished = store.finished()
        for job in plan(store.cells):
            if str(job.key) in finished or job.key.episode in left_out:
                continue
            [report] = worker.run((job,))
            assert report.result is not None, report.failure
            if report.policy is not None:
                store.note_policy(job.cell.policy.name, report.policy)
            if report.env is not None:
                store.note_env(job.cell.place, report.env)
            if report.worker is not None:
                store.note_worker(report.worker)
            store.record(report.result, job.attempt, *save(config.out, job.cell, report.result, report.artifacts))
        store.end_run("complete")
    worker.close()
    return Results.load(config.out)
