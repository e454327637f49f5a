"""Which process builds the applications of a server, and what it waits for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from ray import serve
from ray.serve.schema import ServeDeploySchema

from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.serve.access.key_store import new_key
from vlagents_ray.serve.launch import server
from vlagents_ray.serve.launch.deployment_file import deployment, together, with_settings
from vlagents_ray.serve.launch.server import deploy, wait_for_proxies


class FakeClient:
    """Serve's client: remembers what it was to deploy."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.by_serve: list[ServeDeploySchema] = []
        self.built_here: list[serve.RunTarget] = []
        monkeypatch.setattr(serve, "run_many", lambda targets, **_: self.built_here.extend(targets))

    def deploy_apps(self, config: ServeDeploySchema) -> None:
        self.by_serve.append(config)


def changed(app: dict[str, Any], **beside: Any) -> ServeDeploySchema:
    """A file with further keys of an application, and of the file."""
    document = deployment("noop").model_dump(exclude_unset=True)
    document["applications"][0] |= app
    return ServeDeploySchema(**document, **beside)


@pytest.mark.parametrize("ends_at_once", [True, False])
def test_a_server_on_its_own_ray_builds_its_applications_itself(
    ends_at_once: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For a file Serve starts a process that imports everything once more, which takes a second."""
    client = FakeClient(monkeypatch)
    two = together({"a": deployment("noop", replicas=2), "b": with_settings(deployment("noop"), {"action_dim": 3})})
    deploy(client, two, own=True, ingress=not ends_at_once)
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
    ],
)
def test_what_serve_must_apply_is_deployed_by_serve(config: ServeDeploySchema, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that another deployment of the file changes it without new replicas."""
    client = FakeClient(monkeypatch)
    deploy(client, config, own=True, ingress=True)
    assert (client.by_serve, client.built_here) == ([config], [])


def test_a_cluster_of_others_keeps_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    """There others may deploy it again."""
    client, config = FakeClient(monkeypatch), deployment("noop")
    deploy(client, config, own=False, ingress=True)
    assert (client.by_serve, client.built_here) == ([config], [])


@pytest.mark.parametrize("deaths", [0, 2])
def test_a_proxy_that_serve_replaces_is_waited_for(monkeypatch: pytest.MonkeyPatch, deaths: int) -> None:
    """Serve kills one that does not start within some seconds."""
    import ray

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
    import ray

    def get(_: list[str], timeout: float) -> None:
        raise getattr(ray.exceptions, late)

    monkeypatch.setattr(ray, "get", get)
    monkeypatch.setattr("vlagents_ray.serve.launch.server._PROXIES_S", 0.0)
    with pytest.raises(PolicyUnavailable, match="proxies do not listen within 0 s"):
        wait_for_proxies([], list)


ANYWHERE = "0.0.0.0"  # noqa: S104 - what is warned of


@pytest.mark.parametrize(
    ("host", "plain", "warned"), [(ANYWHERE, False, True), (ANYWHERE, True, False), ("127.0.0.1", False, False)]
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
        server.running_server(deployment("noop"), host=host, keys_file=tmp_path / "keys", plain_http=plain),
    ):
        pass
    assert ("--plain-http" in caplog.text) == warned
