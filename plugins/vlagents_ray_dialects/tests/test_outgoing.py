"""Tests of mappings in reverse: a dialect reads our observation back from what a reversed mapping
writes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vlagents_ray.errors import (
    ConfigError,
    InvalidAction,
    InvalidObservation,
    MissingCamera,
    MissingState,
)
from vlagents_ray.interface import Obs
from vlagents_ray.serve.config.dialects import presets, read_mapping
from vlagents_ray.wire.mapping import KeyMapping
from vlagents_ray_dialects.messages.outgoing import Outgoing

IMAGE = np.arange(4 * 5 * 3, dtype=np.uint8).reshape(4, 5, 3)


def outgoing(**mapping: Any) -> Outgoing:
    return Outgoing(KeyMapping.from_json(mapping))


def fitting(mapping: KeyMapping) -> Obs:
    """Return an observation with all values that a preset reads."""
    rng = np.random.default_rng(0)
    state = {}
    for name, parts in mapping.state.items():
        widths = [3 if part.stop is None else part.stop - (part.start or 0) for part in parts]
        state[name.replace("*", "arm")] = rng.uniform(0, 0.04, sum(widths)).astype(np.float32)
    gripper = None if mapping.gripper is None else 0.5
    return Obs({name.replace("*", "ego"): IMAGE for name in mapping.cameras}, gripper, state)


def test_parts_whose_lengths_nothing_says_are_refused_before_anything_is_sent() -> None:
    with pytest.raises(
        ConfigError, match=r"mapping.state.pose: expected at most one part without `stop`, got 2"
    ):
        outgoing(state={"pose": ["a", "b"]})


# The preset gr00t-n1.5 is left out: its keys are made by GR00T's client.
@pytest.mark.parametrize("name", sorted(set(presets()) - {"gr00t-n1.5"}))
def test_what_is_written_by_a_preset_is_read_by_it(name: str) -> None:
    mapping = read_mapping(name)
    obs = fitting(mapping)
    read, instruction = mapping.obs(Outgoing(mapping).observation(obs, "pick it up"))
    assert instruction == "pick it up"
    assert read.cameras.keys() == obs.cameras.keys()
    assert read.state.keys() == obs.state.keys()
    for camera, image in obs.cameras.items():
        np.testing.assert_array_equal(read.cameras[camera], image)
    for part, vector in obs.state.items():
        np.testing.assert_array_equal(read.state[part], vector)


def test_vectors_are_joined_by_their_places() -> None:
    mapping = outgoing(
        state={"joints": {"key": "s", "stop": 2}, "base": {"key": "s", "start": 3, "stop": 4}},
        gripper={"key": "s", "index": 2, "open": 0.08, "closed": 0.0},
    )
    obs = Obs(
        gripper=0.5,
        state={"joints": np.array([1, 2], np.float32), "base": np.array([9], np.float32)},
    )
    np.testing.assert_allclose(mapping.observation(obs, None)["s"], [1, 2, 0.04, 9])


def test_one_vector_is_split_over_several_keys() -> None:
    mapping = outgoing(state={"pose": [{"key": "position", "stop": 3}, {"key": "rotation"}]})
    theirs = mapping.observation(Obs(state={"pose": np.arange(7, dtype=np.float32)}), None)
    assert theirs["position"].tolist() == [0, 1, 2]
    assert theirs["rotation"].tolist() == [3, 4, 5, 6]


def test_channels_go_first_where_the_mapping_says_so() -> None:
    theirs = outgoing(cameras={"front": {"key": "images/a", "layout": "chw"}}).observation(
        Obs({"front": IMAGE}), None
    )
    np.testing.assert_array_equal(theirs["images"]["a"], IMAGE.transpose(2, 0, 1))


@pytest.mark.parametrize(
    ("mapping", "error", "said"),
    [
        ({"cameras": {"front": "image"}}, MissingCamera, "front"),
        ({"state": {"joints": "s"}}, MissingState, "joints"),
        ({"gripper": "g"}, MissingState, "gripper"),
        (
            {"state": {"pose": {"key": "s", "stop": 2}}},
            InvalidObservation,
            "got 3 numbers, the mapping says 2",
        ),
        (
            {"state": {"pose": {"key": "s", "start": 1, "stop": 4}}},
            InvalidObservation,
            r"numbers at \[0\]",
        ),
        (
            {"state": {"pose": {"key": "s", "start": 5000, "stop": 5003}}},
            ConfigError,
            "expected places from 0 to 4096",
        ),
    ],
)
def test_what_does_not_fit_is_refused(
    mapping: dict[str, Any], error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        outgoing(**mapping).observation(Obs(state={"pose": np.ones(3, np.float32)}), None)


def test_arrays_by_name_become_columns() -> None:
    mapping = outgoing(action={"hand": {"start": 2, "stop": 3}, "arm": {"stop": 2}})
    rows = mapping.rows(
        {"arm": np.array([[1.0, 2.0], [4.0, 5.0]]), "hand": np.array([[3.0], [6.0]])}
    )
    assert rows.dtype == np.float32
    assert rows.tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize(
    ("action", "theirs", "said"),
    [
        ({}, {"arm": np.ones((1, 2)), "hand": np.ones((1, 1))}, "list in mapping.action"),
        ({"arm": {"stop": 2}}, {"hand": np.ones((1, 2))}, r"lacks \['arm'\]"),
        (
            {"arm": {"stop": 3}},
            {"arm": np.ones((1, 2))},
            "expected 3 columns, .* in mapping.action, got 2",
        ),
        (
            {"a": {"stop": 1}, "b": {"start": 1}},
            {"a": np.ones((2, 1)), "b": np.ones((3, 1))},
            "number of rows",
        ),
        ({"a": {"start": 1}}, {"a": np.ones((2, 1))}, r"numbers at \[0\]"),
        ({}, np.ones((1, 2, 3)), r"expected \(D,\) or \(H, D\)"),
        ({}, np.array(["text"]), r"expected \(D,\) or \(H, D\)"),
        ({}, None, "got NoneType"),
    ],
)
def test_actions_that_the_mapping_does_not_fit_are_refused(
    action: Any, theirs: Any, said: str
) -> None:
    with pytest.raises(InvalidAction, match=said):
        outgoing(action=action).rows(theirs)


def test_the_contract_says_what_the_mapping_reads() -> None:
    contract = Outgoing(read_mapping("openpi-libero")).contract()
    assert set(contract.cameras or {}) == {"front", "wrist"}
    assert {name: spec.dim for name, spec in (contract.state or {}).items()} == {
        "xyz_axis_angle": 6,
        "gripper_qpos": 2,
    }
    assert contract.gripper is None  # the gripper's number is one of gripper_qpos
    assert contract.instruction
    assert (contract.action.gripper_open, contract.action.gripper_closed) == (-1, 1)
    assert Outgoing(read_mapping("openpi-droid")).contract().gripper
