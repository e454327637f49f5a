"""Folders of results in the form in which an evaluation writes them, without running episodes, for
tests of readers of results.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from eval_fakes import LINE, OTHER_LINE

from vlagents_ray.evaluate import EvalConfig, Results
from vlagents_ray.evaluate.artifacts.recorder import VideoRecorder, save_videos
from vlagents_ray.evaluate.artifacts.storage import versions
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.episode.records import EnvInfo, EpisodeResult, WorkerInfo
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.jobs import Job, plan_jobs
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.results.store import Store
from vlagents_ray.interface import Obs

HOSTILE = "</script><img src=x onerror=alert(1)>\"'&"
TIMING = {
    "decode_ms": 0.2,
    "queue_ms": 1.0,
    "inference_ms": 20.0,
    "encode_ms": 0.1,
    "wire_ms": 2.0,
    "total_ms": 21.5,
}

# Maps (case, seed) to the step in which the episode was solved; None if it was not solved.
Outcome = Callable[[EvalCase, int], int | None]


def runs(
    out: Path, *, episodes: int = 12, steps: list[int] | None = None, **changes: Any
) -> EvalConfig:
    """Return settings with two policies, one of them a sweep over steps, in two suites."""
    policies = [
        {
            "name": "learner",
            "url": "http://localhost:1",
            "steps": [1000, 2000] if steps is None else steps,
        },
        {"name": "base", "url": "http://localhost:2"},
    ]
    suites = [
        {"name": "one", "envs": [LINE, OTHER_LINE], "episodes": episodes},
        {"name": "two", "envs": [LINE], "env_options": {"camera": [32, 48]}, "episodes": episodes},
    ]
    return EvalConfig.model_validate({"policies": policies, "suites": suites, "out": out} | changes)


def better_later(case: EvalCase, seed: int) -> int | None:
    """Return an outcome whose probability of success increases with the training step; the base
    policy succeeds in every fourth episode.
    """
    chance = 0.25 if case.step is None else case.step / 2500
    drawn = np.random.default_rng([seed, len(case.env)]).uniform()
    return 10 + seed % 60 if drawn < chance else None


def record(
    config: EvalConfig,
    outcome: Outcome = better_later,
    *,
    videos: bool = False,
    troubles: bool = False,
) -> Results:
    """Record every episode of `config`. With `troubles`, the first episode ends with an error of
    the policy, and the second is lost.

    With `videos`, failed episodes have videos, or all episodes if `config.video` is "all".
    """
    with Store(resolve(config)) as store:
        store.begin_run(versions())
        jobs = plan_jobs(store.cases)
        shown = config.video == "all"
        for job in jobs:
            result = _result(job, outcome(job.case, job.key.seed))
            paths = save_videos(
                config.out,
                job.case,
                result,
                _video() if videos and (shown or not result.success_once) else {},
            )
            if troubles and job in (jobs[0], jobs[1]):
                _trouble(store, job, lost=job == jobs[1])
            else:
                store.record(result, 1, paths)
        for place in {case.place for case in store.cases}:
            described = {
                "simulator": "line",
                "protocol": {"init_states": 50, "settle_steps": 10, "word": HOSTILE},
            }
            store.note_env(place, EnvInfo(described, {"action": {"dim": 1}}))
        for policy in config.policies:
            store.note_policy(policy.name, {"policy": policy.name, "checkpoint": None})
            for pid in (1, 1, 2):
                store.note_worker(
                    WorkerInfo("gpu-box", None, pid, policy.name, "handle", f"llvmpipe {HOSTILE}")
                )
        store.end_run("complete")
    return Results.load(config.out)


def _result(job: Job, solved: int | None) -> EpisodeResult:
    return EpisodeResult(
        job.key,
        "done",
        solved is not None,
        solved is not None,
        solved,
        steps=80,
        episode_return=float(solved is None),
        ending="truncated",
        instruction=f"go {HOSTILE}",
        seconds=2.0,
        reset_ms=5.0,
        env_step_ms=1.5,
        acts=80,
        policy_ms=23.4,
        policy_p95_ms=30.0,
        timing_ms=TIMING,
        transport="http",
    )


def _trouble(store: Store, job: Job, *, lost: bool) -> None:
    failure = Failure("worker", "env_failed", f"the simulator {HOSTILE}", "Traceback …\n  line 7\n")
    store.record_attempt(job, failure, retried=not lost)
    if lost:
        store.record(EpisodeResult(job.key, "infra_failed", error="hung"), 4)
    else:
        store.record(
            EpisodeResult(job.key, "policy_error", False, False, error=f"policy_failed: {HOSTILE}"),
            2,
        )


def _video() -> dict[str, bytes]:
    with closing(VideoRecorder(10.0)) as recorder:
        for shade in range(0, 250, 50):
            recorder.add_observation(Obs(cameras={"front": np.full((32, 48, 3), shade, np.uint8)}))
        return recorder.finish()
