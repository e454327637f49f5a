"""Client certificates, and a cluster on which Ray's own tools serve. Each needs a separate Ray."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from certificates import authority
from eval_fakes import wait_for

from vlagents_ray import ConfigError, Obs, RemoteAgent, Unauthorized
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.serve.access.key_store import new_key
from vlagents_ray.serve.launch import server
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.haproxy import Tls
from vlagents_ray.serve.launch.server import running_server

TRANSPORTS: tuple[TransportName, ...] = ("http", "websocket", "shm", "auto")


def test_a_client_without_a_certificate_is_refused_where_one_is_wanted(tmp_path: Path) -> None:
    ours, strangers = authority(tmp_path, "ours"), authority(tmp_path, "strangers")
    token = new_key(tmp_path / "keys.json", "arm")
    tls = Tls(*ours.sign("server", "IP:127.0.0.2"), client_ca=ours.file)
    mine, foreign = ours.sign("robot"), strangers.sign("robot")
    config = deployment("noop")
    with running_server(
        config,
        host="127.0.0.2",
        num_cpus=2,
        keys_file=tmp_path / "keys.json",
        tls=tls,
        timeout_s=120,
    ) as served:
        for transport in TRANSPORTS:
            with RemoteAgent(
                served.url, transport=transport, api_key=token, ca=ours.file, certificate=mine
            ) as agent:
                agent.reset(Obs(), "x")
                agent.act(Obs())
            for certificate in (None, foreign):
                agent = RemoteAgent(
                    served.url,
                    transport=transport,
                    api_key=token,
                    ca=ours.file,
                    certificate=certificate,
                    connect_timeout_s=5,
                )
                with pytest.raises(ConfigError, match="certificate="), agent:
                    agent.reset(Obs(), "x")


def test_a_replica_that_others_would_reach_does_not_start_without_keys() -> None:
    """`serve deploy` of a file with host 0.0.0.0 performs no other check."""
    import ray
    from ray import serve
    from ray.serve._private.api import serve_start

    from vlagents_ray.serve.ports import EVERYWHERE, free_port

    with server.own_ray("127.0.0.1", free_port(), num_cpus=2):
        client = serve_start(http_options={"host": EVERYWHERE, "port": free_port(EVERYWHERE)})
        try:
            client.deploy_apps(deployment("noop").for_serve())
            wait_for(lambda: serve.status().applications["noop"].status == "DEPLOY_FAILED")
            (said,) = serve.status().applications["noop"].deployments.values()
            assert "access: {keys_file: PATH}" in said.message
        finally:
            serve.shutdown()
    assert not ray.is_initialized()


def test_without_haproxy_serve_asks_for_keys_and_encrypts_by_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server.haproxy, "haproxy_binary", lambda: None)
    ca = authority(tmp_path, "ca")
    token = new_key(tmp_path / "keys.json", "arm")
    tls, config = Tls(*ca.sign("server", "IP:127.0.0.2")), deployment("noop")
    access = {
        "host": "127.0.0.2",
        "keys_file": tmp_path / "keys.json",
        "num_cpus": 2,
        "timeout_s": 120,
    }
    with (
        pytest.raises(ConfigError, match="needs HAProxy"),
        running_server(config, tls=replace(tls, client_ca=ca.file), **access),  # type: ignore[arg-type]
    ):
        pytest.fail("started")
    with running_server(config, tls=tls, **access) as served:  # type: ignore[arg-type]
        for transport in TRANSPORTS:
            with RemoteAgent(served.url, transport=transport, api_key=token, ca=ca.file) as agent:
                agent.reset(Obs(), "x")
                agent.act(Obs())
            with (
                pytest.raises(Unauthorized),
                RemoteAgent(served.url, transport=transport, api_key="wrong", ca=ca.file) as agent,
            ):
                agent.reset(Obs(), "x")
