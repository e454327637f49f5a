"""The information of workers about their node, in a cluster that claims to have a GPU."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator

import pytest
import ray
from eval_fakes import ToZero

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig, Results, evaluate
from vlagents_ray.ray_tools.session import joined

Config = Callable[..., EvalConfig]

DRAWN = "rendered_env:Drawn"
pytestmark = pytest.mark.ray


@pytest.fixture(scope="module", autouse=True)
def cluster() -> Iterator[str]:
    """Start Ray, and return Ray's id of this node."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
        with joined("local", num_cpus=2, num_gpus=1, logging_level="ERROR"):
            yield ray.get_runtime_context().get_node_id()


def test_results_say_where_each_worker_ran_and_what_drew(config: Config, cluster: str) -> None:
    settings = config(envs=[DRAWN], episodes=2, workers=1)
    evaluate(settings, agent_factory=ToZero)
    [worker] = Results.load(settings.out).workers
    assert (worker.run, worker.host, worker.node) == (1, os.uname().nodename, cluster)
    assert (worker.policy, worker.transport, worker.renderer) == (
        "policy",
        "local",
        "llvmpipe (LLVM 15.0.6, 256 bits)",
    )


def test_drawing_in_software_beside_gpus_is_told_once(
    config: Config, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "vlagents_ray"):
        evaluate(config(envs=[DRAWN], episodes=4, workers=2), agent_factory=ToZero)
    [said] = [one.message for one in caplog.records if "the cluster has 1" in one.message]
    assert "worker: {gpus: 0.25}" in said


def test_a_worker_that_was_given_a_gpu_and_draws_elsewhere_stops_the_evaluation(
    config: Config,
) -> None:
    settings = config(envs=[DRAWN], episodes=2, workers=1, gpus_per_worker=0.5)
    with pytest.raises(
        ConfigError,
        match=r"the GPU 0 is assigned to the worker, but its env renders on 'llvmpipe.*libnvidia-gl",
    ):
        evaluate(settings, agent_factory=ToZero)
