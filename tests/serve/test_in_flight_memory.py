"""The memory of a replica for requests that wait for its policy is the memory that it counts as in
flight, at each endpoint.
"""

from __future__ import annotations

import contextlib
import fcntl
import gc
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from eval_fakes import wait_for

from vlagents_ray.client.transports.shm import ShmTransport
from vlagents_ray.client.transports.websocket import Stream
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol import compact, frame_layout
from vlagents_ray.protocol.frames import encode_requests
from vlagents_ray.protocol.messages import LocalAddress, MessageLimits, Request
from vlagents_ray.protocol.websocket_frames import frame_head
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints.connection import MOST_UNANSWERED
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.endpoints.shm import ShmServer
from vlagents_ray.serve.engine.admission import REQUEST_BYTES
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings

pytestmark = pytest.mark.own_process

IN_FLIGHT = 48 * 2**20
SLACK = 24 * 2**20  # bytes of buffers, of the interpreter and of its allocator
FILE = 4 * 2**20  # bytes of a memory file
ACTS = 512  # number of acts in one message
SMALL = Obs(state={"j": np.zeros(3, np.float32)})


@dataclass
class Gate(Agent):
    """A policy that acts fast, except for observations with the state "wait", which wait until the
    gate opens.
    """

    opened: threading.Event = field(default_factory=threading.Event)
    entered: threading.Event = field(default_factory=threading.Event)

    def act_batch(self, obs: list[Obs], sessions: list[object]) -> list[Act]:
        if any("wait" in one.state for one in obs):
            self.entered.set()
            assert self.opened.wait(60)
        else:
            time.sleep(0.003)  # long enough for a second thread to read in the meantime
        return [Act(np.zeros(2, np.float32)) for _ in obs]

    def act(self, obs: Obs) -> Act:
        raise NotImplementedError


@dataclass
class Replica:
    policy: Gate
    engine: Engine
    own: OwnPortServer
    near: ShmServer


@pytest.fixture
def replica() -> Iterator[Replica]:
    limits = MessageLimits(in_flight_bytes=IN_FLIGHT)
    policy = Gate()
    engine = Engine(policy, EngineSettings(in_flight_bytes=IN_FLIGHT))
    own, near = (
        OwnPortServer(engine, limits, "127.0.0.1", None, NoKey.OPEN),
        ShmServer(engine, limits, NoKey.OPEN),
    )
    own.open(), near.open()
    engine.start()
    yield Replica(policy, engine, own, near)
    policy.opened.set()
    engine.queue.close()
    engine.close()
    own.close(), near.close()
    gc.collect()
    assert engine.admission.held == 0


def allocated() -> int:
    """Return the bytes of this process, without shared pages."""
    gc.collect()
    [line] = [
        line
        for line in Path("/proc/self/status").read_text().splitlines()
        if line.startswith("RssAnon")
    ]
    return int(line.split()[1]) * 1024


def many_acts(session: str) -> bytes:
    act = f'{{"op":"act","session":"{session}","obs":{{}}}}'
    return b"".join(
        frame_layout.assemble(f'{{"requests":[{",".join([act] * ACTS)}],"blobs":[]}}', [])
    )


def hold_policy(replica: Replica) -> ShmTransport:
    """Let an act occupy the policy, after acts of two sessions, so that another thread reads.
    Return the client.
    """
    client = ShmTransport(replica.near.address)
    client.connect(5)
    for name in "ab":
        assert client.call([Request("reset", SMALL, session=name)], 10)[0].error is None
    for _ in range(8):
        client.call([Request("act", SMALL, session=name, request_id=name) for name in "ab"], 10)
    written = encode_requests(
        [Request("act", Obs(state={"wait": np.zeros(1, np.float32)}), session="a")]
    )
    send_in_file(client, 0, written)
    assert replica.policy.entered.wait(10)
    return client


def send_in_file(client: ShmTransport, number: int, frame: bytes) -> None:
    descriptor = memory_file(max(FILE, len(frame)), frame)
    connection = client._socket
    assert connection is not None
    connection.setblocking(True)
    socket.send_fds(connection, [LocalAddress.REQUEST.pack(number, 0, len(frame))], [descriptor])
    os.close(descriptor)


def memory_file(size: int, content: bytes = b"") -> int:
    descriptor = os.memfd_create("request", os.MFD_ALLOW_SEALING)
    os.ftruncate(descriptor, size)
    os.pwrite(descriptor, content, 0)
    fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
    return descriptor


Flood = Callable[[Replica, ShmTransport], contextlib.AbstractContextManager[None]]


@contextlib.contextmanager
def over_own_port(replica: Replica, _: ShmTransport) -> Iterator[None]:
    message = many_acts("b")
    streams = [
        Stream(urlsplit("http://127.0.0.1"), replica.own.address.port, replica.own.path, 5)
        for _ in range(2)
    ]
    for stream in streams:
        stream.send(encode_requests([Request("reset", SMALL, session="b")]), 5)
        stream._socket.setblocking(True)
        stream._socket.settimeout(0.5)
        with contextlib.suppress(TimeoutError):  # the server reads no more
            for _ in range(60):
                stream._socket.sendall(frame_head(len(message), bytes(4)) + message)
    yield
    for stream in streams:
        stream._socket.close()


def _send_all(client: ShmTransport, messages: Iterator[tuple[bytes, int | None]]) -> None:
    """Send messages, each with or without a memory file, until the server reads no more."""
    connection = client._socket
    assert connection is not None
    connection.setblocking(True)
    connection.settimeout(0.5)
    with contextlib.suppress(TimeoutError):
        for message, descriptor in messages:
            if descriptor is None:
                connection.send(message)
            else:
                socket.send_fds(connection, [message], [descriptor])
                os.close(descriptor)


@contextlib.contextmanager
def over_shared_memory(_replica: Replica, client: ShmTransport) -> Iterator[None]:
    """Send frames of small acts in memory of the client."""
    frame = many_acts("b")
    head = LocalAddress.REQUEST.pack(1, 0, len(frame))
    _send_all(
        client, ((head, memory_file(FILE, frame) if number == 0 else None) for number in range(120))
    )
    yield


def _compact(acts: int) -> bytes:
    written = compact.CompactWriter().write([Request("act", SMALL, session="b", request_id="x")])
    assert written is not None
    item = written.message[compact.COUNT.size :]
    known = compact.ITEM.pack(0, 0, -1, float("nan"), float("nan"), b"y")
    text = item[compact.ITEM.size :]
    return compact.COUNT.pack(acts) + item[: compact.ITEM.size] + known * (acts - 1) + text


@contextlib.contextmanager
def in_compact_form(_replica: Replica, client: ShmTransport) -> Iterator[None]:
    head = LocalAddress.REQUEST.pack(1, LocalAddress.COMPACT, FILE)
    message = head + _compact(ACTS)
    _send_all(
        client, ((message, memory_file(FILE) if number == 0 else None) for number in range(120))
    )
    yield


@contextlib.contextmanager
def with_copies(_replica: Replica, client: ShmTransport) -> Iterator[None]:
    """Send acts in more memory files than the server keeps mapped, so that each further act copies
    its whole file, although it needs only 12 bytes of it.
    """

    def messages() -> Iterator[tuple[bytes, int | None]]:
        for number in range(120):
            file = min(1 + number, LocalAddress.FILES - 1)
            head = LocalAddress.REQUEST.pack(file, LocalAddress.COMPACT, FILE)
            yield head + _compact(1), memory_file(FILE) if number < LocalAddress.FILES - 1 else None

    _send_all(client, messages())
    yield


FLOODS: dict[str, Flood] = {
    "own port": over_own_port,
    "shared memory": over_shared_memory,
    "compact form": in_compact_form,
    "copies of shared memory": with_copies,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FLOODS)
def test_requests_that_wait_take_no_more_memory_than_they_count(
    replica: Replica, name: str
) -> None:
    client = hold_policy(replica)
    admission = replica.engine.admission
    before = allocated()
    with FLOODS[name](replica, client):
        wait_for(
            lambda: (
                admission.held > IN_FLIGHT / 4 or replica.engine.queue.depth() > MOST_UNANSWERED / 2
            )
        )
        time.sleep(0.5)  # time in which the server may read more
        assert admission.held <= IN_FLIGHT
        assert admission.held >= REQUEST_BYTES * replica.engine.queue.depth()
        assert allocated() - before < admission.held + SLACK
        replica.engine.queue.close()  # do not wait for tens of thousands of acts
    client.close()


def test_a_local_client_that_reads_no_answers_is_not_read_for_ever(replica: Replica) -> None:
    client = hold_policy(replica)
    [connection] = replica.near._clients
    head = LocalAddress.REQUEST.pack(1, LocalAddress.COMPACT, FILE)
    messages = (
        (head + _compact(1), memory_file(FILE) if number == 0 else None) for number in range(2000)
    )
    _send_all(client, messages)
    wait_for(lambda: not connection._polled)
    assert connection._unanswered == MOST_UNANSWERED
    replica.policy.opened.set()
    wait_for(lambda: connection._unanswered < MOST_UNANSWERED)
    wait_for(lambda: connection._polled or connection._ended)
    replica.engine.queue.close()
    client.close()


def test_an_act_in_compact_form_is_refused_while_there_is_no_room(replica: Replica) -> None:
    client = ShmTransport(replica.near.address)
    client.connect(5)
    assert client.call([Request("reset", SMALL)], 10)[0].error is None
    assert client.call([Request("act", SMALL)], 10)[0].error is None
    admission = replica.engine.admission
    size = IN_FLIGHT - REQUEST_BYTES  # the last message may not be freed yet
    admission.hold(size, True, 0)
    [reply] = client.call(
        [Request("act", SMALL, request_id=str(number)) for number in range(2)], 10
    )[:1]
    assert reply.error is not None
    assert reply.error.code == "overloaded"
    admission.release(size)
    [reply] = client.call([Request("act", SMALL, request_id="free")], 10)
    assert reply.error is None
    client.close()
