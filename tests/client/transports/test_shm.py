"""Shared memory to a server that hangs."""

from __future__ import annotations

import os
import socket

import numpy as np
import pytest

from vlagents_ray import Obs
from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.shm import ShmTransport
from vlagents_ray.errors import DeadlineExceeded, PolicyUnavailable
from vlagents_ray.protocol.messages import LocalAddress, Request, boot_id


def test_requests_to_a_server_that_hangs_take_no_more_memory_than_it_would_accept() -> None:
    name = f"vlagents-ray-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(f"\0{name}")
        listener.listen()
        transport = ShmTransport({"socket": name, "boot_id": boot_id()})
        transport.connect(5)
        obs = Obs({"front": np.zeros((64, 64, 3), np.uint8)})
        for number in range(2 * LocalAddress.FILES):
            with pytest.raises(DeadlineExceeded):
                transport.call([Request("act", obs, session="s", request_id=str(number))], 0.005)
        assert len(transport._memories) == LocalAddress.FILES
        transport.close()


@pytest.mark.parametrize("keyed", [False, True])
def test_a_server_of_another_user_is_sent_nothing(monkeypatch: pytest.MonkeyPatch, *, keyed: bool) -> None:
    """Neither a key nor an observation: whoever takes the name of a server that has ended would command the robot."""
    name = f"vlagents-ray-test-{os.getpid()}"
    monkeypatch.setattr("vlagents_ray.client.transports.shm.peer_uid", lambda _: os.getuid() + 1)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(f"\0{name}")
        listener.listen()
        transport = ShmTransport({"socket": name, "boot_id": boot_id(), "keyed": keyed}, Credentials("vlr_x"))
        with pytest.raises(PolicyUnavailable, match=f"belongs to the user with the number {os.getuid() + 1}"):
            transport.call([Request("act", Obs(), request_id="1")], 5)
        peer, _ = listener.accept()
        with peer:
            assert peer.recv(1) == b""
