"""Results with all kinds of episodes that become a row of an export."""

from __future__ import annotations

from eval_fakes import LINE, OTHER_LINE
from in_process_evaluation import play

from vlagents_ray.evaluate import EvalConfig, Results
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.jobs import plan_jobs
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.results.store import Store

SETTINGS = {
    "envs": [LINE, OTHER_LINE],
    "episodes": 3,
    "env_options": {"camera": [32, 32]},
    "record": "failures",
}


def with_a_lost_episode(settings: EvalConfig) -> Results:
    """Run two episodes in each of two environments with `SETTINGS`, and record one episode that
    failed for an infrastructure error.
    """
    play(settings, left_out=[2])
    with Store(resolve(settings.model_copy(update={"resume": True}))) as store:
        store.begin_run({})
        key = next(job.key for job in plan_jobs(store.cases) if job.key.episode == 2)
        store.record(
            EpisodeResult(key, "infra_failed", error='env_failed: it hung, "again"'), attempts=4
        )
    return Results.load(settings.out)
