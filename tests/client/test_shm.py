"""Shared memory to a server that hangs."""

from __future__ import annotations

import os
import socket

import numpy as np
import pytest

from vlagents_ray import Obs
from vlagents_ray.client.shm import ShmTransport
from vlagents_ray.errors import DeadlineExceeded
from vlagents_ray.wire.messages import LocalAddress, Request, boot_id


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
