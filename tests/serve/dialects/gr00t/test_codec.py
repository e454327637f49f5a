"""GR00T's messages, of its versions N1.5 and newer."""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Callable
from typing import Any

import gr00t_client
import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vlagents_ray.errors import InvalidObservation, MalformedMessage, MessageTooLarge, VLAgentsError
from vlagents_ray.protocol.messages import Limits
from vlagents_ray.wire import gr00t as gr00t_codec

LIMITS = Limits()


def said(endpoint: str, data: Any = None, encode: Callable[[Any], Any] = gr00t_client.encode, **more: Any) -> bytes:
    """As the client packs it."""
    return msgpack.packb({"endpoint": endpoint, "data": data, **more}, default=encode)


def nested(b: int = 1, t: int = 1, texts: Any = None) -> dict[str, Any]:
    """N1.6 and newer."""
    video = np.arange(b * t, dtype=np.uint8).reshape(b, t, 1, 1, 1) * np.ones((4, 6, 3), np.uint8)
    state = np.arange(b * t, dtype=np.float32).reshape(b, t, 1) * np.ones(2, np.float32)
    return {"video": {"ego": video}, "state": {"arm": state}, "language": {"task": texts or [["go"]] * b}}


@pytest.mark.parametrize("encode", [gr00t_client.encode, gr00t_client.encode_packed])
@pytest.mark.parametrize("dtype", ["|u1", "<f4", "<f8", "<i8", "|b1"])
@pytest.mark.parametrize("shape", [(), (3,), (2, 0, 3), (1, 2, 3, 4)])
def test_arrays_come_as_numpy_writes_them(encode: Callable[[Any], Any], dtype: str, shape: tuple[int, ...]) -> None:
    array = np.ones(shape, dtype)
    request = gr00t_codec.read_request(said("get_action", {"a": array}, encode), LIMITS)
    assert request.packed == (encode is gr00t_client.encode_packed)
    assert request.data["a"].dtype == array.dtype
    assert np.array_equal(request.data["a"], array)


def test_a_fortran_array_and_text_arrays_are_read() -> None:
    array = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    data = gr00t_codec.read_request(said("get_action", {"a": array, "t": np.array(["go"])}), LIMITS).data
    assert np.array_equal(data["a"], array)
    assert data["t"] == ["go"]


def test_observations_of_a_batch_are_taken_apart_and_actions_joined() -> None:
    asked = gr00t_codec.read_observations({"observation": nested(3, 2, [["a"], ["b"], ["c"]]), "options": None})
    assert (len(asked.each), asked.batched, asked.flat, asked.paired) == (3, True, False, True)
    last = [gr00t_codec.newest(one) for one in asked.each]
    assert [int(one["video"]["ego"].max()) for one in last] == [1, 3, 5]
    assert [one["state"]["arm"].tolist() for one in last] == [[1, 1], [3, 3], [5, 5]]
    assert [one["language"] for one in last] == [{"task": "a"}, {"task": "b"}, {"task": "c"}]
    action, info = gr00t_codec.write_actions([{"arm": np.full((4, 2), i)} for i in range(3)], asked, {"done": []})
    assert action["arm"].shape == (3, 4, 2)
    assert info == {"done": []}


@pytest.mark.parametrize("batched", [True, False])
def test_n1_5_sends_flat_keys_and_gets_the_actions_alone(batched: bool) -> None:
    lead = (1, 1) if batched else (1,)
    data = {
        "video.ego": np.zeros((*lead, 4, 6, 3), np.uint8),
        "state.arm": np.zeros((*lead, 2)),
        "annotation.human.action.task_description": ["go"],
    }
    asked = gr00t_codec.read_observations(data)
    assert (asked.batched, asked.flat, asked.paired) == (batched, True, False)
    assert gr00t_codec.newest(asked.each[0])["language"] == {"task": "go"}
    answer = gr00t_codec.write_actions([{"arm": np.zeros((4, 2))}], asked, {})
    assert answer["action.arm"].shape == ((1, 4, 2) if batched else (4, 2))


@pytest.mark.parametrize(
    "observation",
    [
        {},
        {"video": {"ego": np.zeros((4, 6, 3), np.uint8)}},
        {"video": {"ego": np.zeros((1, 1, 4, 6, 3), np.uint8)}, "state": {"arm": np.zeros((2, 1, 2))}},
        {"video": {"ego": np.zeros((1, 0, 4, 6, 3), np.uint8)}},
        {"video": {"ego": "x"}},
        {"video": {"ego": np.zeros((0, 1, 4, 6, 3), np.uint8)}},
        {"video": [], "state": {"arm": np.zeros((1, 1, 2))}},
        nested(2, 1, [["a"], ["b"], ["c"]]),
        nested() | {"language": {"task": 3}},
        nested() | {"language": {"task": [["a"]], "other": [["b"]]}},
    ],
)
def test_an_observation_that_does_not_fit_is_refused(observation: dict[str, Any]) -> None:
    with pytest.raises(InvalidObservation):
        gr00t_codec.read_observations({"observation": observation})


def npy(header: bytes, content: bytes = b"") -> dict[str, Any]:
    return {
        "__ndarray_class__": True,
        "as_npy": b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + content,
    }


def pickled() -> dict[str, Any]:
    file = io.BytesIO()
    np.save(file, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    return {"__ndarray_class__": True, "as_npy": file.getvalue()}


@pytest.mark.parametrize(
    "array",
    [
        pickled(),
        npy(b"{'descr': '|u1', 'fortran_order': False, 'shape': (999999999999,), }\n"),
        npy(b"{'descr': '|u1', 'fortran_order': False, 'shape': (-1,), }\n"),
        npy(b"{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,), }\n", bytes(4)),
        npy(b"{'descr': '<c16', 'fortran_order': False, 'shape': (1,), }\n", bytes(16)),
        npy(b"(" * 900),
        {"__ndarray_class__": True, "as_npy": "text"},
        {"__ndarray_class__": True},
        {b"nd": True, b"kind": b"O", b"type": "|O", b"shape": [1], b"data": b"pickle"},
        {b"nd": True, b"kind": b"V", b"type": [["a", "<f4"]], b"shape": [1], b"data": bytes(4)},
        {b"nd": True, b"kind": b"", b"type": "<f4", b"shape": [2**40], b"data": bytes(4)},
    ],
)
def test_arrays_that_hold_objects_or_lie_are_refused(array: dict[str, Any]) -> None:
    with pytest.raises(MalformedMessage):
        gr00t_codec.read_request(said("get_action", {"a": array}), LIMITS)


@pytest.mark.parametrize("endpoint", ["kill", "", 3, "get_action2"])
def test_there_is_no_kill(endpoint: Any) -> None:
    with pytest.raises(MalformedMessage, match="endpoint"):
        gr00t_codec.read_request(said(endpoint), LIMITS)


def test_too_many_values_and_too_deep_ones_are_refused() -> None:
    with pytest.raises(VLAgentsError):
        gr00t_codec.read_request(said("get_action", {str(i): {} for i in range(20_000)}), LIMITS)
    with pytest.raises(VLAgentsError):
        gr00t_codec.read_request(said("get_action", {str(i): [0] * 500 for i in range(100)}), LIMITS)
    with pytest.raises(MalformedMessage):
        gr00t_codec.read_request(b"\x91" * 100_000, LIMITS)
    with pytest.raises(MessageTooLarge):
        gr00t_codec.read_request(bytes(2000), Limits(body_bytes=1024))


def test_a_header_made_to_be_searched_for_long_is_refused_at_once() -> None:
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (" + b"1" * 28 + b"x"
    file = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    begun = time.process_time()
    with pytest.raises(MalformedMessage):
        gr00t_codec.read_request(said("get_action", {"a": {"__ndarray_class__": True, "as_npy": file}}), LIMITS)
    assert time.process_time() - begun < 1.0  # each digit doubled it once, 28 take ten seconds


def test_arrays_of_text_count_by_their_texts() -> None:
    with pytest.raises(MessageTooLarge, match="values"):
        gr00t_codec.read_request(said("get_action", {str(i): np.full((60, 100), "x") for i in range(2)}), LIMITS)


@given(st.binary(max_size=300))
def test_garbage_is_refused_by_name(data: bytes) -> None:
    with contextlib.suppress(VLAgentsError):
        gr00t_codec.read_request(data, LIMITS)


@given(st.data())
def test_a_mutated_message_is_read_or_refused(data: st.DataObject) -> None:
    encode = data.draw(st.sampled_from([gr00t_client.encode, gr00t_client.encode_packed]))
    message = bytearray(said("get_action", {"observation": nested(2), "options": None}, encode))
    for _ in range(data.draw(st.integers(1, 4))):
        message[data.draw(st.integers(0, len(message) - 1))] = data.draw(st.integers(0, 255))
    try:
        request = gr00t_codec.read_request(bytes(message[: data.draw(st.integers(1, len(message)))]), LIMITS)
        gr00t_codec.read_observations(request.data)
    except VLAgentsError:
        pass
