"""The rosbridge protocol: what a real server sent is read as it was meant, and by the double's rules as well.

`recorded_rosbridge.jsonl` holds frames of rosbridge_suite (commit c1bfc2f, of the branch ros2) beside ROS 2 Kilted, to
a client that subscribed with each compression.
"""

from __future__ import annotations

import base64
import contextlib
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rosbridge_double
from eval_fakes import wait_for
from hypothesis import given, settings
from hypothesis import strategies as st
from many import many

from vlagents_ray.errors import ConnectionLost, MalformedMessage
from vlagents_ray.robot.ros import messages
from vlagents_ray.robot.ros.rosbridge import Rosbridge, decode_cbor, decoded

RECORDED = [json.loads(line) for line in (Path(__file__).parent / "recorded_rosbridge.jsonl").read_text().splitlines()]
STAMP = 1_700_000_000.25


def frame_of(line: dict[str, str]) -> str | bytes:
    return line["text"] if "text" in line else base64.b64decode(line["base64"])


@pytest.mark.parametrize("compression", ["none", "cbor"])
def test_what_a_real_server_sent_is_read_as_it_was_published(compression: str) -> None:
    lines = [line for line in RECORDED if line["compression"] == compression]
    came = {message["topic"]: message["msg"] for message in map(decoded, map(frame_of, lines))}
    assert len(came) == 6
    padded = np.arange(24, dtype=np.uint8).reshape(2, 12)
    np.testing.assert_array_equal(messages.image(came["/cam"]), padded[:, :9].reshape(2, 3, 3)[..., ::-1])
    assert messages.stamp(came["/cam"]) == STAMP
    assert abs(messages.compressed_image(came["/cam/compressed"]).astype(int) - 90).max() <= 2
    np.testing.assert_array_equal(messages.joints(came["/joint_states"], ("a", "b")), np.array([-1, 2.5], np.float32))
    assert messages.joints(came["/joint_states"], ("b",), "velocity") == 0
    with pytest.raises(MalformedMessage, match="finite"):  # CBOR has NaN and infinity, JSON null for both
        messages.joints(came["/joint_states"], ("a", "finger"), "velocity")
    np.testing.assert_array_equal(messages.pose(came["/pose"]), np.array([0.5, 0, 0, 0, 0, 0, 1], np.float32))
    assert messages.text(came["/instruction"]) == "fold the cloth, größer"
    np.testing.assert_array_equal(messages.numbers(came["/numbers"]), np.array([1.5, -2], np.float32))


def test_the_double_encodes_cbor_as_the_real_server_does() -> None:
    for line in RECORDED:
        if line["compression"] == "cbor":
            frame = base64.b64decode(line["base64"])
            assert rosbridge_double.cbor(_owned(decode_cbor(frame))) == frame


def _owned(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _owned(one) for name, one in value.items()}
    if isinstance(value, list):
        return [_owned(one) for one in value]
    return bytes(value) if isinstance(value, memoryview) else value


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**64), 2**64 - 1)
    | st.floats(allow_nan=False)
    | st.text(max_size=30)
    | st.binary(max_size=300),
    lambda inside: st.lists(inside, max_size=4) | st.dictionaries(st.text(max_size=5), inside, max_size=4),
    max_leaves=10,
)


@given(VALUES)
@settings(max_examples=many(150))
def test_cbor_is_decoded_to_what_was_encoded(value: Any) -> None:
    assert _owned(decode_cbor(rosbridge_double.cbor(value))) == value


@given(st.binary(max_size=60))
@settings(max_examples=many(300))
def test_cbor_that_is_garbage_is_refused_and_nothing_else_happens(data: bytes) -> None:
    with contextlib.suppress(MalformedMessage):
        decode_cbor(data)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "truncated"),
        (b"\x9a\xff\xff\xff\xff", "got 0 bytes for 4294967295 items"),
        (b"\x5b" + b"\xff" * 8, "truncated"),
        (b"\x81" * 40 + b"\x00", "levels"),
        (b"\x9f\x01\xff", "no indefinite lengths"),
        (b"\x00\x00", "got 1 bytes after the item"),
        (b"\xd8\x56\x43abc", "not as many bytes"),
        (b"\xa1\x01\x02", "want a field's name"),
        (b"\x62\xff\xfe", "not UTF-8"),
        (b"\xf0", "simple value"),
    ],
)
def test_cbor_is_refused_with_the_reason(data: bytes, said: str) -> None:
    with pytest.raises(MalformedMessage, match=said):
        decode_cbor(data)


def test_floats_and_typed_arrays_have_the_values_of_the_standard() -> None:
    assert decode_cbor(b"\xf9\x3c\x00") == 1.0
    assert decode_cbor(b"\xfa" + struct.pack(">f", 1.5)) == 1.5
    np.testing.assert_array_equal(decode_cbor(b"\xd8\x45\x44" + struct.pack("<2H", 1, 513)), [1, 513])
    np.testing.assert_array_equal(decode_cbor(b"\xd8\x41\x44" + struct.pack(">2H", 1, 513)), [1, 513])


@pytest.mark.parametrize("frame", ["{", "[1]", '{"topic": "/a"}', "[" * 100_000])
def test_a_frame_that_is_no_message_is_refused(frame: str) -> None:
    with pytest.raises(MalformedMessage):
        decoded(frame)


@pytest.mark.parametrize("compression", ["none", "cbor"])
def test_a_link_subscribes_receives_and_publishes(compression: str) -> None:
    came: list[Any] = []
    with rosbridge_double.rosbridge_double() as double:
        link = Rosbridge(double.url, compression)
        link.subscribe("/numbers", "std_msgs/msg/Float64MultiArray", came.append, sensor=True)
        link.advertise("/arm", "std_msgs/msg/Float64MultiArray")
        link.open()
        try:
            wait_for(lambda: "/numbers" in double.subscribed)
            double.publish("/numbers", {"data": [1.0, 2.0]})
            double.publish("/another", {"data": [3.0]})
            double.publish("/numbers", {"data": [4.0]})
            wait_for(lambda: len(came) == 2)
            assert [list(message["data"]) for message in came] == [[1.0, 2.0], [4.0]]
            assert link.publish("/arm", {"data": [0.5]})
            wait_for(lambda: double.on("/arm"))
            assert double.on("/arm") == [{"data": [0.5]}]
            assert double.advertised == {"/arm": "std_msgs/msg/Float64MultiArray"}
        finally:
            link.close()
    assert not link.up


def test_a_link_that_is_lost_publishes_nothing_and_comes_back_with_its_topics() -> None:
    came: list[Any] = []
    with rosbridge_double.rosbridge_double() as double:
        link = Rosbridge(double.url)
        link.subscribe("/text", "std_msgs/msg/String", came.append, sensor=False)
        link.advertise("/arm", "std_msgs/msg/Float64MultiArray")
        link.open()
        try:
            double.close()
            wait_for(lambda: not link.up)
            assert not link.publish("/arm", {"data": [0.5]})
            double.advertised.clear()
            double.subscribed.clear()
            double.open()
            wait_for(lambda: link.up and bool(double.subscribed))
            assert link.connections == 2
            double.publish("/text", {"data": "again"})
            wait_for(lambda: came == [{"data": "again"}])
            assert "/arm" in double.advertised
        finally:
            link.close()


@pytest.mark.parametrize("busy", [True, False])
def test_a_silent_sensor_is_subscribed_to_again(busy: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A real server that subscribed before it knew the publisher may have chosen a quality that does not match it."""
    monkeypatch.setattr("vlagents_ray.robot.ros.rosbridge._SILENT_S", 0.2)
    with rosbridge_double.rosbridge_double() as double:
        link = Rosbridge(double.url)
        for topic, sensor in (("/silent", True), ("/busy", True), ("/told", False)):
            link.subscribe(topic, "std_msgs/msg/String", lambda _: None, sensor=sensor)
        link.open()

        def again() -> bool:
            if busy:
                double.publish("/busy", {"data": "here"})
            return double.subscriptions.count("/silent") >= 3

        try:
            wait_for(again)
        finally:
            link.close()
        assert double.subscriptions.count("/told") == 1
        assert not busy or double.subscriptions.count("/busy") < 3


def test_a_server_that_is_not_there_is_an_error_with_the_cure() -> None:
    with rosbridge_double.rosbridge_double() as double:
        pass
    with pytest.raises(ConnectionLost, match="does a rosbridge_server run there"):
        Rosbridge(double.url).open()


def test_a_number_that_is_not_finite_is_never_sent() -> None:
    with rosbridge_double.rosbridge_double() as double:
        link = Rosbridge(double.url)
        link.open()
        try:
            with pytest.raises(ValueError, match="not JSON compliant"):
                link.publish("/arm", {"data": [float("nan")]})
        finally:
            link.close()
