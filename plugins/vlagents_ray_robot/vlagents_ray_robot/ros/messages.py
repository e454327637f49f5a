"""Converts messages of ROS 2 to numbers and images, and actions to messages; ROS is not needed.

A received message is a mapping (from rosbridge) or an object with the same fields (from rclpy). A
message to send is a mapping of its fields. ROS 2's packages `sensor_msgs`, `geometry_msgs`,
`std_msgs` and `trajectory_msgs` define the fields and their units.
"""

from __future__ import annotations

import base64
import binascii
import math
import time
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from vlagents_ray.errors import (
    InvalidObservation,
    MalformedMessage,
    MessageTooLarge,
    MissingState,
    shown,
)
from vlagents_ray.images.jpeg_png import MAX_PIXELS, decode

Values = Literal["position", "velocity", "effort"]
PoseRotation = Literal["quat_xyzw", "quat_wxyz", "euler_xyz", "none"]
# The number of bytes of a pixel by encoding; see `sensor_msgs/image_encodings.hpp`.
_PIXEL = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "mono16": 2}
TWIST = ("linear.x", "linear.y", "linear.z", "angular.x", "angular.y", "angular.z")


def field(message: Any, path: str) -> Any:
    """Return a field of a message.

    Args:
        message: The message.
        path: The field, such as "header.stamp.sec".

    Raises:
        MalformedMessage: The field is missing.
    """
    for name in path.split("."):
        try:
            message = message[name] if isinstance(message, Mapping) else getattr(message, name)
        except (KeyError, AttributeError) as error:
            raise MalformedMessage(
                f"message: expected a field {path!r}, got none; check the topic's type"
            ) from error
    return message


def stamp(message: Any) -> float | None:
    """Return the time in a message's header, s since 1970; None without a header, or with an
    empty one.
    """
    try:
        sec = field(message, "header.stamp.sec")
        nanosec = field(message, "header.stamp.nanosec")
    except MalformedMessage:
        return None
    seconds = _whole("header.stamp.sec", sec)
    nanoseconds = _whole("header.stamp.nanosec", nanosec)
    return (seconds + nanoseconds * 1e-9) or None


def image(message: Any) -> np.ndarray:
    """Return the pixels of a `sensor_msgs/msg/Image`, (H, W, 3) uint8 RGB, as a copy.

    Rows may be longer than their pixels (`step`). The upper 8 bits of "mono16" are used.

    Raises:
        InvalidObservation: The encoding is neither a colour nor a grey encoding.
        MalformedMessage: The size of the data differs from the fields.
        MessageTooLarge: The image has more than 4096 x 4096 pixels.
    """
    encoding = field(message, "encoding")
    if not isinstance(encoding, str) or encoding not in _PIXEL:
        raise InvalidObservation(
            f"image: expected an encoding of {list(_PIXEL)}, got {shown(encoding)}; have the "
            "camera's driver publish rgb8, and do not use a depth topic for a camera"
        )

    height = _whole("height", field(message, "height"))
    width = _whole("width", field(message, "width"))
    step = _whole("step", field(message, "step"))
    data = _bytes("image", field(message, "data"))
    if not (height > 0 and width > 0):
        raise MalformedMessage(
            f"image: expected pixels, got {height} rows of {width}; check whether the camera is on"
        )
    if height * width > MAX_PIXELS:
        raise MessageTooLarge(
            f"image: expected at most {MAX_PIXELS} pixels, got {height} x {width}; let the "
            "camera's driver publish smaller images"
        )

    row_bytes = width * _PIXEL[encoding]
    if step < row_bytes or len(data) < step * height:
        raise MalformedMessage(
            f"image: expected {height} rows of {row_bytes} bytes or more, for {width} pixels of "
            f"{encoding}, got {len(data)} bytes in rows of {step}"
        )

    rows = np.frombuffer(data, np.uint8, step * height).reshape(height, step)[:, :row_bytes]
    pixels = rows.reshape(height, width, _PIXEL[encoding])
    if encoding == "mono16":
        pixels = pixels[..., :1] if field(message, "is_bigendian") else pixels[..., 1:]
    if encoding.startswith("mono"):
        return np.repeat(pixels, 3, axis=2)

    rgb = pixels[..., 2::-1] if encoding.startswith("bgr") else pixels[..., :3]
    return rgb.copy()


def compressed_image(message: Any) -> np.ndarray:
    """Return the pixels of a `sensor_msgs/msg/CompressedImage` with a JPEG or PNG file, (H, W, 3)
    uint8 RGB; raises errors as `decode` does.
    """
    return decode(_bytes("image", field(message, "data")))


def joints(message: Any, names: Sequence[str] = (), values: Values = "position") -> np.ndarray:
    """Return numbers of a `sensor_msgs/msg/JointState` by the names of joints, (len(names),)
    float32.

    Args:
        message: The message, whose order does not matter.
        names: The joints in the order of the result; if empty, all in the message's order.
        values: The field to read: positions (rad or m), velocities or efforts.

    Raises:
        MissingState: The message lacks one of the joints.
        MalformedMessage: Names and numbers differ in count, or a number is not finite.
    """
    received_names = field(message, "name")
    is_sequence = isinstance(received_names, Sequence)
    if not is_sequence or not all(isinstance(name, str) for name in received_names):
        raise MalformedMessage(
            f"name: expected a list of names, got {shown(received_names)}; check the topic's type"
        )

    numbers = _numbers(values, field(message, values))
    if len(numbers) != len(received_names):
        raise MalformedMessage(
            f"joint state: expected {len(received_names)} numbers in {values!r}, as there are "
            f"names, got {len(numbers)}"
        )

    index_of = {name: i for i, name in enumerate(received_names)}
    for name in names:
        if name not in index_of:
            raise MissingState(name, received_names)

    if names:
        numbers = numbers[[index_of[name] for name in names]]
    return _finite(values, numbers)


def pose(message: Any, rotation: PoseRotation = "quat_xyzw") -> np.ndarray:
    """Return position and rotation of a `geometry_msgs/msg/Pose` or `PoseStamped`.

    Args:
        message: The message.
        rotation: The form of the rotation: "quat_xyzw" or "quat_wxyz" (of unit length), "euler_xyz"
            (roll, pitch and yaw about fixed axes, rad), or "none".

    Returns:
        The position in m and the rotation after it, (7,), (6,) or (3,) float32.

    Raises:
        MalformedMessage: A number is not finite, or the quaternion is zero.
    """
    is_stamped = "pose" in message if isinstance(message, Mapping) else hasattr(message, "pose")
    inner_pose = field(message, "pose") if is_stamped else message
    position = _numbers("pose", [field(inner_pose, f"position.{axis}") for axis in "xyz"])
    if rotation == "none":
        return _finite("pose", position)

    components = [field(inner_pose, f"orientation.{axis}") for axis in "xyzw"]
    quaternion = _numbers("pose", components)
    length = float(np.linalg.norm(quaternion))
    if not length > 1e-6:
        raise MalformedMessage(
            f"pose: expected a quaternion of unit length, got {quaternion.tolist()}; check "
            "whether its sender sets the field"
        )

    quaternion = quaternion / length
    if rotation == "quat_wxyz":
        quaternion = quaternion[[3, 0, 1, 2]]

    if rotation == "euler_xyz":
        x, y, z, w = quaternion.tolist()
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = math.asin(min(1.0, max(-1.0, 2 * (w * y - z * x))))
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return _finite("pose", np.array([*position, roll, pitch, yaw]))
    return _finite("pose", np.concatenate([position, quaternion]))


def numbers(message: Any) -> np.ndarray:
    """Return the numbers of a `Float64MultiArray`, `Float32MultiArray`, `Float64` or `Float32`,
    flat, (D,) float32.
    """
    data = field(message, "data")
    if isinstance(data, (int, float)):
        data = [data]
    return _finite("data", _numbers("data", data))


def float64_multi_array(row: np.ndarray) -> dict[str, Any]:
    """Return a `std_msgs/msg/Float64MultiArray` of numbers, (D,)."""
    return {"layout": {"dim": [], "data_offset": 0}, "data": row.astype(np.float64).tolist()}


def joint_state(
    row: np.ndarray, names: Sequence[str], values: Values = "position"
) -> dict[str, Any]:
    """Return a `sensor_msgs/msg/JointState` that commands joints, (D,) in the order of `names`."""
    now = time.time_ns()
    header = {"stamp": {"sec": now // 10**9, "nanosec": now % 10**9}, "frame_id": ""}
    return {"header": header, "name": list(names), values: row.astype(np.float64).tolist()}


def twist(row: np.ndarray, fields: Sequence[str] = TWIST) -> dict[str, Any]:
    """Return a `geometry_msgs/msg/Twist`.

    Args:
        row: The numbers, (D,), m/s and rad/s.
        fields: The fields of the numbers, such as "linear.x"; all others are 0.
    """
    message: dict[str, Any] = {
        "linear": dict.fromkeys("xyz", 0.0),
        "angular": dict.fromkeys("xyz", 0.0),
    }
    for path, number in zip(fields, row.astype(np.float64).tolist(), strict=True):
        vector, axis = path.split(".")
        message[vector][axis] = number
    return message


def joint_trajectory(row: np.ndarray, names: Sequence[str], reach_s: float) -> dict[str, Any]:
    """Return a `trajectory_msgs/msg/JointTrajectory` with one point.

    Args:
        row: The positions of the point, (D,).
        names: The joints of the positions.
        reach_s: The time in which the arm should reach the point, after the controller receives
            the message, s.
    """
    nanoseconds = round(reach_s * 1e9)
    point = {
        "positions": row.astype(np.float64).tolist(),
        "time_from_start": {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9},
    }
    # Controllers interpret a stamp of zero as the present.
    now = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    return {"header": now, "joint_names": list(names), "points": [point]}


def _whole(name: str, value: Any) -> int:
    """Return the whole number in a field."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise MalformedMessage(
            f"{name}: expected a whole number, got {value!r}; check the topic's type"
        )
    return value


def _bytes(name: str, value: Any) -> bytes | memoryview:
    """Return the bytes of a field of type uint8[]: an array from rclpy, base64 from a rosbridge,
    or a list from some servers.
    """
    try:
        if isinstance(value, str):
            return base64.b64decode(value, validate=True)
        return bytes(value) if isinstance(value, (list, tuple)) else memoryview(value).cast("B")
    except (binascii.Error, TypeError, ValueError) as error:
        raise MalformedMessage(
            f"{name}: expected an array of uint8, got data that are no bytes ({error}); check the "
            "topic's type"
        ) from error


def _numbers(name: str, values: Any) -> np.ndarray:
    """Return the numbers in a field, (D,) float64."""
    try:
        array = np.asarray(values if isinstance(values, np.ndarray) else list(values), np.float64)
    except (TypeError, ValueError) as error:
        raise MalformedMessage(
            f"{name}: expected an array of numbers, got {shown(values)}; check the topic's type"
        ) from error
    if array.ndim != 1:
        raise MalformedMessage(f"{name}: expected shape (D,), got {array.shape}")
    return array


def _finite(name: str, values: np.ndarray) -> np.ndarray:
    """Return numbers as float32; raise `MalformedMessage` if one is not finite. A rosbridge writes
    such numbers as null, which numpy reads as NaN.
    """
    with np.errstate(over="ignore"):
        numbers = values.astype(np.float32)
    if not np.isfinite(numbers).all():
        raise MalformedMessage(
            f"{name}: expected finite numbers, got {values.tolist()}; check the sensor"
        )
    return numbers
