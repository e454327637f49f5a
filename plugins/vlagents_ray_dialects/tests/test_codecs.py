"""Tests of the codecs of other systems' messages: round trips are exact, and errors name the
invalid field.
"""

from __future__ import annotations

import base64
import contextlib
import json
import random
import tracemalloc
from collections.abc import Callable
from typing import Any

import gr00t_client
import msgpack
import numpy as np
import pytest
from hostile_messages import mutated
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from many import many
from rpyc_client import call, document

from vlagents_ray.errors import InvalidInput, MalformedMessage, MessageTooLarge, VLAgentsError
from vlagents_ray.images.jpeg_png import encode_jpeg, encode_png
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Budget, MessageLimits
from vlagents_ray_dialects.messages import gr00t, rpyc, vlagents
from vlagents_ray_dialects.messages import openpi as openpi_codec
from vlagents_ray_dialects.messages import openvla as openvla_codec
from vlagents_ray_dialects.messages import vla_eval as vla_eval_codec
from vlagents_ray_dialects.vlagents import SharedMemory

IMAGE = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)
OBS = {
    "observation/image": IMAGE,
    "state": np.arange(8.0),
    "prompt": "lift",
    "nested": {"a": [1, 2.5, None, True]},
}
SMALL = MessageLimits(body_bytes=20_000, pixels=64 * 64, items=200, depth=4)

arrays = hnp.arrays(
    dtype=st.sampled_from([np.dtype(t) for t in ("?", "u1", "i2", "i8", "f2", "f4", "f8")]),
    shape=hnp.array_shapes(min_dims=0, max_dims=3, max_side=5),
)
plain = (
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False)
    | st.text(max_size=8)
)
names = st.text(max_size=8).filter(lambda name: not name.startswith("__") and name != "encoded")
messages = st.dictionaries(
    names,
    st.recursive(
        plain | arrays,
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(names, inner, max_size=3),
        max_leaves=16,  # The nesting stays within the limits.
    ),
    max_size=4,
)


def as_openvla(value: Any) -> bytes:
    def node(item: Any) -> Any:
        return json.loads(openvla_codec.encode(item, twice=False))

    return json.dumps(value, default=node).encode()


def from_vla_eval(data: bytes, limits: MessageLimits = DEFAULT_LIMITS) -> dict[str, Any]:
    return vla_eval_codec.decode_images(vla_eval_codec.decode(data, limits).payload, Budget(limits))


def as_vla_eval(value: Any) -> bytes:
    return vla_eval_codec.encode(vla_eval_codec.VlaEvalMessage("observation", value, 3))


DECODERS: dict[str, tuple[Callable[[Any], bytes], Callable[[bytes, MessageLimits], Any]]] = {
    "openpi": (openpi_codec.encode, openpi_codec.decode),
    "openvla": (as_openvla, lambda data, limits: openvla_codec.decode(data, limits)[0]),
    "vla_eval": (as_vla_eval, lambda data, limits: vla_eval_codec.decode(data, limits).payload),
}
each = pytest.mark.parametrize("dialect", sorted(DECODERS))


def require_equal(a: Any, b: Any) -> None:
    if isinstance(a, np.ndarray):
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    elif isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            require_equal(a[key], b[key])
    elif isinstance(a, list):
        assert len(a) == len(b)
        for one, other in zip(a, b, strict=True):
            require_equal(one, other)
    else:
        assert a == b


@each
@given(value=messages)
def test_a_message_comes_back_as_it_was(dialect: str, value: dict[str, Any]) -> None:
    encode, decode = DECODERS[dialect]
    require_equal(value, decode(encode(value), MessageLimits()))


def read_gr00t(data: bytes, limits: MessageLimits) -> gr00t.Observations:
    return gr00t.read_observations(gr00t.read_request(data, limits).data)


def as_gr00t(encode: Callable[[Any], Any]) -> bytes:
    seen = {
        "video": {"ego": IMAGE[None, None]},
        "state": {"arm": np.zeros((1, 1, 2))},
        "language": {"task": [["go"]]},
    }
    return msgpack.packb({"endpoint": "get_action", "data": {"observation": seen}}, default=encode)


def read_vlagents(data: bytes, limits: MessageLimits) -> vlagents.ObservationRequest:
    return vlagents.read_act(
        data.decode(errors="replace"), Budget(limits), SharedMemory(same_machine=False)
    )


MESSAGES: dict[str, tuple[bytes, Callable[[bytes, MessageLimits], Any]]] = {
    **{name: (encode(OBS), decode) for name, (encode, decode) in DECODERS.items()},
    "gr00t": (as_gr00t(gr00t_client.encode), read_gr00t),
    "gr00t, packed": (as_gr00t(gr00t_client.encode_packed), read_gr00t),
    "vlagents": (document(side=2).encode(), read_vlagents),
    "rpyc": (
        call("act", "text", "more")[rpyc.HEADER.size :],
        lambda data, _: rpyc.read_call(data, False, 2**16),
    ),
    "rpyc, compressed": (
        call("x" * 10_000)[rpyc.HEADER.size :],
        lambda data, _: rpyc.read_call(data, True, 2**16),
    ),
    "rpyc, reply": (
        rpyc.reply(1, "text")[rpyc.HEADER.size :],
        lambda data, _: vlagents.read_result(data, False, 1000),
    ),
    "rpyc, reply, compressed": (
        rpyc.reply(1, "x" * 10_000)[rpyc.HEADER.size :],
        lambda data, _: vlagents.read_result(data, True, 2**16),
    ),
}
any_message = pytest.mark.parametrize("message", sorted(MESSAGES))


@any_message
@settings(max_examples=many(200))
@given(data=st.binary(max_size=100))
def test_garbage_is_refused_by_name(message: str, data: bytes) -> None:
    for garbage in (data, data + rpyc.END) if "rpyc" in message else (data,):
        with contextlib.suppress(VLAgentsError):
            MESSAGES[message][1](garbage, SMALL)


@any_message
def test_every_truncation_is_malformed(message: str) -> None:
    data, decode = MESSAGES[message]
    decode(data, MessageLimits())
    for end in range(len(data)):
        with pytest.raises(MalformedMessage):
            decode(data[:end], MessageLimits())


@any_message
def test_a_mutated_message_is_refused_by_name_or_harmless(message: str) -> None:
    data, decode = MESSAGES[message]
    choose, refused, sent = random.Random(7), 0, many(3000)
    for _ in range(sent):
        try:
            decode(mutated(choose, data), SMALL)
        except VLAgentsError:
            refused += 1
    assert refused > sent / 3


@each
def test_limits_hold(dialect: str) -> None:
    encode, decode = DECODERS[dialect]
    deep: Any = 1
    for _ in range(9):
        deep = {"a": deep}
    for value in ({"a": bytes(100).hex() * 200}, {"a": [0] * 300}, {"a": [[]] * 300}, deep):
        with pytest.raises(MessageTooLarge):
            decode(encode(value), SMALL)


def test_few_bytes_do_not_become_much_memory() -> None:
    """In these messages each byte is an empty list, or each list declares a large length."""
    lists = b"\xdd" + (10_000).to_bytes(4, "big") + (b"\xdc\x27\x0f" + b"\x90" * 9_999) * 2_000
    open_ended = b"\xdd\x00\x00\x27\x0f" * 400
    for data in (lists, open_ended):
        tracemalloc.start()
        with pytest.raises(InvalidInput):
            openpi_codec.decode(data)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 100e6
    with pytest.raises(MessageTooLarge):
        openvla_codec.decode(b'{"a":' + b"[" * 1 + b"[]," * 5_000_000 + b"1]}")


def test_few_bytes_do_not_become_many_texts() -> None:
    def said(texts: int, arrays: int = 1) -> bytes:
        data = ("\u4e00" * texts).encode("utf-32-le")
        return msgpack.packb(
            {f"p{i}": {b"__ndarray__": True, b"data": data, b"dtype": "<U1"} for i in range(arrays)}
        )

    assert len(openpi_codec.decode(said(9_000))["p0"]) == 9_000
    for message in (said(1_000_000), said(900, 20)):
        with pytest.raises(MessageTooLarge, match=r"texts|values"):
            openpi_codec.decode(message)


@pytest.mark.parametrize(
    "dtype", ["|O", "|V8", "<c8", "|S4", "<M8[s]", ">f4", "<f1", "O8", "f4,f4", 3, None]
)
def test_arrays_of_anything_but_numbers_are_refused(dtype: Any) -> None:
    fields = {"data": bytes(8), "dtype": dtype, "shape": [1]}
    with pytest.raises(MalformedMessage):
        openpi_codec.decode(
            msgpack.packb(
                {"a": {k.encode(): v for k, v in fields.items()} | {b"__ndarray__": True}}
            )
        )
    with pytest.raises(MalformedMessage):
        vla_eval_codec.decode(as_vla_eval({"a": fields | {"__ndarray__": True}}))
    with pytest.raises(MalformedMessage):
        openvla_codec.decode(
            json.dumps({"a": {"__numpy__": "AAAAAAAAAAA=", "dtype": dtype, "shape": [1]}}).encode()
        )


@pytest.mark.parametrize("shape", [[2], [-1], [2**62, 4], [2**63, 0], [1.0], "1", None, [1] * 9])
def test_a_shape_must_fit_the_bytes(shape: Any) -> None:
    with pytest.raises(MalformedMessage):
        openpi_codec.decode(
            msgpack.packb(
                {"a": {b"__ndarray__": True, b"data": bytes(4), b"dtype": "<f4", b"shape": shape}}
            )
        )


def test_openpis_scalars_and_texts_are_read() -> None:
    scalar = {b"__npgeneric__": True, b"data": 3, b"dtype": "<f4"}
    text = {
        b"__ndarray__": True,
        b"data": "lift".encode("utf-32-le"),
        b"dtype": "<U4",
        b"shape": [],
    }
    got = openpi_codec.decode(msgpack.packb({"gripper": scalar, "prompt": text}))
    assert (got["gripper"], got["prompt"]) == (np.float32(3), ["lift"])
    for wrong in (
        scalar | {b"data": "3"},
        scalar | {b"dtype": "|O"},
        scalar | {b"dtype": "|u1", b"data": 300},
        text | {b"dtype": "<U0"},
        text | {b"dtype": "<U99999999999"},
        text | {b"data": b"\xff" * 16},
    ):
        with pytest.raises(MalformedMessage):
            openpi_codec.decode(msgpack.packb({"a": wrong}))


def test_extensions_and_keys_that_are_no_text_are_refused() -> None:
    for value in (
        {"a": msgpack.ExtType(4, b"x")},
        {"a": msgpack.Timestamp(1)},
        {1: 2},
        {b"a": 1},
        {None: 1},
        [1],
        3,
    ):
        with pytest.raises(MalformedMessage):
            openpi_codec.decode(msgpack.packb(value))


def test_vla_evals_images_may_be_files() -> None:
    jpeg = {"__image__": True, "format": "jpeg", "data": encode_jpeg(IMAGE, 95), "shape": [6, 8, 3]}
    png = {"__image__": True, "format": "png", "data": encode_png(IMAGE), "shape": [6, 8, 3]}
    raw = {
        "__image__": True,
        "format": "raw",
        "data": IMAGE.tobytes(),
        "dtype": "|u1",
        "shape": [6, 8, 3],
    }
    got = from_vla_eval(as_vla_eval({"images": {"a": jpeg, "b": png, "c": raw}}))["images"]
    assert got["a"].shape == IMAGE.shape
    np.testing.assert_array_equal(got["b"], IMAGE)
    np.testing.assert_array_equal(got["c"], IMAGE)
    for wrong in (
        png | {"data": png["data"][:-40]},
        png | {"format": "gif"},
        png | {"data": "text"},
    ):  # type: ignore[index]
        with pytest.raises(MalformedMessage):
            from_vla_eval(as_vla_eval({"a": wrong}))
    with pytest.raises(MessageTooLarge):
        from_vla_eval(as_vla_eval({"a": png}), MessageLimits(pixels=20))
    with pytest.raises(MessageTooLarge):
        vla_eval_codec.decode(as_vla_eval({"a": [png] * 17}))


@pytest.mark.parametrize(
    "change",
    [
        {"type": "kill"},
        {"type": 3},
        {"type": ["hello"]},
        {"payload": 3},
        {"seq": "1"},
        {"seq": -1},
        {"seq": True},
    ],
)
def test_a_vla_eval_message_has_a_type_a_payload_and_a_number(change: dict[str, Any]) -> None:
    good = {"type": "hello", "payload": {}, "seq": 1, "timestamp": 0.0}
    assert vla_eval_codec.decode(msgpack.packb(good)).kind == "hello"
    with pytest.raises(MalformedMessage):
        vla_eval_codec.decode(msgpack.packb(good | change))
    with pytest.raises(MalformedMessage):
        vla_eval_codec.decode(msgpack.packb({key: good[key] for key in ("type", "payload")}))


def test_openvla_reads_what_is_encoded_twice() -> None:
    payload, twice = openvla_codec.decode(
        json.dumps({"encoded": as_openvla(OBS).decode()}).encode()
    )
    assert twice
    require_equal(OBS, payload)
    assert not openvla_codec.decode(as_openvla(OBS))[1]
    for wrong in (
        {"encoded": "{}", "more": 1},
        {"encoded": 3},
        {"encoded": "[]"},
        {"a": {"__numpy__": 3}},
        {"a": {"__numpy__": "not base64!", "dtype": "|u1", "shape": [1]}},
        {"a": {"__numpy__": base64.b64encode(b"abc").decode()}},
    ):
        with pytest.raises(MalformedMessage):
            openvla_codec.decode(json.dumps(wrong).encode())
    twice_encoded = openvla_codec.encode(np.arange(3.0), twice=True)
    assert json.loads(json.loads(twice_encoded))["shape"] == [3]
