"""An evaluation's results depend only on its plan, not on the way it is run."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from in_process_evaluation import flat_config
from ray_processes import words

from tests.integration.conftest import serving
from vlagents_ray.evaluate import EvalConfig, EvaluationInterrupted, Progress, Results, evaluate
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.serve.launch.server import Server

pytestmark = pytest.mark.slow

EPISODES = 16


def plan(out: Path, url: str, **running: Any) -> EvalConfig:
    return flat_config(
        envs=["tabletop/slide", "tabletop/lift"],
        env_options={"width": 64, "height": 64, "max_steps": 29},
        episodes=EPISODES,
        policy="hesitant",
        policy_url=url,
        out=out,
        video="none",
        **running,
    )


def outcomes(out: Path) -> dict[tuple[str, int], tuple[Any, ...]]:
    """Return all results of each episode except times and transports, by environment and number."""
    found = [one.result for case in Results.load(out).cases for one in case.episodes]
    assert len({(one.key.env, one.key.episode) for one in found}) == len(found) == 2 * EPISODES
    return {
        (one.key.env, one.key.episode): (
            one.status,
            one.success_once,
            one.success_at_end,
            one.first_success,
            one.steps,
            one.episode_return,
            one.ending,
            one.instruction,
            one.actions_sha256,
        )
        for one in found
    }


class Disaster(Progress):
    """Kills all workers after every eighth episode, and interrupts the evaluation after
    `interrupted_after` episodes.
    """

    def __init__(self, interrupted_after: int | None = None) -> None:
        self.played = 0
        self.interrupted_after = interrupted_after

    def episode(self, case: EvalCase, result: EpisodeResult) -> None:
        self.played += 1
        if self.played % 8 == 0:
            for process in psutil.Process().children(recursive=True):
                if any("Rollout" in word for word in words(process)):
                    with contextlib.suppress(psutil.NoSuchProcess):
                        process.kill()
        if self.played == self.interrupted_after:
            signal.raise_signal(signal.SIGINT)


@pytest.fixture(scope="module")
def alone(
    shared_ray: None, tmp_path_factory: pytest.TempPathFactory
) -> dict[tuple[str, int], tuple[Any, ...]]:
    """Return the outcomes with one worker and one replica without batching."""
    out = tmp_path_factory.mktemp("alone")
    with serving("served_agents:Hesitant", batch={"max_size": 1}) as server:
        evaluate(plan(out, server.url, workers=1))
    found = outcomes(out)
    assert {row[1] for row in found.values()} == {True, False}, (
        "both outcomes must occur for the test to be meaningful"
    )
    return found


@pytest.fixture(scope="module")
def server(
    shared_ray: None, alone: dict[Any, Any], request: pytest.FixtureRequest
) -> Iterator[Server]:
    """Run a server with the requested number of replicas, for all tests with this number."""
    with serving("served_agents:Hesitant", batch={"max_size": 8}, replicas=request.param) as server:
        yield server


@pytest.mark.parametrize("server", [1], indirect=True)
def test_killed_workers_and_a_resumption_change_no_result(
    alone: dict[Any, Any], tmp_path: Path, server: Server
) -> None:
    with pytest.raises(EvaluationInterrupted):
        evaluate(plan(tmp_path, server.url, workers=2, retries=20), progress=Disaster(EPISODES))
    summary = evaluate(
        plan(tmp_path, server.url, workers=2, retries=20, resume=True), progress=Disaster()
    )
    assert summary.total.retries > 0
    assert outcomes(tmp_path) == alone


@pytest.mark.parametrize(
    ("server", "workers", "num_envs"), [(1, 2, 5), (2, 4, 1)], indirect=["server"]
)
def test_workers_batches_replicas_and_envs_side_by_side_change_no_result(
    alone: dict[Any, Any], tmp_path: Path, server: Server, workers: int, num_envs: int
) -> None:
    evaluate(plan(tmp_path, server.url, workers=workers, num_envs=num_envs))
    assert outcomes(tmp_path) == alone
