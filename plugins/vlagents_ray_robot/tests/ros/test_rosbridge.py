"""Tests of the rosbridge protocol with recorded messages of a real server, which must also follow
the rules of the test double.

`recorded_rosbridge.jsonl` contains frames of rosbridge_suite (commit c1bfc2f of the branch ros2)
with ROS 2 Kilted, sent to a client that subscribed without compression.
"""

from __future__ import annotations

import contextlib
import json
import ssl
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from certificates import authority
from deaf_server import deaf_server
from eval_fakes import wait_for
from rosbridge_double import RosbridgeDouble, rosbridge_double

from vlagents_ray.errors import ConnectionLost, MalformedMessage
from vlagents_ray_robot.ros import messages
from vlagents_ray_robot.ros.links import Rosbridge, decoded

RECORDED = [
    json.loads(line)
    for line in (Path(__file__).parent / "recorded_rosbridge.jsonl").read_text().splitlines()
]
STAMP = 1_700_000_000.25


def test_what_a_real_server_sent_is_read_as_it_was_published() -> None:
    came = {
        message["topic"]: message["msg"] for message in (decoded(line["text"]) for line in RECORDED)
    }
    assert len(came) == 6
    padded = np.arange(24, dtype=np.uint8).reshape(2, 12)
    np.testing.assert_array_equal(
        messages.image(came["/cam"]), padded[:, :9].reshape(2, 3, 3)[..., ::-1]
    )
    assert messages.stamp(came["/cam"]) == STAMP
    assert abs(messages.compressed_image(came["/cam/compressed"]).astype(int) - 90).max() <= 2
    np.testing.assert_array_equal(
        messages.joints(came["/joint_states"], ("a", "b")), np.array([-1, 2.5], np.float32)
    )
    assert messages.joints(came["/joint_states"], ("b",), "velocity") == 0
    with pytest.raises(MalformedMessage, match="finite"):  # JSON has null for NaN and infinity
        messages.joints(came["/joint_states"], ("a", "finger"), "velocity")
    np.testing.assert_array_equal(
        messages.pose(came["/pose"]), np.array([0.5, 0, 0, 0, 0, 0, 1], np.float32)
    )
    assert came["/instruction"]["data"] == "fold the cloth, größer"
    np.testing.assert_array_equal(
        messages.numbers(came["/numbers"]), np.array([1.5, -2], np.float32)
    )


@pytest.mark.parametrize("frame", ["{", "[1]", '{"topic": "/a"}', "[" * 100_000])
def test_a_frame_that_is_no_message_is_refused(frame: str) -> None:
    with pytest.raises(MalformedMessage):
        decoded(frame)


@contextlib.contextmanager
def linked(
    double: RosbridgeDouble, take: Callable[[Any], None], *topics: str
) -> Iterator[Rosbridge]:
    """Yield an open link that is subscribed to these topics, and publishes to /arm."""
    link = Rosbridge(double.url)
    for topic in topics:
        link.subscribe(topic, "std_msgs/msg/Float64MultiArray", take)
    link.advertise("/arm", "std_msgs/msg/Float64MultiArray")
    link.open()
    try:
        yield link
    finally:
        link.close()


def test_a_link_subscribes_receives_and_publishes() -> None:
    came: list[Any] = []
    with rosbridge_double() as double:
        with linked(double, came.append, "/numbers") as link:
            wait_for(lambda: "/numbers" in double.subscribed)
            double.publish("/numbers", {"data": [1.0, 2.0]})
            double.publish("/another", {"data": [3.0]})
            double.publish("/numbers", {"data": [4.0]})
            wait_for(lambda: len(came) == 2)
            assert [list(message["data"]) for message in came] == [[1.0, 2.0], [4.0]]
            with pytest.raises(ValueError, match="not JSON compliant"):
                link.publish("/arm", {"data": [float("nan")]})
            assert link.publish("/arm", {"data": [0.5]})
            wait_for(lambda: double.on("/arm"))
            assert double.on("/arm") == [{"data": [0.5]}]
            assert double.advertised == {"/arm": "std_msgs/msg/Float64MultiArray"}
        assert not link.up
    with pytest.raises(ConnectionLost, match="does a rosbridge_server run there"):
        Rosbridge(double.url).open()


def test_a_link_that_is_lost_publishes_nothing_and_comes_back_with_its_topics() -> None:
    came: list[Any] = []
    with rosbridge_double() as double, linked(double, came.append, "/text") as link:
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


@pytest.mark.parametrize("busy", [True, False])
def test_a_silent_sensor_is_subscribed_to_again(
    busy: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A real server that subscribed before the publisher existed may have chosen a quality of
    service that does not match the publisher's.
    """
    monkeypatch.setattr("vlagents_ray_robot.ros.links._SILENT_S", 0.2)
    with rosbridge_double() as double, linked(double, lambda _: None, "/silent", "/busy"):

        def again() -> bool:
            if busy:
                double.publish("/busy", {"data": "here"})
            return double.subscriptions.count("/silent") >= 3

        wait_for(again)
        assert not busy or double.subscriptions.count("/busy") < 3


@pytest.mark.parametrize("has_tls", [False, True], ids=["plain", "tls"])
def test_a_server_that_does_not_read_does_not_block_the_control_loop(
    has_tls: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = None
    if has_tls:
        own = authority(tmp_path, "lab")
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(*own.sign("server"))
        monkeypatch.setenv("SSL_CERT_FILE", str(own.file))

    with deaf_server(context=context) as port:
        link = Rosbridge(f"{'wss' if has_tls else 'ws'}://127.0.0.1:{port}")
        link.advertise("/arm", "std_msgs/msg/Float64MultiArray")
        link.open()
        longest_s, published = 0.0, True
        while published:
            begun = time.monotonic()
            published = link.publish("/arm", {"data": [0.5] * 100_000})
            longest_s = max(longest_s, time.monotonic() - begun)
        begun = time.monotonic()
        link.close()
        assert longest_s < 2  # the limit of a message is 0.3 s
        assert time.monotonic() - begun < 10
