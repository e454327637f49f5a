"""No message of a key keeps the policy's thread busy for longer than an image that it decodes itself.

The CPU time of the thread shows this exactly, while pauses of a robot depend on everything else that
runs on the machine.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any
from urllib.parse import urlsplit

import flood
import numpy as np
import pytest
from eval_fakes import wait_for

from vlagents_ray.client.transports.websocket import Stream
from vlagents_ray.images import jpeg_png
from vlagents_ray.protocol.messages import MessageLimits
from vlagents_ray.serve.access.api_keys import Keys
from vlagents_ray.serve.endpoints.message_connection import MessageConnection
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.engine.engine import Engine

pytestmark = pytest.mark.slow

# The longest turn of the policy's thread, relative to decoding the most expensive image in place;
# it was 10 for PNG files, and 100 for those of 65 kB without pixels.
FACTOR = 6.0
PARTS: dict[str, Callable[[], bytes]] = {"images": flood._frame, **flood.PARTS}


def cpu_s(call: Callable[[], object]) -> float:
    begun = time.thread_time()
    call()
    return time.thread_time() - begun


@pytest.fixture(scope="module")
def most_expensive_s() -> float:
    """Return the CPU time of the most expensive image that is decoded in place, s."""
    noise = np.random.default_rng(0).integers(0, 256, (512, 480, 3), np.uint8)
    file = jpeg_png.encode_jpeg(noise, 95)
    return min(cpu_s(partial(jpeg_png.decode, file)) for _ in range(5))


@pytest.fixture
def server() -> Iterator[OwnPortServer]:
    keys = Keys.from_text(json.dumps({"keys": [flood._key("slow", rate=1)]}))
    engine = Engine(flood._Policy())
    check = partial(keys.check, app="app")
    own = OwnPortServer(engine, MessageLimits(), "127.0.0.1", None, check)
    own.open()
    engine.start()
    yield own
    engine.close()
    own.close()


@pytest.mark.parametrize("part", PARTS)
def test_no_message_takes_much_time_of_the_policys_thread(
    server: OwnPortServer, monkeypatch: pytest.MonkeyPatch, most_expensive_s: float, part: str
) -> None:
    turns_s: list[float] = []
    for name in ("_read", "_decoded"):
        original = getattr(MessageConnection, name)

        def run(self: Any, *arguments: Any, original: Callable[..., None] = original) -> None:
            turns_s.append(cpu_s(lambda: original(self, *arguments)))

        monkeypatch.setattr(MessageConnection, name, run)
    address = server.address
    headers = {"authorization": "Bearer slow"}
    stream = Stream(urlsplit("http://127.0.0.1"), address.port, address.path, 10, headers)
    try:
        stream.send(PARTS[part](), 60)
        assert stream.recv(60)
    finally:
        stream.close()
    wait_for(lambda: not server._clients)
    assert turns_s
    assert max(turns_s) < FACTOR * most_expensive_s, f"longest turns: {sorted(turns_s)[-4:]}"
