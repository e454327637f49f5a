"""Tests of the front of gRPC's server: it counts frames, ends connections with too many, and does
not disturb robots.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import grpc
import pytest
from eval_fakes import wait_for
from hypothesis import given
from hypothesis import strategies as st
from lerobot_messages import AsyncClient, robot_saw

from vlagents_ray_dialects import acceptor, http2_front
from vlagents_ray_dialects.http2_front import Http2Front
from vlagents_ray_dialects.messages.http2 import PREFACE, FrameCounter

SETTINGS = b"\0\0\0\x04" + bytes(5)
Connect = Callable[[], socket.socket]


@given(
    st.lists(st.sampled_from([0, 1, 8, 300, 4095, 4096, 16384]), max_size=30),
    st.lists(st.integers(1, 5000), min_size=1, max_size=20),
)
def test_small_frames_are_counted_wherever_the_bytes_are_split(
    sizes: list[int], reads: list[int]
) -> None:
    data = b"".join(
        size.to_bytes(3, "big") + bytes([0, 0, 0, 0, 0, 1]) + bytes(size) for size in sizes
    )
    counter, counted, start = FrameCounter(), 0, 0
    while start < len(data):
        for size in reads:
            counted += counter.count(data[start : start + size])
            start += size
    assert counted == sum(size < 4096 for size in sizes)


def test_a_cancellation_counts_as_eight_small_frames() -> None:
    cancellation = b"\0\0\x04\x03\0\0\0\0\x01" + b"\0\0\0\x08"
    assert FrameCounter().count(cancellation * 3 + SETTINGS) == 3 * 8 + 1


@pytest.mark.parametrize("kind", range(1, 12))
@pytest.mark.parametrize("size", [0, 63, 64, 700, 4095, 4096, 5000, 16384])
def test_a_frame_without_data_counts_by_its_size(kind: int, size: int) -> None:
    """No size is free: SETTINGS of 4.2 kB, above the bound of small frames, have 700 entries."""
    frame = size.to_bytes(3, "big") + bytes([kind, 0, 0, 0, 0, 1]) + bytes(size)
    assert FrameCounter().count(frame) == max(8 if kind == 3 else 1, size // 64)


@given(st.lists(st.binary(max_size=100), max_size=20))
def test_any_bytes_are_counted_as_when_they_arrive_at_once(parts: list[bytes]) -> None:
    counter = FrameCounter()
    assert sum(counter.count(part) for part in parts) == FrameCounter().count(b"".join(parts))


@pytest.fixture
def connect(open_dialect: Any) -> Connect:
    """Connect to the gateway; a read waits for at most 10 s."""
    port = open_dialect("lerobot")
    return partial(socket.create_connection, ("127.0.0.1", port), timeout=10)


def read_to_the_end(connection: socket.socket) -> bytes:
    received = b""
    with contextlib.suppress(ConnectionError):
        while data := connection.recv(65536):
            received += data
    return received


@pytest.mark.parametrize("first", [b"GET / HTTP/1.1\r\n\r\n", PREFACE[:20] + b"x", b"\x16\x03\x01"])
def test_a_connection_without_the_preface_of_http2_ends_at_once(
    connect: Connect, first: bytes
) -> None:
    with connect() as connection:
        connection.sendall(first)
        assert read_to_the_end(connection) == b""


def test_half_a_preface_ends_after_the_time_of_a_handshake(
    connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(http2_front, "_HANDSHAKE_S", 0.1)
    with connect() as connection:
        connection.sendall(PREFACE[:10])
        assert read_to_the_end(connection) == b""


def test_more_frames_at_once_than_a_robot_sends_end_the_connection(connect: Connect) -> None:
    with connect() as connection:
        connection.sendall(PREFACE + SETTINGS)
        assert connection.recv(9)[3] == 4  # the settings frame of the server
        with contextlib.suppress(ConnectionError):
            connection.sendall(SETTINGS * 2000)
        answers = read_to_the_end(connection)
        assert len(answers) < 2000 * len(SETTINGS)


def test_a_connection_with_too_many_frames_stays_open_so_that_its_client_does_not_return_at_once(
    connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(http2_front, "_UNREAD_S", 0.5)
    begun = time.monotonic()
    with connect() as connection:
        connection.sendall(PREFACE + SETTINGS * 1000)
        read_to_the_end(connection)
    assert 0.4 < time.monotonic() - begun < 5


@pytest.mark.slow
def test_frames_above_the_rate_wait(connect: Connect, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http2_front, "_FRAMES_PER_S", 1e-6)
    monkeypatch.setattr(http2_front, "_FRAMES_AT_ONCE", 10)
    with connect() as connection, connection.makefile("rb") as answers:
        connection.sendall(PREFACE + SETTINGS * 10)
        acknowledged = 0
        while acknowledged < 10:
            head = answers.read(9)
            answers.read(int.from_bytes(head[:3], "big"))
            acknowledged += (head[3], head[4]) == (4, 1)
        connection.sendall(SETTINGS)
        connection.settimeout(0.3)
        with pytest.raises(TimeoutError):
            connection.recv(1)


def test_strangers_end_the_oldest_stranger_and_no_client(
    open_dialect: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(http2_front, "_STRANGERS", 3)
    monkeypatch.setattr(acceptor, "_ACCEPTED_PER_S", 1000.0)
    port = open_dialect("lerobot")
    with AsyncClient(port).begin() as robot, contextlib.ExitStack() as stack:
        strangers = []
        for _ in range(8):
            stranger = stack.enter_context(
                socket.create_connection(("127.0.0.1", port), timeout=10)
            )
            stranger.sendall(PREFACE + SETTINGS)
            strangers.append(stranger)
        for stranger in strangers[:5]:
            read_to_the_end(stranger)
        assert strangers[-1].recv(9)[3] == 4
        assert robot.act(robot_saw(0))


def test_a_robot_is_not_slowed_by_the_bound_of_frames(
    open_dialect: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The limit has tokens for the frames of just 150 requests, and all 150 are answered."""
    monkeypatch.setattr(http2_front, "_FRAMES_PER_S", 1e-6)
    monkeypatch.setattr(http2_front, "_FRAMES_AT_ONCE", 150 * 6)
    with AsyncClient(open_dialect("lerobot")).begin() as robot:
        for step in range(75):  # each step sends an observation and requests its actions
            assert robot.act(robot_saw(step, pixel=step))


def test_clients_of_one_server_are_told_apart_and_nothing_is_left() -> None:
    peers: list[str] = []

    def answer(_: bytes, context: grpc.ServicerContext) -> bytes:
        peers.append(context.peer())
        return front.share_of(context.peer()).encode()

    front = Http2Front("test", lambda _: True, lambda _: None)
    handler = grpc.unary_unary_rpc_method_handler(answer)
    server = grpc.server(
        ThreadPoolExecutor(2),
        handlers=[grpc.method_handlers_generic_handler("Service", {"Method": handler})],
    )
    server.add_insecure_port(front.address)
    server.start()
    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    accepting = acceptor.Acceptor("test", listener, front.add)
    options = [("grpc.use_local_subchannel_pool", 1)]
    for _ in range(2):
        with grpc.insecure_channel(f"127.0.0.1:{port}", options=options) as channel:
            assert channel.unary_unary("/Service/Method")(b"", timeout=20) == b"address 127.0.0.1"
    assert len(set(peers)) == 2
    wait_for(lambda: front.share_of(peers[0]) == "address unknown")
    accepting.close()
    server.stop(0).wait()
    front.close()
    assert not accepting.alive()
    assert not Path(front.path).parent.exists()


ANSWER = bytes(range(256)) * 32 * 1024  # larger than the kernel's buffers


class StoppedServer:
    """A front with a stranger and a client. Its server has ended after writing an answer of 8 MiB,
    which the client has not read.
    """

    def __init__(self, stack: contextlib.ExitStack) -> None:
        self.client_peer = ""
        front = Http2Front("test", self._is_client, lambda _: None)
        server = stack.enter_context(socket.socket(socket.AF_UNIX))
        server.bind(front.path)
        server.listen()
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        self.stranger, self.client = (self._connected(stack, front, listener) for _ in range(2))
        self.stranger.sendall(PREFACE[:10])
        self.client.sendall(PREFACE)
        connection, peer = server.accept()
        with connection:
            self.client_peer = f"unix-abstract:{peer[1:].decode()}"
            assert connection.recv(len(PREFACE), socket.MSG_WAITALL) == PREFACE
            self._answering = threading.Thread(target=self._answer, args=(connection.dup(),))
        self._answering.start()
        wait_for(lambda: self.client.recv(1, socket.MSG_PEEK) == ANSWER[:1])
        self._stopping = threading.Thread(target=front.close)
        self._stopping.start()

    def _is_client(self, peer: str) -> bool:
        return peer == self.client_peer

    @staticmethod
    def _connected(
        stack: contextlib.ExitStack, front: Http2Front, listener: socket.socket
    ) -> socket.socket:
        connection = stack.enter_context(
            socket.create_connection(listener.getsockname(), timeout=10)
        )
        front.add(listener.accept()[0])
        return connection

    @staticmethod
    def _answer(connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError):  # the client does not read the answer
            connection.sendall(ANSWER)

    def join(self) -> None:
        self._stopping.join()
        self._answering.join()


@pytest.fixture
def stopped() -> Iterator[StoppedServer]:
    with contextlib.ExitStack() as stack:
        server = StoppedServer(stack)
        yield server
        server.join()


@pytest.mark.parametrize("frames", [0, 20], ids=["only reads", "sends more"])
def test_the_last_answer_reaches_a_client_that_reads_it_after_the_front_closes(
    stopped: StoppedServer, frames: int
) -> None:
    """A client of HTTP/2 also sends frames, such as WINDOW_UPDATE, while it reads."""
    # The stranger's connection ends when the front begins to close.
    read_to_the_end(stopped.stranger)
    received = bytearray()
    with contextlib.suppress(ConnectionError):
        while data := stopped.client.recv(2**20):
            received += data
            if frames:
                frames -= 1
                with contextlib.suppress(ConnectionError):  # the front has ended
                    stopped.client.sendall(SETTINGS)
    assert received == ANSWER


@pytest.mark.slow
def test_no_stranger_and_no_client_that_does_not_read_delays_a_stop(stopped: StoppedServer) -> None:
    """The stranger's connection ends immediately, the client's connection after the time for its
    answers.
    """
    begun = time.monotonic()
    assert read_to_the_end(stopped.stranger) == b""
    stranger_s = time.monotonic() - begun
    stopped.join()
    assert stranger_s < (time.monotonic() - begun) / 2
    # Without the stop, a stranger would be disconnected after this time.
    assert time.monotonic() - begun < http2_front._HANDSHAKE_S
