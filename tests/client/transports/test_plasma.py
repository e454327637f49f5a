"""Who can use plasma, decided before anything is opened."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from vlagents_ray import RemoteAgent
from vlagents_ray.client.transports.serve_handle import HandleTransport, PlasmaTransport
from vlagents_ray.errors import ConfigError, PolicyUnavailable
from vlagents_ray.interface import Obs

HERE, ELSEWHERE = "a" * 56, "b" * 56


@pytest.mark.parametrize(
    ("node", "address", "error", "said"),
    [
        (HERE, {"socket": "/nowhere", "node": ELSEWHERE}, ConfigError, "use transport 'handle'"),
        (HERE, None, ConfigError, "no plasma endpoint"),
        (None, {"socket": "/nowhere", "node": HERE}, ConfigError, "use http://"),
        (HERE, {"socket": "/no/endpoint", "node": HERE}, PolicyUnavailable, "does not answer"),
    ],
)
def test_without_an_endpoint_on_this_node_plasma_is_refused_with_what_to_use(
    monkeypatch: pytest.MonkeyPatch, node: str | None, address: dict[str, Any] | None, error: type, said: str
) -> None:
    monkeypatch.setattr("vlagents_ray.client.transports.serve_handle.this_node", lambda: node)
    with pytest.raises(error, match=said):
        PlasmaTransport("app").connect_to(HandleTransport("app"), {"plasma": address}, 1)


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
def test_a_connection_that_fails_is_closed_at_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("vlagents_ray.client.transports.serve_handle.this_node", lambda: HERE)
    path = str(tmp_path / "s")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(path)
        listener.listen()
        endpoint = {"plasma": {"socket": path, "node": HERE}}
        for broken in (KeyboardInterrupt(), UnicodeError("a key that is no text"), OSError("gone")):
            monkeypatch.setattr("vlagents_ray.client.transports.shm._require_same_user", Mock(side_effect=broken))
            before = os.listdir("/proc/self/fd")
            with pytest.raises((type(broken), PolicyUnavailable)) as raised:  # which holds the frame with the socket
                PlasmaTransport("app").connect_to(HandleTransport("app"), endpoint, 1)
            assert len(os.listdir("/proc/self/fd")) == len(before), raised.value
