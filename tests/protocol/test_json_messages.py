"""JSON messages, with separate images as curl sends them, and with values in the form of
recordings.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from vlagents_ray.errors import (
    InvalidInput,
    InvalidObservation,
    MalformedMessage,
    MessageTooLarge,
    NotReset,
)
from vlagents_ray.images.jpeg_png import encode_jpeg
from vlagents_ray.interface import Act
from vlagents_ray.protocol.json_messages import problem, reply_to_json, request_from_parts
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Budget, MessageLimits, Reply
from vlagents_ray.protocol.values import from_text, require_plain, to_text
from vlagents_ray.wire import json_numpy

IMAGE = np.full((16, 16, 3), 200, np.uint8)


@pytest.mark.parametrize(
    ("values", "reason"), [(300_000, "values in its JSON"), (1_000_000, "bytes of JSON")]
)
def test_a_long_document_is_refused_unread(values: int, reason: str) -> None:
    document = b'{"info":{"a":[' + b"[]," * values + b"1]}}"
    with pytest.raises(MessageTooLarge, match=reason):
        request_from_parts("act", document, {}, Budget(MessageLimits()))


def test_a_request_is_read_from_json_and_images() -> None:
    document = {
        "instruction": "push",
        "gripper": 1,
        "state": {"joints": [0, 1.5]},
        "info": {"a": [1]},
        "kwargs": {"seed": 3},
    }
    request = request_from_parts(
        "reset", json.dumps(document), {"front": encode_jpeg(IMAGE)}, Budget(DEFAULT_LIMITS)
    )
    assert request.instruction == "push"
    assert request.kwargs == {"seed": 3}
    assert request.obs.gripper == 1.0
    assert request.obs.state["joints"].dtype == np.float32
    np.testing.assert_allclose(request.obs.state["joints"], [0, 1.5])
    np.testing.assert_allclose(request.obs.cameras["front"], IMAGE, atol=3)


@pytest.mark.parametrize(
    ("text", "images", "error"),
    [
        ("{", {}, MalformedMessage),
        ("[]", {}, MalformedMessage),
        ("[" * 30_000, {}, MalformedMessage),
        ('{"instruction": "\\ud800"}', {}, MalformedMessage),
        ('{"state": {"\\udfff": [1]}}', {}, MalformedMessage),
        (b'{"instruction": "\xed\xa0\x80"}', {}, MalformedMessage),
        ('{"instructions": "x"}', {}, MalformedMessage),
        ('{"cameras": {}}', {}, MalformedMessage),
        ('{"state": {"joints": {"x": 1}}}', {}, MalformedMessage),
        ('{"state": {"joints": [true]}}', {}, InvalidObservation),
        ("{}", {"front": b"GIF89a"}, MalformedMessage),
        ("{}", {"front": b""}, MalformedMessage),
        ("{}", {"front": encode_jpeg(IMAGE)[:-20]}, MalformedMessage),
        ("{}", {str(i): b"" for i in range(99)}, MessageTooLarge),
    ],
)
def test_each_fault_has_its_error(text: str | bytes, images: dict, error: type[Exception]) -> None:
    with pytest.raises(error):
        request_from_parts("act", text, images, Budget(MessageLimits()))


def test_a_reply_becomes_plain_json() -> None:
    info = {
        "array": np.arange(2),
        "bytes": b"abc",
        "scalar": np.float32(0.5),
        "deep": [{"x": np.zeros(1)}],
    }
    document = json.loads(
        json.dumps(reply_to_json(Reply("r", Act(np.zeros((2, 3), np.float32), True, info))))
    )
    assert document["action"] == [[0, 0, 0], [0, 0, 0]]
    assert document["done"] is True
    assert document["info"] == {
        "array": [0, 1],
        "bytes": "YWJj",
        "scalar": 0.5,
        "deep": [{"x": [0.0]}],
    }


def test_a_number_that_json_does_not_have_becomes_none() -> None:
    nan, inf = float("nan"), float("inf")
    info = {
        "loss": nan,
        "scalar": np.float32(inf),
        "list": [1.0, -inf],
        "array": np.array([[1, nan], [inf, 2]]),
    }
    document = reply_to_json(Reply("r", Act(np.zeros(3, np.float32), info=info)))
    assert document["info"] == {
        "loss": None,
        "scalar": None,
        "list": [1, None],
        "array": [[1, None], [None, 2]],
    }


def test_a_problem_names_its_stable_code() -> None:
    document = problem(NotReset("reset first"), "r7")
    assert (document["status"], document["code"], document["request_id"]) == (
        409,
        "not_reset",
        "r7",
    )


def read(text: str) -> Any:
    return from_text(text, Budget(DEFAULT_LIMITS))


def test_a_text_has_the_same_values() -> None:
    array = np.arange(6, dtype=np.float32).reshape(2, 3)
    found = read(
        to_text(
            {
                "seed": 7,
                "why": "späť",
                "none": None,
                "list": [1.5, True],
                "raw": b"\x00\xff",
                "array": array,
            }
        )
    )
    assert found["array"].dtype == np.float32
    np.testing.assert_array_equal(found.pop("array"), array)
    assert found == {
        "seed": 7,
        "why": "späť",
        "none": None,
        "list": [1.5, True],
        "raw": b"\x00\xff",
    }
    assert math.isnan(read(to_text({"x": math.nan}))["x"])


SHALLOW = MessageLimits(depth=3)
READERS: dict[str, Callable[[Any], object]] = {
    "text": lambda value: from_text(to_text(value), Budget(SHALLOW)),
    "json-numpy": lambda value: json_numpy.loads(json.dumps(value), SHALLOW),
    "another protocol": lambda value: require_plain(value, SHALLOW.depth),
}
CONTAINERS: dict[str, Callable[[Any], Any]] = {
    "lists": lambda value: [value],
    "dicts": lambda value: {"a": value},
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("container", CONTAINERS)
def test_values_are_read_up_to_the_allowed_depth(reader: str, container: str) -> None:
    value: Any = 1
    for _ in range(SHALLOW.depth):
        value = CONTAINERS[container](value)
        READERS[reader](value)
    with pytest.raises(InvalidInput, match="nested"):
        READERS[reader](CONTAINERS[container](value))


def test_numbers_and_words_stay_readable() -> None:
    assert json.loads(to_text({"seed": 7, "task": "stack"})) == {
        "value": {"seed": 7, "task": "stack"}
    }


@pytest.mark.parametrize(
    "text",
    [
        "",
        "7",
        "[]",
        "{}",
        "[" * 100_000,
        '{"value": {"$": ["nd", 3, "<f4", [2]]}}',
        '{"value": {"$": ["nd", 0, "<f4", [2]]}, "blobs": ["AAAA"]}',
        '{"value": 1, "blobs": ["*"]}',
    ],
)
def test_other_texts_are_refused(text: str) -> None:
    with pytest.raises(MalformedMessage):
        read(text)


def test_an_object_has_no_text() -> None:
    with pytest.raises(InvalidInput):
        to_text({"x": object()})
