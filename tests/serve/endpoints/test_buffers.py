"""Whatever the pieces in which frames arrive, and wherever they were read, the same messages come out."""

from __future__ import annotations

import socket

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from many import many
from websockets import frames, utils
from websockets.frames import Frame, Opcode
from websockets.protocol import State
from websockets.server import ServerProtocol

from vlagents_ray.serve.endpoints.buffers import ReceiveBuffer, receive

SIZES = st.integers(0, 3000) | st.sampled_from([125, 126, 1023, 1024, 1025, 2**16 - 1, 2**16, 100_000])


def connected() -> tuple[ServerProtocol, ReceiveBuffer]:
    """Return a protocol after its handshake, and the buffer that is its reader."""
    protocol = ServerProtocol(max_size=2**20)
    protocol.state = State.OPEN
    received = ReceiveBuffer()
    received.attach(protocol)
    return protocol, received


def parsed_messages(stream: bytes, sizes: list[int]) -> list[bytes]:
    """Send the stream in pieces of these sizes, and read each to where the one before was."""
    protocol, received = connected()
    ours, theirs = socket.socketpair()
    messages: list[bytes] = []
    with ours, theirs:
        while stream:
            size = sizes.pop() if sizes else len(stream)
            piece, stream = stream[:size], stream[size:]
            theirs.sendall(piece)
            while piece:
                data, _ = receive(ours, len(piece))
                piece = piece[len(data) :]
                received.parse(data)
                messages += [event.data for event in protocol.events_received() if isinstance(event, Frame)]
    assert received.size == 0
    return messages


@pytest.mark.parametrize("mask", [frames.apply_mask, utils.apply_mask], ids=["in C", "in Python"])
@settings(max_examples=many(40))
@given(st.lists(SIZES, min_size=1, max_size=5), st.lists(st.integers(1, 5000), max_size=20), st.randoms())
def test_the_pieces_of_a_stream_make_no_difference(mask, sizes: list[int], pieces: list[int], random) -> None:
    sent = [random.randbytes(size) for size in sizes]
    stream = b"".join(Frame(Opcode.BINARY, message).serialize(mask=True) for message in sent)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(frames, "apply_mask", mask)
        assert parsed_messages(stream, pieces) == sent


def test_the_end_within_a_message_is_noticed() -> None:
    protocol, received = connected()
    received.parse(Frame(Opcode.BINARY, bytes(5000)).serialize(mask=True)[:-1])
    assert received.size == 4999
    protocol.receive_eof()
    assert isinstance(protocol.parser_exc, EOFError)
