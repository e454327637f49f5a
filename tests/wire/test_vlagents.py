"""Replies of vlagents' servers: the actions in them, or an error of ours."""

from __future__ import annotations

import contextlib
import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from many import many

from vlagents_ray.errors import InvalidInput
from vlagents_ray.wire import json_numpy, rpyc, vlagents


def test_the_gripper_is_the_last_column_and_each_robot_has_its_own_rows() -> None:
    step = {"left": {"action": np.ones(2), "gripper": 0.5, "done": False, "info": {}}, "right": {"action": [3.0]}}
    found = vlagents.read_actions(json_numpy.dumps({"acts": [step, step]}))
    assert found["left"].tolist() == [[1, 1, 0.5]] * 2
    assert found["right"].tolist() == [[3]] * 2


@pytest.mark.parametrize(
    "acts",
    [
        None,
        [],
        [1],
        [{}],
        [{"a": 1}],
        [{"a": {"action": "x"}}],
        [{"a": {"action": [[1.0]]}}],
        [{"a": {"action": [1.0], "gripper": "open"}}],
        [{"a": {"action": [1.0]}}, {"b": {"action": [1.0]}}],
        [{"a": {"action": [1.0]}}, {"a": {"action": [1.0, 2.0]}}],
    ],
)
def test_what_is_no_action_is_refused(acts: Any) -> None:
    with pytest.raises(InvalidInput):
        vlagents.read_actions(json.dumps({"acts": acts}))


@given(st.binary(max_size=80), st.booleans())
@settings(max_examples=many(500))
def test_any_bytes_are_a_reply_or_an_error_of_ours(data: bytes, compressed: bool) -> None:
    with contextlib.suppress(InvalidInput):
        vlagents.read_result(data + rpyc.END, compressed, 1000)


@given(st.recursive(st.none() | st.integers(-(2**60), 2**60) | st.text(max_size=5), lambda one: st.tuples(one, one)))
@settings(max_examples=many(200))
def test_any_content_is_a_value_or_an_error_of_ours(content: Any) -> None:
    for kind in (2, 3):
        with contextlib.suppress(InvalidInput):
            vlagents.read_result(bytes([kind]) + rpyc.write_brine((1, content)) + rpyc.END, False, 10_000)
