"""How many replicas a deployment gets on a cluster's GPUs, and what its file says of that."""

from __future__ import annotations

from typing import Any

import pytest

from vlagents_ray.serve.files import deployment, with_replicas_on


def args(gpus: float, **said: Any) -> dict[str, Any]:
    [app] = with_replicas_on(deployment("noop", **said), gpus).applications
    return {name: value for name, value in app.args.items() if name != "policy"}


def test_a_replica_stands_on_each_gpu_of_its_own() -> None:
    assert args(8.0) == {"replicas": 8, "resources": {"num_gpus": 1.0}}


def test_a_file_that_wants_a_part_of_a_gpu_or_several_gets_as_many_replicas_as_fit() -> None:
    assert args(3.0, resources={"num_gpus": 0.5, "num_cpus": 2})["replicas"] == 6
    assert args(3.0, resources={"num_gpus": 0.5, "num_cpus": 2})["resources"] == {"num_gpus": 0.5, "num_cpus": 2}
    assert args(5.0, resources={"num_gpus": 2})["replicas"] == 2


@pytest.mark.parametrize(
    "said", [{"replicas": 3}, {"autoscaling": {"max_replicas": 2}}, {"resources": {"num_gpus": 0}}]
)
def test_what_a_file_says_of_replicas_or_of_no_gpu_holds(said: dict[str, Any]) -> None:
    assert args(8.0, **said) == said


def test_without_gpus_all_stays_as_it_is() -> None:
    assert args(0.0) == {}
