"""Evaluations that are played in the test's own process, without Ray."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from eval_fakes import ToZero

from vlagents_ray.evaluate import EvalConfig, Results
from vlagents_ray.evaluate.jobs import plan
from vlagents_ray.evaluate.provenance import versions
from vlagents_ray.evaluate.recording import save
from vlagents_ray.evaluate.rollout import Rollout
from vlagents_ray.evaluate.store import Store
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
            if report.made is not None:
                store.note_env(job.cell.place, report.made)
            if report.where is not None:
                store.note_worker(report.where)
            store.record(report.result, job.attempt, *save(config.out, job.cell, report.result, report.kept))
        store.end_run("complete")
    worker.close()
    return Results.load(config.out)
