"""An estimate of the episodes that an evaluation has left, and of the time that they take."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Literal

import numpy as np
import ray
from ray.exceptions import RayError

from vlagents_ray.chunking.fallback import neutral
from vlagents_ray.envs import make_env
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.evaluate.episode.failures import env_side
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.config import EvalConfig
from vlagents_ray.evaluate.plan.jobs import plan
from vlagents_ray.evaluate.results.reader import CellResults, Results
from vlagents_ray.evaluate.workers.cluster import ray_cluster, runtime_env
from vlagents_ray.interface import Act

STEPS = 10  # env steps that are timed

Basis = Literal["results", "measured", "unknown"]


@dataclass(frozen=True, slots=True)
class Forecast:
    """The estimate for one cell."""

    cell: EvalCase
    finished: int  # episodes, among those that are planned
    left: int  # episodes that would be played; fewer than the rest where the cell has stopped early
    seconds: float | None = None  # of one episode
    basis: Basis = "unknown"  # "results": the mean of earlier episodes; "measured": at most, and without the policy
    why: str = ""  # the reason for which it is unknown


def forecasts(config: EvalConfig, cells: Sequence[EvalCase], results: Results | None) -> list[Forecast]:
    """Estimate each cell, in their order. An env without an earlier duration in `results` is timed in a Ray task."""
    earlier = results.cells if results is not None else ()
    seconds = {cell.fingerprint: _earlier_seconds(cell, earlier) for cell in cells}
    measured: dict[str, float | str] = {}
    if unknown := {cell.place: cell for cell in cells if seconds[cell.fingerprint] is None}:
        with ray_cluster(config):
            measured = {place: _measured(cell, config.make_timeout_s) for place, cell in unknown.items()}
    found = []
    for cell in cells:
        finished, left = _progress(cell, earlier)
        known = seconds[cell.fingerprint]
        if known is not None:
            found.append(Forecast(cell, finished, left, known, "results"))
        elif isinstance(at_most := measured[cell.place], str):
            found.append(Forecast(cell, finished, left, why=at_most))
        else:
            found.append(Forecast(cell, finished, left, at_most, "measured"))
    return found


def longest_episode(env: str, env_options: Mapping[str, Any], reset_options: Mapping[str, Any]) -> float | str:
    """The longest duration of an episode, in s, with a policy that takes no time; or why it cannot be measured.

    The env is made, reset, and stepped 10 times with an action that moves nothing.
    """
    try:
        with env_side(f"{env!r}"), make_env(env, **env_options) as made:
            begun = perf_counter()
            begin = {} if made.init_states is None else {"init_state": 0}
            made.reset(seed=0, options=begin | dict(reset_options) or None)
            reset_s = perf_counter() - begun
            steps_s = []
            for _ in range(min(STEPS, made.max_steps)):
                begun = perf_counter()
                made.step(Act(neutral(made.contract.action)))
                steps_s.append(perf_counter() - begun)
            return reset_s + made.max_steps * float(np.median(steps_s))
    except VLAgentsError as error:
        return str(error)


def _measured(cell: EvalCase, timeout_s: float) -> float | str:
    options = {"num_cpus": cell.worker.cpus, "num_gpus": cell.worker.gpus, "runtime_env": runtime_env(cell)}
    task = ray.remote(longest_episode).options(max_retries=0, **options)
    try:
        found: float | str = ray.get(
            task.remote(cell.env, cell.suite.env_options, cell.suite.reset_options), timeout=timeout_s
        )
    except RayError as error:
        return str(error).strip().partition("\n")[0]
    return found


def _earlier_seconds(cell: EvalCase, earlier: Sequence[CellResults]) -> float | None:
    """The mean duration of an episode of this policy in this env, in s, over all its checkpoints."""
    alike = [
        episode.seconds
        for one in earlier
        if one.policy == cell.policy.name and one.env == cell.env
        for episode in one.counted
    ]
    return float(np.mean(alike)) if alike else None


def _progress(cell: EvalCase, earlier: Sequence[CellResults]) -> tuple[int, int]:
    """(finished, left) episodes of a cell."""
    same = next((one for one in earlier if (one.contender, one.suite, one.env) == cell.name), None)
    if same is None:
        return 0, cell.planned
    done = {
        (one.result.key.episode, one.result.key.seed) for one in same.episodes if one.result.status != "infra_failed"
    }
    finished = sum((job.key.episode, job.key.seed) in done for job in plan([cell]))
    return finished, 0 if same.stopped_at is not None else cell.planned - finished
