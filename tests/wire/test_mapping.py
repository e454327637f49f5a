"""Another system's keys become an `Obs`, or an error that names the key; this package's action
becomes the other system's.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.errors import (
    ConfigError,
    InvalidAction,
    InvalidObservation,
    MessageTooLarge,
    MissingCamera,
    MissingState,
    VLAgentsError,
)
from vlagents_ray.protocol.messages import MessageLimits
from vlagents_ray.serve.config.dialects import presets, read_mapping
from vlagents_ray.wire.mapping import KeyMapping

IMAGE = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)
LIBERO = {
    "observation/image": IMAGE,
    "observation/wrist_image": IMAGE[::-1],
    "observation/state": np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0, 0.02, -0.02]),
    "prompt": "close the drawer",
}


def test_openpi_libero_becomes_an_observation() -> None:
    obs, instruction = presets()["openpi-libero"].obs(LIBERO)
    assert instruction == "close the drawer"
    np.testing.assert_array_equal(obs.cameras["front"], IMAGE)
    np.testing.assert_array_equal(obs.cameras["wrist"], IMAGE[::-1])
    np.testing.assert_allclose(obs.state["xyz_axis_angle"], [0.1, 0.2, 0.3, 1, 2, 3], rtol=1e-6)
    np.testing.assert_allclose(obs.state["gripper_qpos"], [0.02, -0.02], rtol=1e-6)
    assert obs.state["gripper_qpos"].dtype == np.float32
    assert obs.gripper == pytest.approx(0.5)


def test_droids_gripper_is_closed_at_one_and_may_be_a_scalar() -> None:
    droid = {
        "observation/exterior_image_1_left": IMAGE,
        "observation/wrist_image_left": IMAGE,
        "observation/joint_position": np.arange(7.0),
        "observation/gripper_position": np.float64(0.25),
        "prompt": "wipe",
    }
    obs, _ = presets()["openpi-droid"].obs(droid)
    assert obs.gripper == pytest.approx(0.75)
    assert obs.state["joints"].tolist() == list(range(7))


def test_aloha_images_are_turned_from_channels_first_and_nested_keys_are_found() -> None:
    aloha = {
        "state": np.arange(14.0),
        "images": {"cam_high": IMAGE.transpose(2, 0, 1)},
        "prompt": "insert",
    }
    obs, _ = presets()["openpi-aloha"].obs(aloha)
    np.testing.assert_array_equal(obs.cameras["front"], IMAGE)
    assert list(obs.cameras) == ["front"]
    assert obs.state["right/joints"].tolist() == [7, 8, 9, 10, 11, 12]
    assert obs.state["right/gripper"].tolist() == [13]


def test_no_camera_is_missed_that_a_mapping_reads(caplog: pytest.LogCaptureFixture) -> None:
    long = "observation/images/" + 2 * "the_camera_that_is_fixed_above_the_table/"
    mapping = KeyMapping.from_json(
        {"cameras": {"front": f"{long}rgb", "*": "video/*", "top": "a|b"}, "info": {"m": "mask"}}
    )
    theirs = {
        f"{long}rgb": IMAGE,
        "video": {"x": IMAGE},
        "b": IMAGE,
        "mask": IMAGE,
        "state": np.ones(3),
    }
    mapping.warn_of_unread_cameras(theirs, "test")
    assert caplog.messages == []
    mapping.warn_of_unread_cameras(theirs | {"c": IMAGE}, "test")
    assert "the cameras ['c'], which" in caplog.text


@pytest.mark.parametrize(
    ("change", "error", "key"),
    [
        ({"observation/image": None}, MissingCamera, "observation/image"),
        ({"observation/state": None}, MissingState, "observation/state"),
        ({"observation/image": IMAGE.astype(np.float32)}, InvalidObservation, "observation/image"),
        ({"observation/image": IMAGE.transpose(1, 2, 0)}, InvalidObservation, "observation/image"),
        ({"observation/image": np.stack([IMAGE, IMAGE])}, InvalidObservation, "observation/image"),
        ({"observation/image": "a picture"}, InvalidObservation, "observation/image"),
        ({"observation/state": np.zeros(5)}, InvalidObservation, "observation/state"),
        ({"observation/state": np.zeros((2, 8))}, InvalidObservation, "observation/state"),
        ({"observation/state": ["0"] * 8}, InvalidObservation, "observation/state"),
        ({"prompt": 3}, InvalidObservation, "prompt"),
        ({"prompt": "x" * 20_000}, MessageTooLarge, "prompt"),
        (
            {"observation/image": np.zeros((70, 70, 3), np.uint8)},
            MessageTooLarge,
            "observation/image",
        ),
    ],
)
def test_what_is_wrong_is_said_with_their_key(
    change: dict[str, Any], error: type[Exception], key: str
) -> None:
    flat = {name: value for name, value in (LIBERO | change).items() if value is not None}
    with pytest.raises(error, match=key):
        presets()["openpi-libero"].obs(flat, MessageLimits(pixels=64 * 64))


def test_an_observation_without_camera_or_state_that_the_mapping_reads_is_refused() -> None:
    with pytest.raises(InvalidObservation, match="which the mapping reads, got"):
        KeyMapping.from_json({"cameras": {"*": "images/*"}, "state": {"*": "proprio/*"}}).obs(
            {"prompt": "pick"}
        )


def test_states_are_joined_in_their_order() -> None:
    mapping = KeyMapping.from_json({"state": {"pose": ["b", {"key": "a", "start": 1}]}})
    obs, instruction = mapping.obs({"a": np.arange(3.0), "b": [9, 8]})
    assert obs.state["pose"].tolist() == [9, 8, 1, 2]
    assert instruction is None


def test_an_observation_is_left_as_it_was() -> None:
    flat = {
        name: value.copy() if isinstance(value, np.ndarray) else value
        for name, value in LIBERO.items()
    }
    presets()["openpi-libero"].obs(flat)
    for name, value in LIBERO.items():
        np.testing.assert_array_equal(flat[name], value)


def test_a_grippers_command_is_turned_to_their_polarity() -> None:
    ours = ActionSpec(dim=7, gripper_open=1.0, gripper_closed=0.0)
    action = np.array([[0, 0, 0, 0, 0, 0, 1.0], [0, 0, 0, 0, 0, 0, 0.0]], np.float32)
    libero = presets()["openpi-libero"].rows(action, ours)
    assert libero[:, 6].tolist() == [-1, 1]
    assert action[:, 6].tolist() == [1, 0]
    # The clients of these presets convert the gripper for LIBERO themselves.
    for openvla in ("openvla", "openvla-oft"):
        assert presets()[openvla].rows(action, ours).tolist() == action.tolist()
        assert presets()[openvla].rows(
            libero, ActionSpec(7, gripper_open=-1.0, gripper_closed=1.0)
        )[:, 6].tolist() == [
            1,
            0,
        ]
    assert presets()["openpi-libero"].rows(action, None).tolist() == action.tolist()
    with pytest.raises(InvalidAction, match="6"):
        presets()["openpi-libero"].rows(np.zeros(3), ours)


def test_an_action_is_split_by_their_names() -> None:
    mapping = read_mapping(
        {"preset": "gr00t", "action": {"arm": {"stop": 6}, "hand": {"start": 6}}}
    )
    parts = mapping.actions(np.arange(14.0).reshape(2, 7))
    assert {name: part.shape for name, part in parts.items()} == {"arm": (2, 6), "hand": (2, 1)}
    assert parts["hand"].ravel().tolist() == [6, 13]
    assert list(presets()["gr00t"].actions(np.zeros(7))) == ["action"]


@pytest.mark.parametrize("name", sorted(presets()))
def test_a_preset_survives_json(name: str) -> None:
    assert KeyMapping.from_json(presets()[name].to_json()) == presets()[name]


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        ("openpi", "openpi-libero"),
        (3, "preset"),
        ({"preset": "nobody"}, "nobody"),
        ({"camera": {}}, "camera"),
        ({"cameras": ["image"]}, "cameras"),
        ({"cameras": {"front": {"key": "image", "layout": "whc"}}}, "layout"),
        ({"cameras": {"front": {"layout": "hwc"}}}, "expected a key of"),
        ({"cameras": {"*": "a*b"}}, "only at the end of a key"),
        ({"state": {"joints": {"key": "state", "stop": 1.5}}}, "stop"),
        ({"state": {"joints": []}}, "empty"),
        ({"gripper": {"key": "state", "open": 1, "closed": 1}}, "same"),
        ({"gripper": {"key": "state", "open": float("nan")}}, "open"),
        ({"instruction": 3}, "instruction"),
        ({"action": {"arm": {"end": 3}}}, "end"),
        ({"action_gripper": {"index": True}}, "index"),
    ],
)
def test_a_wrong_mapping_is_refused_with_what_there_is(bad: Any, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        read_mapping(bad)


def test_what_the_policy_needs_and_the_mapping_lacks_is_listed() -> None:
    needs = Contract(
        {"front": CameraSpec(), "top": CameraSpec()},
        {"joints": StateSpec(7)},
        gripper=True,
        instruction=True,
        action=ActionSpec(dim=6),
    )
    lines = presets()["openvla"].lacks(needs)
    assert [line.partition(":")[0] for line in lines] == [
        "camera 'top'",
        "state 'joints'",
        "gripper",
        "action",
    ]
    assert presets()["openvla"].lacks(None) == []
    assert (
        presets()["vlagents"].lacks(
            Contract({"front": CameraSpec()}, {"joints": StateSpec(7)}, gripper=True)
        )
        == []
    )


junk = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=5) | st.binary(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=6,
)


@given(st.sampled_from(sorted(presets())), st.data())
def test_whatever_lies_at_the_keys_only_our_errors_come_out(name: str, data: st.DataObject) -> None:
    wanted = [
        "image",
        "images",
        "observation/image",
        "observation/state",
        "state",
        "video",
        "prompt",
        "instruction",
    ]
    flat = data.draw(st.dictionaries(st.sampled_from(wanted), junk, max_size=5))
    try:
        presets()[name].obs(flat)
    except VLAgentsError:
        return


@given(junk)
def test_a_mapping_of_junk_is_refused_by_name(value: Any) -> None:
    try:
        read_mapping(value)
    except ConfigError:
        return


@pytest.mark.parametrize(
    "value", [[1e308], np.array([1e308]), 10**400, [10**400], [-(10**400), 1.0]]
)
def test_a_number_too_large_for_float32_is_refused(value: Any) -> None:
    with pytest.raises(InvalidObservation, match="joints"):
        KeyMapping.from_json({"state": {"joints": "joints"}}).obs({"joints": value})
