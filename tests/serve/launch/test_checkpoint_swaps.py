"""Swaps of the checkpoints of running applications, by the status that Serve reports."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from vlagents_ray.errors import ConfigError, PolicyUnavailable
from vlagents_ray.serve.launch import checkpoint_swaps
from vlagents_ray.serve.launch.checkpoint_swaps import ServedCheckpoints
from vlagents_ray.serve.launch.deployment_file import (
    deployment,
    own_settings,
    together,
    with_user_config,
)
from vlagents_ray.serve.launch.server import Server, wait_until_ready

STORED = "served_agents:Stored"
NOT_LOADED = "PolicyFailed: the policy did not load: FileNotFoundError: no such file"
KILLED = "A replica failed to start. Error:\nThe actor died unexpectedly"


class Serve:
    """Serve with the applications "a" and "b", whose status the test sets."""

    def __init__(self) -> None:
        self.deployed: list[list[int]] = []  # steps of the applications in each deployment
        self.status_of_a, self.message = "RUNNING", ""

    def deploy_apps(self, config: Any) -> None:
        """Record the steps in `user_config`."""
        self.deployed.append(
            [app.deployments[0].user_config["checkpoint_step"] for app in config.applications]
        )
        self.status_of_a = "DEPLOYING"

    def status(self) -> Any:
        """Return the status of both applications."""
        policy = SimpleNamespace(message=self.message)
        a = SimpleNamespace(status=self.status_of_a, message="", deployments={"Policy": policy})
        b = SimpleNamespace(status="RUNNING", message="", deployments={})
        return SimpleNamespace(applications={"a": a, "b": b})


@pytest.fixture
def serve(monkeypatch: pytest.MonkeyPatch) -> Serve:
    serve = Serve()
    monkeypatch.setattr(checkpoint_swaps, "serve", serve)
    monkeypatch.setattr(checkpoint_swaps.private, "serve_client", lambda: serve)
    return serve


@pytest.fixture
def swaps(serve: Serve) -> ServedCheckpoints:
    config = {"checkpoint": "/runs/{step}", "checkpoint_step": 1}
    deployed = together({name: deployment(STORED, config=config) for name in ("a", "b")})
    for app in ("a", "b"):
        deployed = with_user_config(deployed, app, {"checkpoint_step": 1})
    return ServedCheckpoints(Server("", deployed), {"mine": "a", "other": "b"})


def test_each_policy_keeps_its_step_when_another_one_is_swapped(
    swaps: ServedCheckpoints, serve: Serve
) -> None:
    swaps.begin("mine", 2)
    swaps.begin("other", 3)
    assert serve.deployed == [[2, 1], [2, 3]]


def test_a_checkpoint_that_is_loaded_is_not_deployed_again(
    swaps: ServedCheckpoints, serve: Serve
) -> None:
    swaps.begin("mine", 1)
    assert serve.deployed == []
    assert swaps.is_done("mine")


def test_a_swap_lasts_until_all_replicas_run_even_if_one_is_killed(
    swaps: ServedCheckpoints, serve: Serve
) -> None:
    swaps.begin("mine", 2)
    assert not swaps.is_done("mine")
    serve.message = KILLED
    assert not swaps.is_done("mine")
    serve.status_of_a = "UNHEALTHY"
    assert not swaps.is_done("mine")
    serve.status_of_a = "RUNNING"
    assert swaps.is_done("mine")


def test_the_first_failure_to_load_ends_a_swap_with_its_cause(
    swaps: ServedCheckpoints, serve: Serve
) -> None:
    """Serve would start a second replica, whose policy would fail again."""
    swaps.begin("mine", 77)
    serve.message = f"Retrying 1 more time(s). Error:\nTraceback\n{NOT_LOADED}"
    with pytest.raises(ConfigError, match=r"policy 'mine': checkpoint_step 77: .*no such file"):
        swaps.is_done("mine")


def test_the_message_of_an_earlier_failure_is_no_failure_of_the_next_swap(
    swaps: ServedCheckpoints, serve: Serve
) -> None:
    swaps.begin("mine", 77)
    serve.status_of_a, serve.message = "DEPLOY_FAILED", NOT_LOADED
    with pytest.raises(ConfigError, match="no such file"):
        swaps.is_done("mine")
    swaps.begin("mine", 2)
    assert not swaps.is_done("mine")
    serve.message = NOT_LOADED.replace("FileNotFoundError", "MemoryError")
    with pytest.raises(ConfigError, match="MemoryError"):
        swaps.is_done("mine")


def test_a_swap_has_a_time_limit(
    swaps: ServedCheckpoints, serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoint_swaps, "SWAP_S", -1.0)
    swaps.begin("mine", 2)
    with pytest.raises(PolicyUnavailable, match=r"not loaded within .*: the application is DEPLOY"):
        swaps.is_done("mine")


def test_a_start_ends_with_the_first_failure_to_load(serve: Serve) -> None:
    serve.status_of_a, serve.message = "DEPLOYING", NOT_LOADED
    with pytest.raises(ConfigError, match=r"'a' failed to deploy: .*no such file"):
        wait_until_ready(serve, {"a": None}, ["a"], float("inf"))


def test_the_deployment_keeps_its_settings(swaps: ServedCheckpoints) -> None:
    swaps.begin("mine", 2)
    [a, b] = swaps._deployed.applications
    assert own_settings(a) == {"checkpoint": "/runs/{step}", "checkpoint_step": 2}
    assert own_settings(b) == {"checkpoint": "/runs/{step}", "checkpoint_step": 1}
