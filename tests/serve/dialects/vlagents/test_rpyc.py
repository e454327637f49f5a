"""The reader of RPyC: what real clients send, and what nobody may reach."""

from __future__ import annotations

import contextlib
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rpyc_client import LOCAL, REMOTE, ROOT, TUPLE, VALUE, call, request

from vlagents_ray.errors import MalformedMessage, MessageTooLarge, VLAgentsError
from vlagents_ray.wire import rpyc
from vlagents_ray.wire.rpyc import Handler

LIMIT = 2**16


def read(frame: bytes) -> rpyc.RpycCall | None:
    length, compressed = rpyc.read_header(frame[: rpyc.HEADER.size], LIMIT)
    body = frame[rpyc.HEADER.size :]
    assert len(body) == length
    return rpyc.read_call(body, compressed, LIMIT)


values = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**18), 10**18) | st.floats(allow_nan=False) | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=5).map(tuple),
    max_leaves=20,
)


@given(values)
def test_values_come_back_as_they_were(value: object) -> None:
    found = read(request(3, Handler.PING, (VALUE, (value,))))
    assert found == rpyc.RpycCall(3, Handler.PING, (value,))


def test_a_call_of_the_root_is_read_and_long_ones_are_compressed() -> None:
    frame = call("act", "x" * 10_000)
    assert len(frame) < 1000
    assert read(frame) == rpyc.RpycCall(1, Handler.CALLATTR, (rpyc.Reference(rpyc.ROOT), "act", ("x" * 10_000,), ()))


@given(st.binary(max_size=200))
def test_garbage_is_refused_by_name(data: bytes) -> None:
    for compressed in (False, True):
        with contextlib.suppress(VLAgentsError):
            rpyc.read_call(data, compressed, LIMIT)


@given(st.data())
def test_a_mutated_request_is_read_or_refused(data: st.DataObject) -> None:
    body = bytearray(call("act", "some text", "more")[rpyc.HEADER.size :])
    for _ in range(data.draw(st.integers(1, 4))):
        body[data.draw(st.integers(0, len(body) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(VLAgentsError):
        rpyc.read_call(bytes(body), False, LIMIT)


@pytest.mark.parametrize(
    "boxed",
    [
        (REMOTE, ("builtins.function", 1, 2)),  # an object of the client's, to be called back
        (TUPLE, ((REMOTE, ("builtins.list", 1, 2)),)),
        (LOCAL, ("builtins.type", 5, 0)),  # an object of ours that was never handed out
        (LOCAL, (*ROOT[:2], 2)),
        (LOCAL, ("builtins.method", 2, 10**9)),
        (9, ()),
    ],
)
def test_no_object_but_the_root_can_be_named(boxed: tuple) -> None:
    with pytest.raises(rpyc.Refused) as refused:
        read(request(7, Handler.CALL, boxed))
    assert refused.value.sequence == 7


@pytest.mark.parametrize("handler", sorted(set(range(22)) - {int(one) for one in Handler}))
def test_what_reaches_into_objects_is_not_offered(handler: int) -> None:
    """Setting attributes, listing them, pickling, comparing, formatting and the like."""
    with pytest.raises(rpyc.Refused, match="not offered"):
        read(request(1, handler, (TUPLE, ((LOCAL, ROOT),))))


def test_a_compressed_message_may_not_grow_over_the_limit() -> None:
    bomb = zlib.compress(bytes(50 * 2**20))
    with pytest.raises(MessageTooLarge):
        rpyc.read_call(bomb + b"\n", True, LIMIT)
    with pytest.raises(MessageTooLarge):
        rpyc.read_header(rpyc.HEADER.pack(LIMIT + 1, 0), LIMIT)


def test_nesting_and_long_numbers_are_refused() -> None:
    deep = b"\x10" * 5000 + b"\x00"
    for message in (deep, b"\x17\xff\xff\xff\xff" + b"9" * 100, b"\x17\x00\x00\x10\x00" + b"9" * 4096):
        with pytest.raises((MessageTooLarge, MalformedMessage)):
            rpyc.read_call(b"\x01" + message + b"\n", False, LIMIT)


def test_answers_to_what_was_never_asked_are_passed_over() -> None:
    assert read(rpyc.reply(1, "x")) is None
    assert read(rpyc.exception(1, "ValueError", "x")) is None
