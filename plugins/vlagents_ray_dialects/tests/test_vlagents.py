"""Tests of clients of vlagents 0.2 and 0.3 over RPyC: messages, shared memory, sessions, and the
effects of faulty clients.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import socket
import subprocess
import sys
import zlib
from collections.abc import Iterator
from multiprocessing.shared_memory import SharedMemory as Segment
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from eval_fakes import wait_for
from hypothesis import given, settings
from hypothesis import strategies as st
from in_process_replicas import Replicas
from many import many
from open_resources import descriptors
from rpyc_client import LOCAL, REMOTE, ROOT, TUPLE, VALUE, Client, call, document, request

from vlagents_ray.errors import (
    ConfigError,
    InvalidInput,
    InvalidObservation,
    MalformedMessage,
    MessageTooLarge,
)
from vlagents_ray.images.jpeg_png import encode_jpeg
from vlagents_ray.interface import GOAL_IMAGE, Act
from vlagents_ray.protocol.messages import Budget, MessageLimits
from vlagents_ray.serve.ports import reserve
from vlagents_ray.wire import json_numpy
from vlagents_ray_dialects.messages import rpyc, vlagents
from vlagents_ray_dialects.messages.rpyc import Handler
from vlagents_ray_dialects.vlagents import SharedMemory

LIMITS = MessageLimits()


JPEG = encode_jpeg(np.full((32, 24, 3), 200, np.uint8))


class Memory:
    """Shared-memory segments by name."""

    def __init__(self, **segments: bytes) -> None:
        self.segments = segments

    def read(self, name: str, size: int) -> bytearray:
        if name not in self.segments:
            raise InvalidObservation(f"no {name}")
        return bytearray(self.segments[name][:size])


def act(
    value: object, memory: Memory | None = None, limits: MessageLimits = LIMITS
) -> vlagents.ObservationRequest:
    text = value if isinstance(value, str) else json_numpy.dumps(value)
    return vlagents.read_act(text, Budget(limits), memory or Memory())


def test_one_robot_keeps_its_names() -> None:
    seen = act(document(7, "pick", value=3))
    assert (seen.instruction, seen.robots, seen.obs.gripper) == ("pick", ("arm",), 0.25)
    assert seen.obs.cameras["front"].shape == (16, 16, 3)
    assert seen.obs.cameras["front"].max() == 7
    assert seen.obs.state["joints"].tolist() == [0.5] * 7
    assert seen.obs.info == {"value": 3}


def test_several_robots_have_their_names_in_front() -> None:
    arm = {
        "cameras": {"wrist": np.zeros((4, 4, 3), np.uint8)},
        "joints": np.zeros(2, np.float32),
        "gripper": 1.0,
    }
    seen = act({"obs": {"left": arm, "right": arm}, "language_instruction": None})
    assert sorted(seen.obs.cameras) == ["left/wrist", "right/wrist"]
    assert sorted(seen.obs.state) == [
        "left/gripper",
        "left/joints",
        "right/gripper",
        "right/joints",
    ]
    assert seen.obs.gripper is None


def test_jpeg_and_shared_memory_become_pixels() -> None:
    image = np.full((32, 24, 3), 200, np.uint8)
    jpeg = base64.urlsafe_b64encode(encode_jpeg(image)).decode()
    shared = {"shm_name": "psm_1", "shape": [32, 24, 3], "dtype": "uint8"}
    robot = {"cameras": {"a": jpeg}, "camera_data_type": "jpeg_encoded"}
    goal = {"goal_image": shared, "goal_image_data_type": "shared_memory"}
    seen = act({"obs": {"arm": robot}, **goal}, Memory(psm_1=image.tobytes() + b"more"))
    assert abs(int(seen.obs.cameras["a"][5, 5, 0]) - 200) <= 2
    assert np.array_equal(seen.obs.info[GOAL_IMAGE], image)


def test_the_error_of_an_image_names_its_camera() -> None:
    good, broken = (base64.urlsafe_b64encode(file).decode() for file in (JPEG, JPEG[:-20]))
    robot = {"cameras": {"side": good, "wrist": broken}, "camera_data_type": "jpeg_encoded"}
    with pytest.raises(MalformedMessage, match="camera 'wrist': broken JPEG"):
        act({"obs": {"arm": robot}})


def test_several_frames_are_refused_and_a_single_one_may_have_a_time_axis() -> None:
    frames = np.stack([np.full((4, 4, 3), i, np.uint8) for i in range(3)])
    assert act({"obs": {"arm": {"cameras": {"a": frames[2:]}}}}).obs.cameras["a"].max() == 2
    for several in (frames, frames[:2], frames[:0]):
        with pytest.raises(InvalidObservation, match="camera 'a': expected one frame, got"):
            act({"obs": {"arm": {"cameras": {"a": several}}}})


def test_a_reset_of_0_2_brings_instruction_and_options() -> None:
    old = {
        "cameras": {},
        "camera_data_type": "raw",
        "gripper": None,
        "state": np.ones(3),
        "info": {},
    }
    seen, read = vlagents.read_reset(
        json_numpy.dumps([old, "go", {"seed": 4}]), Budget(LIMITS), Memory()
    )
    assert (seen.instruction, read, seen.robots) == ("go", {"seed": 4}, ())
    assert seen.obs.state["state"].dtype == np.float32
    for options in ({"obs": 1}, {"contract": {}}, 3):
        with pytest.raises(MalformedMessage, match="options"):
            vlagents.read_reset(json_numpy.dumps([old, "go", options]), Budget(LIMITS), Memory())


def test_rows_become_steps_and_the_gripper_has_a_place_of_its_own() -> None:
    rows = np.array([[1, 2, -1], [3, 4, 1]], np.float32)
    columns = {"arm": vlagents.RobotColumns(gripper=-1, gripper_open=-1.0, gripper_closed=1.0)}
    acts = json.loads(vlagents.write_act(Act(rows, True, {"a": 1}), ["arm"], columns))["acts"]
    assert [step["arm"]["gripper"] for step in acts] == [1.0, 0.0]
    assert [step["arm"]["done"] for step in acts] == [False, True]
    assert [step["arm"]["info"] for step in acts] == [{"a": 1}, {}]
    assert acts[0]["arm"]["action"]["shape"] == [2]


def test_columns_are_shared_out_among_robots() -> None:
    columns = {"left": vlagents.RobotColumns(0, 2, 1), "right": vlagents.RobotColumns(2, 4)}
    [step] = json.loads(vlagents.write_act(Act(np.arange(4.0)), ["left", "right"], columns))["acts"]
    assert step["left"]["action"]["shape"] == [1]
    assert step["left"]["gripper"] == 1.0
    assert step["right"]["action"]["shape"] == [2]


def robot(**changes: object) -> dict:
    return {"obs": {"arm": {"cameras": {}, "camera_data_type": "raw"} | changes}}


def shared(shape: list[int]) -> dict:
    return robot(
        cameras={"a": {"shm_name": "psm_9", "shape": shape}}, camera_data_type="shared_memory"
    )


@pytest.mark.parametrize(
    ("value", "error"),
    [
        (robot(cameras={"a": "x"}, camera_data_type="jpeg_encoded"), MalformedMessage),
        (robot(cameras={"a": "x"}), InvalidObservation),
        (robot(cameras={"a": np.zeros((4, 4), np.uint8)}), InvalidObservation),
        (shared([2, 2, 3]), InvalidObservation),
        (shared([2**40, 2**40, 3]), MessageTooLarge),
        (shared([-1]), MalformedMessage),
        (robot(camera_data_type="pickle", cameras={"a": "x"}), MalformedMessage),
        (robot(joints="x"), InvalidObservation),
        (robot(gripper="x"), InvalidObservation),
        (robot(more=1), MalformedMessage),
        ({"obs": {}}, InvalidObservation),
        ({"obs": {"arm": {}}, "language_instruction": 3}, MalformedMessage),
        ({"obs": {"arm": {}}, "language_instruction": "x" * 100_000}, MessageTooLarge),
        ("[" * 100_000, MessageTooLarge),
        ("[" * 5_000, MalformedMessage),
        ('{"__numpy__": "AAAA", "dtype": "|O8", "shape": [1]}', MalformedMessage),
        ('{"__numpy__": "AAAA", "dtype": "|u1", "shape": [4000000000]}', MalformedMessage),
        ('{"__numpy__": "AAAA", "dtype": [["a", "<f4"]], "shape": [1]}', MalformedMessage),
        ("nonsense", MalformedMessage),
    ],
)  # fmt: skip
def test_what_is_wrong_is_refused_by_name(value: object, error: type[Exception]) -> None:
    with pytest.raises(error):
        act(value)


def test_the_cameras_of_all_robots_are_counted_before_one_is_decoded() -> None:
    file = base64.b64encode(encode_jpeg(np.zeros((8, 8, 3), np.uint8))).decode()
    one = {"cameras": {f"c{i}": file for i in range(9)}, "camera_data_type": "jpeg_encoded"}
    with pytest.raises(MessageTooLarge, match="cameras: expected at most 16, got 18"):
        act({"obs": {"left": one, "right": one}})


def test_a_document_of_too_many_values_is_refused() -> None:
    with pytest.raises(MessageTooLarge, match="values"):
        act(robot(info={"list": [0] * 20_000}))


arrays = st.sampled_from([np.float32, np.float64, np.uint8, np.int64, np.bool_]).flatmap(
    lambda dtype: st.lists(st.integers(0, 1), max_size=6).map(
        lambda values: np.array(values, dtype)
    )
)


@given(
    st.recursive(
        arrays | st.none() | st.booleans() | st.integers() | st.text(), st.lists, max_leaves=8
    )
)
def test_json_with_arrays_comes_back(value: object) -> None:
    found = json_numpy.loads(json_numpy.dumps(value), LIMITS)
    assert json_numpy.dumps(found) == json_numpy.dumps(value)


def test_a_scalar_and_a_big_endian_array_keep_their_values() -> None:
    found = json_numpy.loads(json_numpy.dumps([np.float32(2.5), np.array([1, 2], ">i4")]), LIMITS)
    assert found[0] == 2.5
    assert found[1].tolist() == [1, 2]


LIMIT = 2**16


def read(frame: bytes) -> rpyc.RpycCall | None:
    length, compressed = rpyc.read_header(frame[: rpyc.HEADER.size], LIMIT)
    body = frame[rpyc.HEADER.size :]
    assert len(body) == length
    return rpyc.read_call(body, compressed, LIMIT)


values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(10**18), 10**18)
    | st.floats(allow_nan=False)
    | st.text()
    | st.binary(),
    lambda inner: st.lists(inner, max_size=5).map(tuple),
    max_leaves=20,
)


@given(values)
def test_values_come_back_as_they_were(value: object) -> None:
    found = read(request(3, Handler.PING, (VALUE, (value,))))
    assert found == rpyc.RpycCall(3, Handler.PING, (value,))


def test_a_call_of_the_root_is_read_and_long_ones_are_compressed() -> None:
    frame = call("act", "x" * 10_000)
    assert len(frame) < 1000
    assert read(frame) == rpyc.RpycCall(
        1, Handler.CALLATTR, (rpyc.Reference(rpyc.ROOT), "act", ("x" * 10_000,), ())
    )


@pytest.mark.parametrize(
    "boxed",
    [
        # A reference to an object of the client, for a callback.
        (REMOTE, ("builtins.function", 1, 2)),
        (TUPLE, ((REMOTE, ("builtins.list", 1, 2)),)),
        # A reference to an object of the server that was never sent.
        (LOCAL, ("builtins.type", 5, 0)),
        (LOCAL, (*ROOT[:2], 2)),
        (LOCAL, ("builtins.method", 2, 10**9)),
        (9, ()),
    ],
)
def test_no_object_but_the_root_can_be_named(boxed: tuple) -> None:
    with pytest.raises(rpyc.Refused) as refused:
        read(request(7, Handler.CALL, boxed))
    assert refused.value.sequence == 7


@pytest.mark.parametrize("handler", sorted(set(range(22)) - {int(one) for one in Handler}))
def test_what_reaches_into_objects_is_not_offered(handler: int) -> None:
    """These operations set or list attributes, pickle, compare, format objects and the like."""
    with pytest.raises(rpyc.Refused, match="not offered"):
        read(request(1, handler, (TUPLE, ((LOCAL, ROOT),))))


def test_a_compressed_message_may_not_grow_over_the_limit() -> None:
    bomb = zlib.compress(bytes(50 * 2**20))
    with pytest.raises(MessageTooLarge):
        rpyc.read_call(bomb + b"\n", True, LIMIT)
    with pytest.raises(MessageTooLarge):
        rpyc.read_header(rpyc.HEADER.pack(LIMIT + 1, 0), LIMIT)


def test_nesting_and_long_numbers_are_refused() -> None:
    deep = b"\x10" * 5000 + b"\x00"
    for message in (
        deep,
        b"\x17\xff\xff\xff\xff" + b"9" * 100,
        b"\x17\x00\x00\x10\x00" + b"9" * 4096,
    ):
        with pytest.raises((MessageTooLarge, MalformedMessage)):
            rpyc.read_call(b"\x01" + message + b"\n", False, LIMIT)


def test_answers_to_what_was_never_asked_are_passed_over() -> None:
    assert read(rpyc.reply(1, "x")) is None
    assert read(rpyc.exception(1, "ValueError", "x")) is None


REPLY, EXCEPTION = 2, 3


def sessions(replicas: Replicas) -> int:
    return len(replicas.engines[0].sessions)


def test_each_client_has_a_session_that_begins_anew_with_another_instruction(
    open_dialect, replicas: Replicas
) -> None:
    port = open_dialect("vlagents")
    with Client(port) as red, Client(port) as blue:
        assert red.act(document(10, "abc")) == [10, 0.5, 0.25, 3, 1]
        assert blue.act(document(20, "abcdef")) == [20, 0.5, 0.25, 6, 1]
        assert red.act(document(11, "abc")) == [11, 0.5, 0.25, 3, 2]
        assert red.act(document(12, "ab")) == [12, 0.5, 0.25, 2, 1]
        assert blue.act(document(21, "abcdef")) == [21, 0.5, 0.25, 6, 2]
        assert sessions(replicas) == 2
    wait_for(lambda: sessions(replicas) == 0)


def test_a_client_of_0_2_resets_and_acts(open_dialect) -> None:
    old = {
        "cameras": {},
        "camera_data_type": "raw",
        "gripper": 0.5,
        "state": np.full(2, 3.0),
        "info": {},
    }
    with Client(open_dialect("vlagents")) as robot:
        robot.send(call("act", json_numpy.dumps(old)))
        kind, _, content = robot.receive()
        assert kind == EXCEPTION
        assert content[1][0].startswith("not_reset")
        robot.send(call("reset", json_numpy.dumps([old, "go", {"seed": 3}])))
        kind, _, (_, text) = robot.receive()
        assert '"options": {"seed": 3}' in text
        robot.send(call("act", json_numpy.dumps(old)))
        kind, _, (_, text) = robot.receive()
        assert '"done": false' in text


def test_a_mapping_gives_the_policys_names(open_dialect) -> None:
    mapping = {
        "cameras": {"cam": "cameras/front"},
        "state": {"q": "state/joints"},
        "gripper": "gripper",
    }
    with Client(open_dialect("vlagents", mapping=mapping)) as robot:
        robot.send(call("act", document(5)))
        _, _, (_, text) = robot.receive()
        assert '"cameras": ["cam"], "state": ["q"]' in text
        robot.send(call("act", json_numpy.dumps({"obs": {"arm": {"cameras": {}}}})))
        kind, _, content = robot.receive()
        assert kind == EXCEPTION
        assert "missing_camera: camera 'cameras/front'" in content[1][0]


def test_cameras_that_the_mapping_does_not_read_are_logged_once(
    open_dialect, caplog: pytest.LogCaptureFixture
) -> None:
    port = open_dialect("vlagents", mapping={"state": {"*": "state/*"}})
    for _ in range(2):
        with Client(port) as robot:
            for _ in range(2):
                robot.act(document(5))
    [said] = [one for one in caplog.messages if "which the policy does not receive" in one]
    assert said.startswith("vlagents: a client sends the cameras ['cameras/")


def test_nothing_but_the_methods_can_be_reached_and_the_client_goes_on(open_dialect) -> None:
    frames = [
        request(1, Handler.GETATTR, (TUPLE, ((LOCAL, ROOT), (VALUE, "__class__")))),
        request(1, Handler.GETATTR, (TUPLE, ((LOCAL, ROOT), (VALUE, "_talk")))),
        request(1, Handler.GETATTR, (VALUE, ("text", "__mul__"))),
        request(1, Handler.CALL, (TUPLE, ((LOCAL, ROOT), (VALUE, ()), (VALUE, ())))),
        request(
            1,
            Handler.CALL,
            (TUPLE, ((LOCAL, ("builtins.method", 2, 40)), (VALUE, ()), (VALUE, ()))),
        ),
        request(
            1,
            Handler.CALLATTR,
            (TUPLE, ((LOCAL, ROOT), (VALUE, "__init__"), (VALUE, ()), (VALUE, ()))),
        ),
        request(
            1,
            Handler.CALLATTR,
            (TUPLE, ((LOCAL, ROOT), (VALUE, "act"), (REMOTE, ("a.b", 1, 2)), (VALUE, ()))),
        ),
        request(
            1,
            Handler.CALLATTR,
            (TUPLE, ((LOCAL, ROOT), (VALUE, "name"), (VALUE, ()), (VALUE, (("a", 1),)))),
        ),
        request(1, 14, (TUPLE, ((LOCAL, ROOT), (VALUE, 5)))),  # the operation pickle
        # The operation setattr.
        request(1, 6, (TUPLE, ((LOCAL, ROOT), (VALUE, "name"), (VALUE, "x")))),
        request(1, 13, (TUPLE, ((LOCAL, ROOT),))),  # the operation dir
        request(1, Handler.PING, (TUPLE, ((LOCAL, ROOT),))),
        request(1, Handler.PING, (TUPLE, ((TUPLE, ((LOCAL, ROOT),)),))),
        request(1, Handler.PING, (TUPLE, ((VALUE, 1.5),))),
        *(call("act", 3), call("act", "nonsense"), call("name", "x")),
    ]
    with Client(open_dialect("vlagents")) as client:
        for frame in frames:
            client.send(frame)
            kind, sequence, content = client.receive()
            assert (kind, sequence) == (EXCEPTION, 1)
            assert "Traceback" not in str(content)
            assert ".py" not in str(content)
        client.send(call("name", sequence=2))
        assert client.receive() == (REPLY, 2, (VALUE, "noop"))


def test_the_clients_memory_is_read_in_place(open_dialect) -> None:
    segment = Segment(create=True, size=16 * 16 * 3)
    try:
        segment.buf[:] = bytes([77]) * segment.size
        payload = {"shm_name": segment.name, "shape": [16, 16, 3], "dtype": "uint8"}
        arm = {
            "cameras": {"front": payload},
            "camera_data_type": "shared_memory",
            "joints": np.ones(1),
        }
        text = json_numpy.dumps({"obs": {"arm": arm}, "language_instruction": "x"})
        port = open_dialect("vlagents")
        with Client(port) as one:
            assert one.act(text)[0] == 77
        with Client(port) as two:  # This client begins after the first one has ended.
            assert two.act(text)[0] == 77
    finally:
        segment.close()
        segment.unlink()


@pytest.mark.slow
def test_a_slow_a_dead_and_a_silent_client_hold_up_nobody(open_dialect, replicas: Replicas) -> None:
    # The good client is silent for a shorter time, even on a busy machine.
    port = open_dialect("vlagents", idle_s=4.0)
    with Client(port) as half, Client(port) as silent, Client(port) as deaf:
        half.send(call("act", document())[:20])  # the message stays incomplete
        deaf.send(call("act", document()) * 3)  # the client does not read the answers
        with Client(port) as good:
            for i in range(1, 6):
                assert good.act(document(3, "x"))[-1] == i
            for slow in (silent, deaf):
                while slow.socket.recv(4096):
                    pass  # until the server disconnects the client
        wait_for(lambda: sessions(replicas) == 0)


def test_one_client_more_than_the_limit_is_turned_away(open_dialect) -> None:
    port = open_dialect("vlagents", sessions=2)
    with Client(port) as one, Client(port) as two:
        for client in (one, two):
            client.act(document())
        with Client(port) as three, pytest.raises((EOFError, OSError)):
            three.act(document())
        one.close()
        wait_for(lambda: _answers(port))
        two.act(document())


def _answers(port: int) -> bool:
    try:
        with Client(port) as client:
            return bool(client.act(document()))
    except (EOFError, OSError):
        return False


def test_a_taken_port_is_named_with_the_cure() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(
            ConfigError, match=rf"vlagents: cannot listen on 127.0.0.1:{port}.*choose another port"
        ):
            reserve("vlagents", "127.0.0.1", port, timeout_s=0)
    with pytest.raises(ConfigError, match="not an address"):
        reserve("vlagents", "no.such.host.invalid", port, timeout_s=0)


def test_a_reserved_port_accepts_nobody_before_the_dialect_is_served() -> None:
    with reserve("vlagents", "127.0.0.1", 0) as listener, pytest.raises(ConnectionRefusedError):
        socket.create_connection(listener.getsockname(), timeout=5)


@pytest.fixture(name="segment")
def clients_segment() -> Iterator[Segment]:
    segment = Segment(create=True, size=4096)
    segment.buf[:5] = b"hello"
    yield segment
    segment.close()
    segment.unlink()


def test_what_the_client_wrote_is_read_each_time_anew(segment: Segment) -> None:
    memory = SharedMemory(same_machine=True)
    assert memory.read(segment.name, 5) == b"hello"
    segment.buf[:5] = b"world"
    assert memory.read(segment.name, 5) == b"world"
    memory.close()


def test_a_readers_end_leaves_the_segment_to_its_client(segment: Segment) -> None:
    """This also holds if the reader's whole process ends: its resource tracker must not have
    registered the segment.
    """
    code = (
        "import sys\nfrom vlagents_ray_dialects.vlagents import SharedMemory\n"
        "print(SharedMemory(same_machine=True).read(sys.argv[1], 5).decode())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, segment.name],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert (done.stdout, done.stderr) == ("hello\n", "")
    assert Path("/dev/shm", segment.name).exists()
    assert bytes(segment.buf[:5]) == b"hello"


def test_a_segment_that_shrinks_is_an_error_and_no_crash(segment: Segment) -> None:
    memory = SharedMemory(same_machine=True)
    assert len(memory.read(segment.name, 4096)) == 4096
    os.truncate(f"/dev/shm/{segment.name}", 0)
    with pytest.raises(InvalidObservation, match="shorter"):
        memory.read(segment.name, 4096)
    os.truncate(f"/dev/shm/{segment.name}", 4096)
    memory.close()


@pytest.mark.parametrize(
    "name",
    [
        "../../etc/passwd",
        "psm_../x",
        "/etc/passwd",
        "",
        "plasma_123",
        "psm_",
        "psm_0123\n",
        "psm_00000000",
    ],
)
def test_only_segments_of_clients_can_be_named(name: str) -> None:
    with pytest.raises(InvalidObservation):
        SharedMemory(same_machine=True).read(name, 1)


def test_a_link_to_another_file_is_not_followed(tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text("secret")
    link = Path("/dev/shm") / f"psm_{os.getpid():x}abc"
    link.symlink_to(secret)
    try:
        with pytest.raises(InvalidObservation):
            SharedMemory(same_machine=True).read(link.name, 6)
    finally:
        link.unlink()


def test_a_client_on_another_machine_names_none(segment: Segment) -> None:
    with pytest.raises(InvalidObservation, match="expected a client on the server's machine"):
        SharedMemory(same_machine=False).read(segment.name, 5)


@pytest.mark.own_process
def test_descriptors_do_not_pile_up(segment: Segment) -> None:
    memory = SharedMemory(same_machine=True)
    segments = [Segment(create=True, size=64) for _ in range(80)]
    try:
        before = descriptors()
        for one in segments:
            memory.read(one.name, 1)
        assert len(descriptors() - before) <= 64
        memory.close()
        assert not descriptors() - before
    finally:
        for one in segments:
            one.close()
            one.unlink()


def test_the_gripper_is_the_last_column_and_each_robot_has_its_own_rows() -> None:
    step = {
        "left": {"action": np.ones(2), "gripper": 0.5, "done": False, "info": {}},
        "right": {"action": [3.0]},
    }
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


@given(
    st.recursive(
        st.none() | st.integers(-(2**60), 2**60) | st.text(max_size=5),
        lambda one: st.tuples(one, one),
    )
)
@settings(max_examples=many(200))
def test_any_content_is_a_value_or_an_error_of_ours(content: Any) -> None:
    for kind in (2, 3):
        with contextlib.suppress(InvalidInput):
            vlagents.read_result(
                bytes([kind]) + rpyc.write_brine((1, content)) + rpyc.END, False, 10_000
            )
