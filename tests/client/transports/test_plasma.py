"""Who can use plasma, decided before anything is opened."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from typing import Any

import pytest

from vlagents_ray import RemoteAgent
from vlagents_ray.client.transports.serve_handle import HandleTransport, PlasmaTransport
from vlagents_ray.errors import ConfigError, PolicyUnavailable
from vlagents_ray.interface import Obs

HERE, ELSEWHERE = "a" * 56, "b" * 56


@pytest.mark.parametrize(
    ("node", "address", "said"),
    [
        (HERE, {"socket": "/nowhere", "node": ELSEWHERE}, "use transport 'handle'"),
        (HERE, None, "no plasma endpoint"),
        (None, {"socket": "/nowhere", "node": HERE}, "use http://"),
    ],
)
def test_who_is_not_on_the_replicas_node_is_told_what_to_use(
    monkeypatch: pytest.MonkeyPatch, node: str | None, address: dict[str, Any] | None, said: str
) -> None:
    monkeypatch.setattr("vlagents_ray.client.transports.serve_handle.this_node", lambda: node)
    with pytest.raises(ConfigError, match=said):
        PlasmaTransport("app").connect_to(HandleTransport("app"), {"plasma": address}, 1)


def test_an_endpoint_that_is_gone_is_unavailable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vlagents_ray.client.transports.serve_handle.this_node", lambda: HERE)
    with pytest.raises(PolicyUnavailable, match="does not answer"):
        PlasmaTransport("app").connect_to(
            HandleTransport("app"), {"plasma": {"socket": "/no/endpoint", "node": HERE}}, 1
        )


def test_outside_of_a_cluster_there_is_no_plasma() -> None:
    with pytest.raises(ConfigError, match="in no Ray cluster"):
        RemoteAgent("serve://app", transport="plasma").reset(Obs())
    with pytest.raises(ConfigError, match="serve://APP"):
        RemoteAgent("http://localhost:8000", transport="plasma")


def test_a_replicas_socket_that_is_another_users_is_sent_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("vlagents_ray.client.transports.serve_handle.this_node", lambda: HERE)
    monkeypatch.setattr("vlagents_ray.client.transports.shm.peer_uid", lambda _: os.getuid() + 1)
    path = str(tmp_path / "s")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(path)
        listener.listen()
        with pytest.raises(PolicyUnavailable, match="belongs to the user"):
            PlasmaTransport("app").connect_to(HandleTransport("app"), {"plasma": {"socket": path, "node": HERE}}, 1)


@pytest.mark.own_process
@pytest.mark.parametrize("broken", [KeyboardInterrupt(), UnicodeError("a key that is no text"), OSError("gone")])
def test_a_connection_that_fails_is_closed_at_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, broken: BaseException
) -> None:
    def fail(_: socket.socket) -> None:
        raise broken

    monkeypatch.setattr("vlagents_ray.client.transports.serve_handle.this_node", lambda: HERE)
    monkeypatch.setattr("vlagents_ray.client.transports.shm._require_same_user", fail)
    path = str(tmp_path / "s")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(path)
        listener.listen()
        endpoint = {"plasma": {"socket": path, "node": HERE}}
        before = os.listdir("/proc/self/fd")
        with pytest.raises((type(broken), PolicyUnavailable)) as raised:  # which holds the frame with the socket
            PlasmaTransport("app").connect_to(HandleTransport("app"), endpoint, 1)
        assert len(os.listdir("/proc/self/fd")) == len(before), raised.value
