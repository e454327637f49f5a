"""This package's reader of WebSocket frames compared with that of `websockets`: the same events,
answers and errors, for any bytes.
"""

from __future__ import annotations

import secrets
from collections.abc import Iterable

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from many import many
from websockets import frames, utils
from websockets.client import ClientProtocol
from websockets.frames import Frame, Opcode
from websockets.protocol import Protocol, State
from websockets.server import ServerProtocol
from websockets.uri import parse_uri

from vlagents_ray.protocol.websocket_frames import ReceiveBuffer, frame_head

LIMIT = 100_000
MASK = b"\x01\x80\x00\xff"
SIZES = st.integers(0, 3000) | st.sampled_from(
    [125, 126, 1023, 1024, 1025, 2**16 - 1, 2**16, 100_000]
)


def connected(*, is_server: bool = True) -> tuple[Protocol, ReceiveBuffer]:
    """Return a protocol after its handshake, and the buffer that is its reader."""
    protocol = opened(is_server=is_server)
    received = ReceiveBuffer(LIMIT)
    received.attach(protocol)
    return protocol, received


def opened(*, is_server: bool) -> Protocol:
    protocol = (
        ServerProtocol(max_size=LIMIT)
        if is_server
        else ClientProtocol(parse_uri("ws://a/"), max_size=LIMIT)
    )
    protocol.state = State.OPEN
    protocol.parser = Protocol.parse(protocol)  # the parser so far reads a handshake
    next(protocol.parser)
    return protocol


def outcome(protocol: Protocol) -> tuple[object, ...]:
    """Return the visible state of a protocol after it has received bytes."""
    events = [
        (one.opcode, bytes(one.data), one.fin)
        for one in protocol.events_received()
        if isinstance(one, Frame)
    ]
    error = repr(protocol.parser_exc)
    return (
        events,
        protocol.data_to_send(),
        protocol.state,
        protocol.close_rcvd,
        protocol.close_sent,
        error,
    )


def serialized(head: int, data: bytes, *, mask: bytes, length: int = 0) -> bytes:
    """Return a frame with any first byte. Its length field takes at least `length` bytes after the
    second byte.
    """
    size = len(data)
    bit = 0x80 * bool(mask)
    if size < 126 and not length:
        start = bytes([head, bit | size])
    elif size < 2**16 and length < 8:
        start = bytes([head, bit | 126]) + size.to_bytes(2, "big")
    else:
        start = bytes([head, bit | 127]) + size.to_bytes(8, "big")
    return start + mask + (utils.apply_mask(data, mask) if mask else data)


BINARY, PART, LAST, PING, PONG, CLOSE = 0x82, 0x02, 0x80, 0x89, 0x8A, 0x88
HEADS = st.sampled_from([*[BINARY] * 8, PART, LAST, 0x00, 0x81, PING, PONG, CLOSE]) | st.integers(
    0, 255
)
# An integer stands for this number of zeros.
DATA = st.binary(max_size=130) | st.sampled_from([b"\x03\xe8bye", 1025, 70_000, LIMIT, LIMIT + 1])
FRAMES = st.tuples(
    HEADS, DATA, st.sampled_from([True] * 9 + [False]), st.sampled_from([0] * 8 + [2, 8])
)
NO_MASK = bytes(4)  # the mask of this package's client, which changes nothing


@pytest.mark.slow
@settings(max_examples=many(400))
@given(
    st.booleans(),
    st.lists(FRAMES, max_size=6),
    st.binary(max_size=20),
    st.lists(st.integers(1, 300), max_size=6),
    st.sampled_from([MASK, NO_MASK]),
)
# A message within another one.
@example(True, [(PART, b"a", True, 0), (BINARY, b"b", True, 0)], b"", [], MASK)
@example(
    False,
    [(PART, b"a", True, 0), (PING, b"", True, 0), (LAST, b"b", True, 0), (BINARY, b"c", True, 0)],
    b"",
    [],
    MASK,
)
@example(
    True,
    [(BINARY, b"a", True, 0), (CLOSE, b"\x03\xe8", True, 0), (BINARY, b"b", True, 0)],
    b"",
    [],
    MASK,
)
@example(True, [(BINARY, b"not masked", False, 0)], b"", [], MASK)
@example(False, [(BINARY, b"masked", False, 0)], b"", [], MASK)
@example(True, [], b"\x82\x01a1234", [], MASK)  # as long as a masked frame
@example(False, [], b"\x82\x81a", [], MASK)  # as long as an unmasked frame
@example(True, [(0xC2, b"compressed", True, 0)], b"", [], MASK)
@example(True, [(BINARY, b"a long length", True, 8)], b"", [], MASK)
def test_any_bytes_have_the_same_effect_as_on_the_parser_of_websockets(
    is_server: bool,
    sent: list[tuple[int, bytes | int, bool, int]],
    garbage: bytes,
    sizes: list[int],
    mask: bytes,
) -> None:
    pieces = [
        serialized(head, bytes(data), mask=mask if right is is_server else b"", length=size)
        for head, data, right, size in sent
    ]
    pieces.append(garbage)
    ours, received = connected(is_server=is_server)
    theirs = opened(is_server=is_server)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(secrets, "token_bytes", bytes)  # the random masks of a client's answers
        for piece in cut(pieces, sizes):
            received.parse(piece)
            theirs.receive_data(bytes(piece))
            assert outcome(ours) == outcome(theirs)
        ours.receive_eof()
        theirs.receive_eof()
        assert outcome(ours) == outcome(theirs)


def cut(pieces: Iterable[bytes], sizes: list[int]) -> Iterable[memoryview]:
    """Yield the pieces, or parts of them that end at multiples of one of `sizes`, always in the
    same memory.
    """
    memory = memoryview(bytearray(2**20))
    for number, piece in enumerate(pieces):
        step = sizes[number % len(sizes)] if sizes and number % 2 else max(1, len(piece))
        for start in range(0, len(piece), step):
            part = piece[start : start + step]
            memory[: len(part)] = part
            yield memory[: len(part)]


@pytest.mark.parametrize("mask", [frames.apply_mask, utils.apply_mask], ids=["in C", "in Python"])
@settings(max_examples=many(40))
@given(
    st.lists(SIZES, min_size=1, max_size=5),
    st.lists(st.integers(1, 5000), min_size=1, max_size=20),
    st.randoms(),
)
def test_the_pieces_of_a_stream_make_no_difference(
    mask, sizes: list[int], pieces: list[int], random
) -> None:
    sent = [random.randbytes(size) for size in sizes]
    stream = b"".join(Frame(Opcode.BINARY, message).serialize(mask=True) for message in sent)
    protocol, received = connected()
    messages = []
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(frames, "apply_mask", mask)
        for part in cut([b"", stream], pieces):
            received.parse(part)
            messages += [
                event.data for event in protocol.events_received() if isinstance(event, Frame)
            ]
    assert messages == sent
    assert received.size == 0


def test_the_rest_of_a_frame_is_not_taken_for_a_frame() -> None:
    protocol, received = connected()
    message = Frame(Opcode.BINARY, b"a message that looks like a frame").serialize(mask=True)
    received.parse(memoryview(bytes([0x82, 0x80 | len(message), 0, 0, 0, 0])))
    assert received.size == 0  # the parser has already read the head
    received.parse(memoryview(message))
    assert [event.data for event in protocol.events_received() if isinstance(event, Frame)] == [
        message
    ]


def test_the_end_within_a_message_is_noticed() -> None:
    protocol, received = connected()
    received.parse(Frame(Opcode.BINARY, bytes(5000)).serialize(mask=True)[:-1])
    assert received.size == 4999
    protocol.receive_eof()
    assert isinstance(protocol.parser_exc, EOFError)


@pytest.mark.parametrize("size", [0, 125, 126, 2**16 - 1, 2**16])
@pytest.mark.parametrize("mask", [b"", MASK, NO_MASK])
def test_a_head_is_that_of_websockets(size: int, mask: bytes) -> None:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(secrets, "token_bytes", lambda _: mask)
        whole = Frame(Opcode.BINARY, bytes(size)).serialize(mask=bool(mask))
    assert frame_head(size, mask) == whole[: len(whole) - size]
