"""A driver of many workers looks at all of them in each turn: one turn takes all that has come."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import ray
from eval_fakes import ToZero, wait_for

from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.evaluate.plan.cases import cells
from vlagents_ray.evaluate.plan.jobs import plan
from vlagents_ray.evaluate.workers.pool import WorkerPool


@pytest.mark.usefixtures("shared_ray")
def test_reports_that_have_come_are_taken_in_one_turn(config: Callable[..., EvalConfig]) -> None:
    settings = config(workers=2)
    jobs = plan(cells(settings))
    with WorkerPool(settings, lambda _: ToZero()) as pool:
        for job in jobs[:2]:
            pool.start(job.cell)
        wait_for(lambda: not list(pool.wait(0.1)) and len(pool.idle()) == 2)
        busy = pool.idle()
        for worker, job in zip(busy, jobs, strict=False):
            pool.dispatch(worker, (job,))
        done, _ = ray.wait([worker.running for worker in busy], num_returns=2, timeout=60)
        assert len(done) == 2
        assert {job.key for job, _ in pool.wait(10)} == {job.key for job in jobs[:2]}
