"""Values as texts, in which a recording keeps them."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

from vlagents_ray.errors import InvalidInput, MalformedMessage
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Budget
from vlagents_ray.protocol.values import from_text, to_text


def read(text: str) -> Any:
    return from_text(text, Budget(DEFAULT_LIMITS))


def test_a_text_has_the_same_values() -> None:
    array = np.arange(6, dtype=np.float32).reshape(2, 3)
    found = read(
        to_text({"seed": 7, "why": "späť", "none": None, "list": [1.5, True], "raw": b"\x00\xff", "array": array})
    )
    assert found["array"].dtype == np.float32
    np.testing.assert_array_equal(found.pop("array"), array)
    assert found == {"seed": 7, "why": "späť", "none": None, "list": [1.5, True], "raw": b"\x00\xff"}
    assert math.isnan(read(to_text({"x": math.nan}))["x"])


def test_numbers_and_words_stay_readable() -> None:
    assert json.loads(to_text({"seed": 7, "task": "stack"})) == {"value": {"seed": 7, "task": "stack"}}


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
