"""Messages of a gateway's client are complete however they are split, and count as in flight
until then.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import socket
import time
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vlagents_ray.errors import MessageTooLarge, Overloaded
from vlagents_ray.serve.engine.admission import Admission
from vlagents_ray_dialects.client_reader import ClientReader, share_of

# The socket of the client, and the socket of the gateway.
Pair = tuple[socket.socket, socket.socket]


@contextlib.contextmanager
def connected() -> Iterator[Pair]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        client = socket.create_connection(listener.getsockname())
        connection, _ = listener.accept()
    with client, connection:
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        yield client, connection


@pytest.fixture
def pair() -> Iterator[Pair]:
    with connected() as pair:
        yield pair


def read(reader: ClientReader, length: int, silent_s: float = 10.0) -> memoryview | None:
    return reader.read(length, silent_s, time.monotonic() + 10)


@given(
    st.lists(st.binary(min_size=1, max_size=50), min_size=1, max_size=8),
    st.lists(st.integers(1, 60), min_size=1),
)
def test_messages_are_complete_however_they_are_split(
    messages: list[bytes], sizes: list[int]
) -> None:
    admission = Admission(2**20)
    stream = io.BytesIO(b"".join(messages))
    with connected() as (client, connection):
        reader = ClientReader(connection, admission, robot=True)
        for size in itertools.cycle(sizes):
            if not (part := stream.read(size)):
                break
            client.sendall(part)
        assert [bytes(read(reader, len(message)) or b"") for message in messages] == messages
    assert admission.held == 0


@pytest.mark.parametrize("length", [1000, 2**20])
def test_an_incomplete_message_counts_until_its_client_leaves(pair: Pair, length: int) -> None:
    client, connection = pair
    admission = Admission(2**22)
    reader = ClientReader(connection, admission, robot=True)
    client.sendall(bytes(length - 1))
    client.shutdown(socket.SHUT_WR)
    with pytest.raises(ConnectionResetError):
        read(reader, length)
    assert admission.held == 0
    assert read(reader, 1) is None


def test_a_message_without_room_is_read_to_its_end_and_the_next_is_complete(pair: Pair) -> None:
    client, connection = pair
    admission = Admission(100_000)
    reader = ClientReader(connection, admission, robot=True)
    client.sendall(bytes(200_000) + b"next")
    with pytest.raises(Overloaded):
        read(reader, 200_000)
    assert read(reader, 4) == b"next"
    assert admission.held == 0


def test_a_client_that_sends_nothing_or_too_slowly_ends(pair: Pair) -> None:
    client, connection = pair
    reader = ClientReader(connection, Admission(2**20), robot=True)
    client.sendall(b"x")
    with pytest.raises(TimeoutError):
        read(reader, 2, silent_s=0.05)
    with pytest.raises(MessageTooLarge):
        reader.read(2, 10, time.monotonic() - 1)


@pytest.mark.parametrize(
    ("family", "address", "share"),
    [
        (socket.AF_INET, ("127.0.0.1", 0), "address 127.0.0.1"),
        (socket.AF_INET6, ("::1", 0), "address ::1"),
        (socket.AF_UNIX, "", "this machine"),
    ],
    ids=["IPv4", "IPv6", "Unix"],
)
def test_a_client_of_each_kind_of_socket_has_a_share(
    family: socket.AddressFamily, address: tuple[str, int] | str, share: str
) -> None:
    """A client that has disconnected also has a share."""
    with socket.socket(family) as listener, socket.socket(family) as client:
        try:
            listener.bind(address)
        except OSError:
            pytest.skip("this machine has no IPv6")
        listener.listen()
        client.connect(listener.getsockname())
        connection, _ = listener.accept()
        with connection:
            assert share_of(connection) == share
            ClientReader(connection, Admission(2**20), robot=True)
        assert share_of(connection) == "address unknown"
