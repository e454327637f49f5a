"""Shared memory and plasma: whether they can be used is decided before anything is sent; and
servers that hang.
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.serve_handle import HandleTransport, PlasmaTransport
from vlagents_ray.client.transports.shm import ShmTransport
from vlagents_ray.errors import ConfigError, DeadlineExceeded, PolicyUnavailable
from vlagents_ray.protocol.messages import LocalAddress, Request, boot_id

HERE, ELSEWHERE = "a" * 56, "b" * 56
NAME = f"vlagents-ray-test-{os.getpid()}"


@contextlib.contextmanager
def listening(address: str) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(address)
        listener.listen()
        yield listener


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate that this process is on the node of the replica."""
    monkeypatch.setattr("vlagents_ray.client.transports.serve_handle.this_node", lambda: HERE)


def connect_plasma(address: dict[str, Any] | None) -> None:
    PlasmaTransport("app").connect_to(HandleTransport("app"), {"plasma": address}, 1)


def test_requests_to_a_server_that_hangs_take_no_more_memory_than_it_would_accept() -> None:
    with listening(f"\0{NAME}"):
        transport = ShmTransport(LocalAddress(NAME, boot_id()))
        transport.connect(5)
        obs = Obs({"front": np.zeros((64, 64, 3), np.uint8)})
        for number in range(2 * LocalAddress.FILES):
            with pytest.raises(DeadlineExceeded):
                transport.call([Request("act", obs, session="s", request_id=str(number))], 0.005)
        assert len(transport._memories) == LocalAddress.FILES
        transport.close()


@pytest.mark.usefixtures("here")
def test_a_server_of_another_user_is_sent_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Neither a key nor an observation is sent. Otherwise a process that takes over the name of an
    ended server could command the robot.
    """
    monkeypatch.setattr("vlagents_ray.client.transports.shm.peer_uid", lambda _: os.getuid() + 1)
    for keyed in (False, True):
        with listening(f"\0{NAME}") as listener:
            transport = ShmTransport(
                LocalAddress(NAME, boot_id(), keyed=keyed), Credentials("vlr_x")
            )
            with pytest.raises(
                PolicyUnavailable, match=f"belongs to the user with the uid {os.getuid() + 1}"
            ):
                transport.call([Request("act", Obs(), request_id="1")], 5)
            peer, _ = listener.accept()
            with peer:
                assert peer.recv(1) == b""
    with (
        listening(str(tmp_path / "s")),
        pytest.raises(PolicyUnavailable, match="belongs to the user"),
    ):
        connect_plasma({"socket": str(tmp_path / "s"), "node": HERE})


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
    monkeypatch: pytest.MonkeyPatch,
    node: str | None,
    address: dict[str, Any] | None,
    error: type,
    said: str,
) -> None:
    monkeypatch.setattr("vlagents_ray.client.transports.serve_handle.this_node", lambda: node)
    with pytest.raises(error, match=said):
        connect_plasma(address)


def test_outside_of_a_cluster_there_is_no_plasma() -> None:
    with pytest.raises(ConfigError, match="in no Ray cluster"):
        RemoteAgent("serve://app", transport="plasma").reset(Obs())
    with pytest.raises(ConfigError, match="serve://APP"):
        RemoteAgent("http://localhost:8000", transport="plasma")


@pytest.mark.slow
@pytest.mark.own_process
@pytest.mark.usefixtures("here")
def test_a_connection_that_fails_is_closed_at_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with listening(str(tmp_path / "s")):
        for broken in (KeyboardInterrupt(), UnicodeError("a key that is no text"), OSError("gone")):
            monkeypatch.setattr(
                "vlagents_ray.client.transports.shm._require_same_user", Mock(side_effect=broken)
            )
            before = os.listdir("/proc/self/fd")
            # The traceback keeps the frame that refers to the socket.
            with pytest.raises((type(broken), PolicyUnavailable)) as raised:
                connect_plasma({"socket": str(tmp_path / "s"), "node": HERE})
            assert len(os.listdir("/proc/self/fd")) == len(before), raised.value
