"""The start and stop of a server: which process builds its applications, what it waits for, and how
many GPUs it needs.
"""

from __future__ import annotations

import itertools
import os
import re
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import ray
from ray import serve
from ray._private import accelerators
from ray._private.ray_logging import stdout_deduplicator
from ray._private.worker import print_to_stdstream
from ray.serve._private.router import SharedRouterLongPollClient
from ray.serve.schema import ServeDeploySchema

from vlagents_ray.errors import ConfigError, PolicyUnavailable
from vlagents_ray.ray_tools import head_monitor
from vlagents_ray.ray_tools.private import gpus_here, long_polls
from vlagents_ray.serve.access.key_store import new_key
from vlagents_ray.serve.launch import server
from vlagents_ray.serve.launch.deployment_file import (
    Deployment,
    deployment,
    together,
    with_replicas_on,
    with_settings,
)
from vlagents_ray.serve.launch.server import deploy, wait_for_proxies
from vlagents_ray.serve.replica import replica


class FakeClient:
    """A stand-in for Serve's client that records the deployments."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.by_serve: list[ServeDeploySchema] = []
        self.built_here: list[serve.RunTarget] = []
        monkeypatch.setattr(serve, "run_many", lambda targets, **_: self.built_here.extend(targets))

    def deploy_apps(self, config: ServeDeploySchema) -> None:
        self.by_serve.append(config)


def changed(app: dict[str, Any], **beside: Any) -> Deployment:
    """Return a deployment with further keys of an application and of the file."""
    document = deployment("noop").model_dump(exclude_unset=True)
    document["applications"][0] |= app
    return Deployment(**document, **beside)


@pytest.mark.parametrize("ends_at_once", [True, False])
def test_a_server_on_its_own_ray_builds_its_applications_itself(
    ends_at_once: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For a deployment file, Serve would start a process that imports everything again, which takes
    a second.
    """
    client = FakeClient(monkeypatch)
    two = together(
        {
            "a": deployment("noop", replicas=2),
            "b": with_settings(deployment("noop"), {"action_dim": 3}),
        }
    )
    deploy(client, two, is_own_ray=True, ingress=not ends_at_once)
    assert client.by_serve == []
    assert [(app.name, app.route_prefix) for app in client.built_here] == [("a", "/a"), ("b", "/b")]
    parts = [app.target._bound_deployment for app in client.built_here]
    assert [(part.name, part.num_replicas) for part in parts] == [("Policy", 2), ("Policy", 1)]
    waits = {part._deployment_config.graceful_shutdown_wait_loop_s for part in parts}
    assert waits == ({0.1} if ends_at_once else {2.0})


@pytest.mark.parametrize(
    "config",
    [
        changed({"deployments": [{"name": "Policy", "num_replicas": 2}]}),
        changed({"deployments": [{"name": "Policy", "user_config": {"action_dim": 3}}]}),
        changed({"runtime_env": {"env_vars": {"A": "b"}}}),
        changed({"import_path": "somebody:elses"}),
        changed({}, logging_config={"log_level": "DEBUG"}),
        changed({}),
    ],
)
def test_what_serve_must_apply_is_deployed_by_serve(
    config: Deployment, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Then a later deployment of the file can change it without new replicas. In a cluster of
    others, Serve deploys everything.
    """
    client = FakeClient(monkeypatch)
    deploy(client, config, is_own_ray=config != changed({}), ingress=True)
    assert (client.by_serve, client.built_here) == ([config.for_serve()], [])


@pytest.mark.parametrize("deaths", [0, 2])
def test_a_proxy_that_serve_replaces_is_waited_for(
    monkeypatch: pytest.MonkeyPatch, deaths: int
) -> None:
    """Serve kills a proxy that does not start within some seconds."""
    asked: list[str] = []

    def get(refs: list[str], timeout: float) -> None:
        asked.extend(refs)
        if len(asked) <= deaths:
            raise ray.exceptions.ActorDiedError

    monkeypatch.setattr(ray, "get", get)
    wait_for_proxies(["first"], lambda: [f"after {len(asked)}"])
    assert asked == ["first", "after 1", "after 2"][: deaths + 1]


@pytest.mark.parametrize("late", ["ActorDiedError", "GetTimeoutError"])
def test_proxies_that_never_listen_are_an_error(monkeypatch: pytest.MonkeyPatch, late: str) -> None:
    def get(_: list[str], timeout: float) -> None:
        raise getattr(ray.exceptions, late)

    monkeypatch.setattr(ray, "get", get)
    monkeypatch.setattr("vlagents_ray.serve.launch.server._PROXIES_S", 0.0)
    with pytest.raises(PolicyUnavailable, match="proxies do not listen within 0 s"):
        wait_for_proxies([], list)


ANYWHERE = "0.0.0.0"  # noqa: S104 - an address that causes a warning


@pytest.mark.parametrize(
    ("host", "plain", "warned"),
    [(ANYWHERE, False, True), (ANYWHERE, True, False), ("127.0.0.1", False, False)],
)
def test_a_server_whose_keys_cross_a_network_unencrypted_warns(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    host: str,
    plain: bool,
    warned: bool,
) -> None:
    new_key(tmp_path / "keys", "arm")

    def no_ray(*_: object) -> None:
        raise PolicyUnavailable("this test starts no Ray")

    monkeypatch.setattr(server, "_ray", no_ray)
    with (
        pytest.raises(PolicyUnavailable, match="no Ray"),
        server.running_server(
            deployment("noop"), host=host, keys_file=tmp_path / "keys", plain_http=plain
        ),
    ):
        pass
    assert ("--plain-http" in caplog.text) == warned


# GPUs.


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
        (
            {"resources": {"num_gpus": 1}, "autoscaling": {"min_replicas": 0, "max_replicas": 4}},
            0.0,
        ),
        (
            {
                "resources": {"num_gpus": 1},
                "autoscaling": {"min_replicas": 2, "max_replicas": 4},
            },
            2.0,
        ),
    ],
)
@pytest.mark.parametrize("own", [True, False])
def test_more_gpus_than_this_machine_has_are_refused_at_once(
    said: dict[str, Any], wanted: float, own: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cluster that others started may get more GPUs, so there the server prints a message and
    waits.
    """
    monkeypatch.setattr(server.session, "started_here", lambda: own)
    monkeypatch.setattr(ray, "cluster_resources", lambda: {"GPU": wanted})
    server._require_gpus(deployment("noop", **said))
    if not wanted:
        return
    monkeypatch.setattr(ray, "cluster_resources", dict)
    with (
        pytest.raises(ConfigError, match=f"at most 0 GPUs, which this machine has, got {wanted:g}")
        if own
        else nullcontext()
    ):
        server._require_gpus(deployment("noop", **said))
    where = "machine" if own else "cluster"
    assert f"at most 0 GPUs, which this {where} has, got {wanted:g}" in str(
        server._missing_gpus(deployment("noop", **said))
    )


class NoRay(Exception):
    """The server would have started Ray."""


@pytest.mark.parametrize("gpus", [0, 2])
def test_more_gpus_than_this_machine_has_are_refused_before_a_ray_starts(
    gpus: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(*_: object) -> None:
        raise NoRay

    monkeypatch.setattr(server, "_ray", start)
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(server.private, "gpus_here", lambda: float(gpus))
    wanted = deployment("noop", resources={"num_gpus": 1}, replicas=2)
    said = None if gpus else "at most 0 GPUs, which this machine has, got 2"
    with pytest.raises(NoRay if gpus else ConfigError, match=said), server.running_server(wanted):
        pass


def test_gpus_are_counted_as_ray_counts_them_less_those_that_are_hidden(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
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

    def status() -> SimpleNamespace:
        app = SimpleNamespace(status=next(states), message="", deployments={})
        return SimpleNamespace(applications={"a": app})

    client = SimpleNamespace(status=status)
    monkeypatch.setattr(server, "_http_reason", lambda _: None)
    server.wait_until_ready(client, {"a": "url"}, ["a"], float("inf"), lambda: next(missing))
    assert [record.getMessage() for record in caplog.records] == ["waiting: a GPU"] * 2


@pytest.mark.parametrize(("given", "visible"), [([], ""), (["2"], "2")])
def test_gpus_are_hidden_from_a_replica_to_which_ray_gave_none(
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    given: list[str],
    visible: str,
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2")
    monkeypatch.setattr(replica, "gpus_here", lambda: 4.0)
    replica.hide_gpus(given)
    assert os.environ["CUDA_VISIBLE_DEVICES"] == visible
    assert ("resources: {num_gpus: 1}" in caplog.text) == (not given)


# The stop of a server.


def client_of_serve() -> SimpleNamespace:
    """Return a client of a Serve that can be shut down."""
    ending = SimpleNamespace(remote=lambda: None)
    controller = SimpleNamespace(graceful_shutdown=SimpleNamespace(options=lambda **_: ending))
    return SimpleNamespace(
        _controller=controller,
        handle_cache={},
        shutdown_cached_handles=lambda: None,
        _shutdown=False,
    )


@pytest.mark.parametrize(
    ("ends", "head", "said"), [(True, True, False), (False, True, True), (False, False, False)]
)
def test_a_controller_that_ends_or_that_does_not_answer_is_no_error(
    ends: bool,
    head: bool,
    said: bool,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    client = client_of_serve()
    monkeypatch.setattr(ray, "wait", lambda refs, **_: (refs, []) if ends else ([], refs))
    monkeypatch.setattr(head_monitor, "head_is_gone", lambda: not head)
    monkeypatch.setattr(server, "_SHUTDOWN_S", 0.0)
    server.shut_down(client)
    assert client._shutdown
    assert ("has not ended within" in caplog.text) is said


def test_nothing_is_requested_of_serve_if_the_head_ends_as_well(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """systemd sends SIGTERM to the server and to Ray's head. Ray would print each failed request."""
    looks = itertools.count()
    monkeypatch.setattr(head_monitor, "head_is_gone", lambda: next(looks) > 1)
    client = client_of_serve()
    client._controller = SimpleNamespace()  # any request raises an error
    server.end_applications(client, ["app"])
    server.shut_down(client)
    assert client._shutdown


@pytest.mark.parametrize("skipped_before", [None, "a line of the user's"])
def test_no_poll_that_a_proxy_loses_with_the_controller_is_printed(
    skipped_before: str | None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """If the proxy ends after the controller, Ray would print the failed poll in the server's
    process.
    """
    expression = None if skipped_before is None else re.compile(skipped_before)
    monkeypatch.setattr(stdout_deduplicator, "skip_re", expression)
    monkeypatch.setattr(stdout_deduplicator, "recent", {})
    monkeypatch.setattr(ray, "wait", lambda refs, **_: (refs, []))
    monkeypatch.setattr(head_monitor, "head_is_gone", lambda: False)
    for _ in range(2):
        server.shut_down(client_of_serve())

    lost = "Task ServeController.listen_for_change failed. There are infinite retries remaining"
    for line in (lost, "a line of the user's", "another task failed"):
        printed = {"lines": [line], "pid": "raylet", "is_err": False}
        print_to_stdstream(printed, ignore_prefix=False)
    shown = capsys.readouterr().out
    assert "listen_for_change" not in shown
    assert ("a line of the user's" in shown) is (skipped_before is None)
    assert "another task failed" in shown


def test_each_long_poll_of_a_controller_can_be_stopped_before_it_ends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Otherwise Ray would report a failed task to the user in one of four stops."""
    stopped: list[str] = []
    own = SimpleNamespace(stop=lambda: stopped.append("own"))
    shared = SimpleNamespace(
        long_poll_client=SimpleNamespace(stop=lambda: stopped.append("shared"))
    )
    monkeypatch.setattr(SharedRouterLongPollClient, "get_or_create", lambda *_: shared)
    used = SimpleNamespace(
        _router=SimpleNamespace(
            _asyncio_router=SimpleNamespace(long_poll_client=own, _event_loop=1)
        )
    )
    unused = SimpleNamespace(_router=None)
    for poll in long_polls(
        SimpleNamespace(_controller=None, handle_cache={"used": used, "unused": unused})
    ):
        poll.stop()
    assert stopped == ["own", "shared"]
