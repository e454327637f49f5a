"""How many replicas a deployment gets on a cluster's GPUs, and what its file says of that."""

from __future__ import annotations

import os
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
import ray
from ray._private import accelerators

from vlagents_ray.errors import ConfigError
from vlagents_ray.ray_tools.private import gpus_here
from vlagents_ray.serve.launch import server
from vlagents_ray.serve.launch.deployment_file import deployment, with_replicas_on
from vlagents_ray.serve.replica import replica

PART = {"num_gpus": 0.5, "num_cpus": 2}


@pytest.mark.parametrize(
    ("gpus", "said", "becomes"),
    [
        (8.0, {}, {"replicas": 8, "resources": {"num_gpus": 1.0}}),
        (3.0, {"resources": PART}, {"replicas": 6, "resources": PART}),
        (5.0, {"resources": {"num_gpus": 2}}, {"replicas": 2, "resources": {"num_gpus": 2}}),
        *((8.0, said, said) for said in ({"replicas": 3}, {"autoscaling": {"max_replicas": 2}})),
        (8.0, {"resources": {"num_gpus": 0}}, {"resources": {"num_gpus": 0}}),
        (0.0, {}, {}),
    ],
)
def test_a_replica_stands_on_each_gpu_unless_the_file_says_otherwise(
    gpus: float, said: dict[str, Any], becomes: dict[str, Any]
) -> None:
    [app] = with_replicas_on(deployment("noop", **said), gpus).applications
    assert {name: value for name, value in app.args.items() if name != "policy"} == becomes


@pytest.mark.parametrize(
    ("said", "wanted"),
    [
        ({}, 0.0),
        ({"resources": {"num_gpus": 1}}, 1.0),
        ({"resources": {"num_gpus": 0.5}, "replicas": 3}, 1.5),
        ({"resources": {"num_gpus": 1}, "autoscaling": {"min_replicas": 0, "max_replicas": 4}}, 0.0),
        ({"resources": {"num_gpus": 1}, "autoscaling": {"initial_replicas": 2, "max_replicas": 4}}, 2.0),
    ],
)
@pytest.mark.parametrize("own", [True, False])
def test_more_gpus_than_this_machine_has_are_refused_at_once(
    said: dict[str, Any], wanted: float, own: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cluster that others started may get more: there it is said, and waited for."""
    monkeypatch.setattr(server, "node_of_this_process", lambda: SimpleNamespace(is_head=lambda: own))
    monkeypatch.setattr(ray, "cluster_resources", lambda: {"GPU": wanted})
    server._require_gpus(deployment("noop", **said))
    if not wanted:
        return
    monkeypatch.setattr(ray, "cluster_resources", dict)
    with pytest.raises(ConfigError, match=f"want {wanted:g} GPUs, this machine has 0") if own else nullcontext():
        server._require_gpus(deployment("noop", **said))
    where = "machine" if own else "cluster"
    assert f"want {wanted:g} GPUs, this {where} has 0; want less" in str(
        server._missing_gpus(deployment("noop", **said))
    )


class NoRay(Exception):
    """A Ray would have been started."""


@pytest.mark.parametrize("gpus", [0, 2])
def test_more_gpus_than_this_machine_has_are_refused_before_a_ray_starts(
    gpus: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(*_: object) -> None:
        raise NoRay

    monkeypatch.setattr(server, "_ray", start)
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(server, "gpus_here", lambda: float(gpus))
    wanted = deployment("noop", resources={"num_gpus": 1}, replicas=2)
    said = None if gpus else "want 2 GPUs, this machine has 0; want less"
    with pytest.raises(NoRay if gpus else ConfigError, match=said), server.running_server(wanted):
        pass


def test_gpus_are_counted_as_ray_counts_them_less_those_that_are_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    nvidia = accelerators.get_accelerator_manager_for_resource("GPU")
    monkeypatch.setattr(nvidia, "get_current_node_num_accelerators", staticmethod(lambda: 4))
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert gpus_here() == 4
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,3")
    assert gpus_here() == 2
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert gpus_here() == 0


def test_what_a_cluster_is_missing_is_repeated_until_it_is_there(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "_REMIND_S", 0.0)
    missing = iter(["a GPU", "a GPU", None])
    states = iter(["DEPLOYING", "DEPLOYING", "DEPLOYING", "RUNNING"])
    serve = SimpleNamespace(status=lambda: SimpleNamespace(applications={"a": SimpleNamespace(status=next(states))}))
    monkeypatch.setattr(server, "_http_reason", lambda _: None)
    server.wait_until_ready(serve, {"a": "url"}, ["a"], float("inf"), lambda: next(missing))
    assert [record.getMessage() for record in caplog.records] == ["waiting: a GPU"] * 2


@pytest.mark.parametrize(("given", "visible"), [([], ""), (["2"], "2")])
def test_gpus_are_hidden_from_a_replica_to_which_ray_gave_none(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, given: list[str], visible: str
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2")
    monkeypatch.setattr(replica, "gpus_here", lambda: 4.0)
    replica.hide_gpus(given)
    assert os.environ["CUDA_VISIBLE_DEVICES"] == visible
    assert ("resources: {num_gpus: 1}" in caplog.text) == (not given)
