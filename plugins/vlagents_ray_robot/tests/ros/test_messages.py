"""Tests that messages of ROS 2 are converted to arrays and texts in every layout, and that errors
about invalid messages have a cure.
"""

from __future__ import annotations

import array
import base64
import contextlib
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from many import many

from vlagents_ray.errors import (
    InvalidObservation,
    MalformedMessage,
    MessageTooLarge,
    MissingState,
    VLAgentsError,
)
from vlagents_ray.images.jpeg_png import encode_jpeg, encode_png
from vlagents_ray_robot.ros import messages

RGB = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3) * 7


def image_message(
    pixels: np.ndarray, encoding: str, padding: int = 0, **more: Any
) -> dict[str, Any]:
    """Return an Image with these pixels, (H, W, bytes of a pixel), and unused bytes at the end of
    each row.
    """
    height, width, _ = pixels.shape
    rows = np.pad(pixels.reshape(height, -1), ((0, 0), (0, padding)), constant_values=255)
    said = {
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": rows.shape[1],
    }
    return {**said, "data": rows.tobytes(), **more}


def alpha(pixels: np.ndarray) -> np.ndarray:
    return np.concatenate([pixels, np.full((*pixels.shape[:2], 1), 200, np.uint8)], axis=2)


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", RGB),
        ("bgr8", RGB[..., ::-1]),
        ("rgba8", alpha(RGB)),
        ("bgra8", alpha(RGB[..., ::-1])),
    ],
)
def test_an_image_is_rgb_whatever_the_order_of_its_channels(
    encoding: str, pixels: np.ndarray
) -> None:
    found = messages.image(image_message(pixels, encoding))
    assert found.dtype == np.uint8
    assert found.flags.c_contiguous
    np.testing.assert_array_equal(found, RGB)


def test_greys_are_three_equal_channels_and_16_bits_are_read_in_their_byte_order() -> None:
    grey = RGB[..., :1]
    wanted = np.repeat(grey, 3, axis=2)
    np.testing.assert_array_equal(messages.image(image_message(grey, "mono8", 1)), wanted)
    for big in (0, 1):
        sixteen = (
            (grey.astype(np.uint16) << 8 | 0x34).astype(">u2" if big else "<u2").view(np.uint8)
        )
        np.testing.assert_array_equal(
            messages.image(image_message(sixteen, "mono16", 3, is_bigendian=big)), wanted
        )


@pytest.mark.parametrize(
    "wrapped",
    [
        bytes,
        lambda data: array.array("B", data),
        list,
        lambda data: base64.b64encode(data).decode(),
        memoryview,
        lambda data: np.frombuffer(data, np.uint8),
    ],
)
def test_data_may_be_what_rclpy_or_json_gives(wrapped: Any) -> None:
    message = image_message(RGB, "rgb8")
    message["data"] = wrapped(message["data"])
    np.testing.assert_array_equal(messages.image(message), RGB)
    np.testing.assert_array_equal(messages.image(SimpleNamespace(**message)), RGB)


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1", "bayer_rggb8", "yuv422", "", None])
def test_an_encoding_that_is_no_colour_is_refused_with_the_cure(encoding: Any) -> None:
    with pytest.raises(InvalidObservation, match=r"expected an encoding of \['rgb8'.*got .*depth"):
        messages.image({**image_message(RGB, "rgb8"), "encoding": encoding})


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"step": 8}, "expected 2 rows of 9 bytes.* in rows of 8"),
        ({"data": bytes(17)}, "expected 2 rows of 9 bytes.*got 17 bytes in rows of 9"),
        ({"height": 0, "data": b""}, "whether the camera is on"),
        ({"width": "3"}, "width: expected a whole number, got '3'"),
        ({"height": 3.0}, "height: expected a whole number, got 3.0"),
        ({"data": "no base64!"}, "expected an array of uint8"),
        ({"data": [1, 300]}, "expected an array of uint8"),
        ({"data": None}, "expected an array of uint8"),
    ],
)
def test_an_image_that_is_not_as_large_as_it_says_is_refused(
    wrong: dict[str, Any], said: str
) -> None:
    with pytest.raises(MalformedMessage, match=said):
        messages.image(image_message(RGB, "rgb8", **wrong))


def test_an_image_too_large_is_refused_before_memory_is_taken() -> None:
    with pytest.raises(MessageTooLarge):
        messages.image(image_message(RGB, "rgb8", height=2**31, width=2**31, step=3 * 2**31))


@given(
    height=st.integers(1, 9),
    width=st.integers(1, 9),
    padding=st.integers(0, 9),
    rest=st.integers(0, 9),
    encoding=st.sampled_from(["rgb8", "bgr8", "bgra8", "mono8"]),
)
@settings(max_examples=many(200))
def test_any_stride_gives_the_same_pixels(
    height: int, width: int, padding: int, rest: int, encoding: str
) -> None:
    channels = {"mono8": 1, "bgra8": 4}.get(encoding, 3)
    pixels = np.random.default_rng(height).integers(0, 256, (height, width, channels), np.uint8)
    message = image_message(pixels, encoding, padding)
    message["data"] += bytes(rest)  # some drivers send a longer buffer
    tight = messages.image(image_message(pixels, encoding))
    np.testing.assert_array_equal(messages.image(message), tight)
    assert tight.shape == (height, width, 3)


ANYTHING = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=9)
    | st.binary(max_size=40),
    lambda inside: (
        st.lists(inside, max_size=3) | st.dictionaries(st.text(max_size=4), inside, max_size=3)
    ),
    max_leaves=8,
)
FIELDS = [
    "data",
    "encoding",
    "height",
    "width",
    "step",
    "is_bigendian",
    "name",
    "position",
    "pose",
    "header",
    "format",
]


@given(message=st.dictionaries(st.sampled_from(FIELDS), ANYTHING) | ANYTHING)
@settings(max_examples=many(200))
def test_garbage_is_refused_by_an_error_of_ours(message: Any) -> None:
    for read in (
        messages.image,
        messages.compressed_image,
        messages.joints,
        messages.pose,
        messages.numbers,
        messages.stamp,
    ):
        with contextlib.suppress(VLAgentsError):
            read(message)


def test_a_compressed_image_is_decoded() -> None:
    message = {"format": "rgb8; png compressed bgr8", "data": encode_png(RGB)}
    np.testing.assert_array_equal(messages.compressed_image(message), RGB)
    grey = np.full((16, 16, 3), 90, np.uint8)
    jpeg = {"format": "jpeg", "data": base64.b64encode(encode_jpeg(grey)).decode()}
    assert abs(messages.compressed_image(jpeg).astype(int) - 90).max() <= 2
    with pytest.raises(MalformedMessage, match="expected a JPEG or PNG file"):
        messages.compressed_image({"format": "32FC1; compressedDepth", "data": bytes(40)})


JOINTS = {
    "name": ["b", "c", "a"],
    "position": [2.0, 3.0, 1.0],
    "velocity": array.array("d", [0.2, 0.3, 0.1]),
}


def test_joints_come_in_the_order_that_is_asked_for() -> None:
    np.testing.assert_array_equal(messages.joints(JOINTS, ("a", "b")), np.array([1, 2], np.float32))
    np.testing.assert_array_equal(messages.joints(JOINTS), np.array([2, 3, 1], np.float32))
    np.testing.assert_allclose(
        messages.joints(JOINTS, ("a", "c"), "velocity"), [0.1, 0.3], rtol=1e-6
    )
    assert messages.joints(JOINTS, ("a",)).dtype == np.float32


def test_a_missing_joint_is_an_error_that_names_those_there() -> None:
    with pytest.raises(MissingState, match=r"'d' is missing: got \['a', 'b', 'c'\]"):
        messages.joints(JOINTS, ("a", "d"))


@pytest.mark.parametrize(
    "wrong",
    [
        {"position": [1.0, 2.0]},
        {"position": [1.0, 2.0, None]},
        {"position": [1.0, 2.0, np.inf]},
        {"velocity": []},
    ],
)
def test_joints_without_their_numbers_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(MalformedMessage):
        messages.joints({**JOINTS, **wrong}, ("a",), next(iter(wrong)))  # type: ignore[arg-type]


def pose_message(quaternion: list[float]) -> dict[str, Any]:
    return {
        "position": dict(zip("xyz", [1.0, 2.0, 3.0], strict=True)),
        "orientation": dict(zip("xyzw", quaternion, strict=True)),
    }


def test_a_pose_has_its_rotation_in_the_form_asked_for() -> None:
    quarter = pose_message([0.0, 0.0, 2**-0.5, 2**-0.5])  # a rotation about z
    np.testing.assert_allclose(messages.pose(quarter), [1, 2, 3, 0, 0, 2**-0.5, 2**-0.5], rtol=1e-6)
    stamped = {"header": {}, "pose": quarter}
    np.testing.assert_allclose(
        messages.pose(stamped, "quat_wxyz"), [1, 2, 3, 2**-0.5, 0, 0, 2**-0.5], rtol=1e-6
    )
    np.testing.assert_allclose(
        messages.pose(stamped, "euler_xyz"), [1, 2, 3, 0, 0, np.pi / 2], rtol=1e-6, atol=1e-7
    )
    np.testing.assert_array_equal(messages.pose(quarter, "none"), np.array([1, 2, 3], np.float32))


@given(st.tuples(*[st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1)]))
@settings(max_examples=many(200))
def test_euler_angles_are_those_of_scipy(angles: tuple[float, float, float]) -> None:
    rotation = pytest.importorskip("scipy.spatial.transform").Rotation.from_euler("xyz", angles)
    found = messages.pose(pose_message(rotation.as_quat().tolist()), "euler_xyz")
    np.testing.assert_allclose(found[3:], angles, atol=1e-5)


def test_a_pose_that_nobody_filled_in_is_refused() -> None:
    with pytest.raises(MalformedMessage, match="unit length"):
        messages.pose(pose_message([0.0] * 4))


def test_a_time_stamp_of_zero_or_without_a_header_is_none() -> None:
    assert messages.stamp({"header": {"stamp": {"sec": 12, "nanosec": 500_000_000}}}) == 12.5
    assert messages.stamp({"header": {"stamp": {"sec": 0, "nanosec": 0}}}) is None
    assert messages.stamp({"data": 1.0}) is None
    with pytest.raises(
        MalformedMessage, match=r"header.stamp.sec: expected a whole number, got '12'"
    ):
        messages.stamp({"header": {"stamp": {"sec": "12", "nanosec": 0}}})


def test_actions_become_messages_of_their_type() -> None:
    row = np.array([0.5, -1.0], np.float32)
    assert messages.float64_multi_array(row)["data"] == [0.5, -1.0]
    state = messages.joint_state(row, ("a", "b"), "velocity")
    assert (state["name"], state["velocity"]) == (["a", "b"], [0.5, -1.0])
    assert "position" not in state
    assert messages.twist(row, ("linear.x", "angular.z")) == {
        "linear": {"x": 0.5, "y": 0.0, "z": 0.0},
        "angular": {"x": 0.0, "y": 0.0, "z": -1.0},
    }
    trajectory = messages.joint_trajectory(row, ("a", "b"), 1.25)
    assert trajectory["joint_names"] == ["a", "b"]
    assert trajectory["points"] == [
        {"positions": [0.5, -1.0], "time_from_start": {"sec": 1, "nanosec": 250_000_000}}
    ]
