"""Tests of ZeroMQ's protocol: garbage raises only `MalformedMessage`, and messages survive a round
trip through libzmq.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from vlagents_ray.errors import MalformedMessage
from vlagents_ray_dialects.messages import zmtp

zmq = pytest.importorskip("zmq")

READY = b"\x0bSocket-Type\0\0\0\x06DEALER"
MESSAGES = st.lists(st.binary(max_size=600), min_size=1, max_size=5)


def read_frames(data: bytes) -> Iterator[tuple[zmtp.FrameFlags, bytes]]:
    """Yield each frame's flags and body, read as the gateway reads them."""
    start = 0
    while start < len(data):
        flags = zmtp.read_flags(data[start])
        size_end = start + zmtp.HEAD_BYTES + flags.size_bytes
        end = size_end + zmtp.read_size(data[start + zmtp.HEAD_BYTES : size_end])
        yield flags, data[size_end:end]
        start = end


@given(MESSAGES)
@example([b""])
@example([bytes(255), bytes(256)])
def test_the_frames_of_a_message_are_read_back(parts: list[bytes]) -> None:
    frames = list(read_frames(zmtp.write_message(parts)))
    assert [body for _, body in frames] == parts
    assert [flags.has_more for flags, _ in frames] == [True] * (len(parts) - 1) + [False]
    assert not any(flags.is_command for flags, _ in frames)


@given(st.integers(0, 255))
def test_each_first_byte_has_flags_or_is_malformed(first: int) -> None:
    try:
        flags = zmtp.read_flags(first)
    except MalformedMessage:
        assert first > 7 or first & 5 == 5  # unknown bits, or a command of several frames
    else:
        assert first == flags.has_more + 2 * flags.is_long + 4 * flags.is_command


@given(st.binary(max_size=64))
@example(zmtp.GREETING)
@example(zmtp.GREETING[:10] + b"\x02" + zmtp.GREETING[11:])
def test_a_greeting_that_is_refused_as_a_whole_is_none_of_zmtp_3(greeting: bytes) -> None:
    try:
        zmtp.check_greeting(greeting)
    except MalformedMessage:
        assert (
            greeting[:10] != zmtp.GREETING[:10]
            or greeting[10] < 3
            or greeting[12:32] != zmtp.GREETING[12:32]
        )


@given(st.integers(1, 64))
def test_a_part_of_a_greeting_is_accepted(length: int) -> None:
    zmtp.check_greeting(zmtp.GREETING[:length])


@given(st.binary(max_size=80))
@example(READY[:-1])
def test_garbage_in_commands_is_malformed(content: bytes) -> None:
    """Random bytes may also be valid; no other error is raised."""
    for read in (zmtp.read_command, zmtp.check_ready):
        with contextlib.suppress(MalformedMessage):
            read(content)


@given(st.integers(1, len(READY) - 1))
def test_each_part_of_the_properties_of_ready_is_malformed(length: int) -> None:
    zmtp.check_ready(READY)
    with pytest.raises(MalformedMessage):
        zmtp.check_ready(READY[:length])


def serve_one(
    listener: socket.socket, received: list[list[bytes]], number: int, answer_in: int
) -> None:
    """Greet one client as the gateway does, and send its messages back in pieces of `answer_in`
    bytes.
    """
    connection, _ = listener.accept()
    with connection, connection.makefile("rb") as data:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

        def send(content: bytes) -> None:
            for start in range(0, len(content), answer_in):
                connection.sendall(content[start : start + answer_in])

        send(zmtp.GREETING)
        zmtp.check_greeting(data.read(zmtp.GREETING_BYTES))
        send(zmtp.write_ready())
        parts: list[bytes] = []
        while len(received) < number:
            flags = zmtp.read_flags(data.read(zmtp.HEAD_BYTES)[0])
            body = data.read(zmtp.read_size(data.read(flags.size_bytes)))
            if flags.is_command:
                name, content = zmtp.read_command(body)
                assert name == b"READY"
                zmtp.check_ready(content)
                continue
            parts.append(body)
            if not flags.has_more:
                received.append(parts)
                send(zmtp.write_message(parts))
                parts = []
        data.read(1)  # returns when the client has its last answer, and disconnects


@pytest.mark.parametrize("answer_in", [1, 7, 10**6])
def test_libzmq_reads_what_is_written_and_writes_what_is_read(answer_in: int) -> None:
    messages = [[b""], [b"", b"x"], [b"a" * 255], [b"a" * 256, b"b", b""], [bytes(70_000)]]
    received: list[list[bytes]] = []
    with socket.create_server(("127.0.0.1", 0)) as listener:
        args = listener, received, len(messages), answer_in
        serving = threading.Thread(target=serve_one, args=args, daemon=True)
        serving.start()
        with zmq.Context() as context, context.socket(zmq.DEALER) as client:
            client.setsockopt(zmq.LINGER, 0)
            client.setsockopt(zmq.RCVTIMEO, 30_000)
            client.connect(f"tcp://127.0.0.1:{listener.getsockname()[1]}")
            for message in messages:
                client.send_multipart(message)
                assert client.recv_multipart() == message
        serving.join(30)
    assert received == messages
    assert not serving.is_alive()
