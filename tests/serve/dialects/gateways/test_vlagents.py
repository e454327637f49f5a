"""RPyC clients: their sessions, and what a bad client can do to the others."""

from __future__ import annotations

import os
import random
import socket
import threading
from multiprocessing.shared_memory import SharedMemory as Segment

import numpy as np
import psutil
import pytest
from eval_fakes import wait_for
from in_process_replicas import Replicas
from many import many
from rpyc_client import LOCAL, REMOTE, ROOT, TUPLE, VALUE, Client, call, document, request

from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.ports import reserve
from vlagents_ray.wire import json_numpy, rpyc
from vlagents_ray.wire.rpyc import Handler

REPLY, EXCEPTION = 2, 3
FRAMES = int(os.environ.get("VLAGENTS_RAY_FUZZ", many(5000)))
GROWTH = 64 * 2**20  # bytes, whatever the number of frames


def sessions(replicas: Replicas) -> int:
    return len(replicas.engines[0].sessions)


def test_each_client_has_a_session_that_begins_anew_with_another_instruction(open_vlagents, replicas: Replicas) -> None:
    port = open_vlagents()
    with Client(port) as red, Client(port) as blue:
        assert red.act(document(10, "abc")) == [10, 0.5, 0.25, 3, 1]
        assert blue.act(document(20, "abcdef")) == [20, 0.5, 0.25, 6, 1]
        assert red.act(document(11, "abc")) == [11, 0.5, 0.25, 3, 2]
        assert red.act(document(12, "ab")) == [12, 0.5, 0.25, 2, 1]
        assert blue.act(document(21, "abcdef")) == [21, 0.5, 0.25, 6, 2]
        assert sessions(replicas) == 2
    wait_for(lambda: sessions(replicas) == 0)


def test_a_client_of_0_2_resets_and_acts(open_vlagents) -> None:
    old = {"cameras": {}, "camera_data_type": "raw", "gripper": 0.5, "state": np.full(2, 3.0), "info": {}}
    with Client(open_vlagents()) as robot:
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


def test_a_mapping_gives_the_policys_names(open_vlagents) -> None:
    mapping = {"cameras": {"cam": "cameras/front"}, "state": {"q": "state/joints"}, "gripper": "gripper"}
    with Client(open_vlagents(mapping=mapping)) as robot:
        robot.send(call("act", document(5)))
        _, _, (_, text) = robot.receive()
        assert '"cameras": ["cam"], "state": ["q"]' in text
        robot.send(call("act", json_numpy.dumps({"obs": {"arm": {"cameras": {}}}})))
        kind, _, content = robot.receive()
        assert kind == EXCEPTION
        assert "missing_camera: camera 'cameras/front'" in content[1][0]


def test_cameras_that_the_mapping_does_not_read_are_logged_once(
    open_vlagents, caplog: pytest.LogCaptureFixture
) -> None:
    port = open_vlagents(mapping={"state": {"*": "state/*"}})
    for _ in range(2):
        with Client(port) as robot:
            for _ in range(2):
                robot.act(document(5))
    [said] = [one for one in caplog.messages if "which the policy does not get" in one]
    assert said.startswith("vlagents: a client sends the cameras ['cameras/")


def test_an_observation_of_which_the_mapping_reads_nothing_is_refused(open_vlagents) -> None:
    mapping = {"cameras": {"*": "images/*"}, "state": {"*": "proprio/*"}}
    told = pytest.raises(RuntimeError, match=r"invalid_observation: .*the mapping reads nothing")
    with Client(open_vlagents(mapping=mapping)) as robot, told:
        robot.act(document(5))


@pytest.mark.parametrize(
    "frame",
    [
        request(1, Handler.GETATTR, (TUPLE, ((LOCAL, ROOT), (VALUE, "__class__")))),
        request(1, Handler.GETATTR, (TUPLE, ((LOCAL, ROOT), (VALUE, "_talk")))),
        request(1, Handler.GETATTR, (VALUE, ("text", "__mul__"))),
        request(1, Handler.CALL, (TUPLE, ((LOCAL, ROOT), (VALUE, ()), (VALUE, ())))),
        request(1, Handler.CALL, (TUPLE, ((LOCAL, ("builtins.method", 2, 40)), (VALUE, ()), (VALUE, ())))),
        request(1, Handler.CALLATTR, (TUPLE, ((LOCAL, ROOT), (VALUE, "__init__"), (VALUE, ()), (VALUE, ())))),
        request(1, Handler.CALLATTR, (TUPLE, ((LOCAL, ROOT), (VALUE, "act"), (REMOTE, ("a.b", 1, 2)), (VALUE, ())))),
        request(1, Handler.CALLATTR, (TUPLE, ((LOCAL, ROOT), (VALUE, "name"), (VALUE, ()), (VALUE, (("a", 1),))))),
        request(1, 14, (TUPLE, ((LOCAL, ROOT), (VALUE, 5)))),  # pickle
        request(1, 6, (TUPLE, ((LOCAL, ROOT), (VALUE, "name"), (VALUE, "x")))),  # setattr
        request(1, 13, (TUPLE, ((LOCAL, ROOT),))),  # dir
        call("act", 3),
        call("act", "nonsense"),
        call("name", "x"),
    ],
)
def test_nothing_but_the_methods_can_be_reached_and_the_client_goes_on(open_vlagents, frame: bytes) -> None:
    with Client(open_vlagents()) as client:
        client.send(frame)
        kind, sequence, content = client.receive()
        assert (kind, sequence) == (EXCEPTION, 1)
        assert "Traceback" not in str(content)
        assert ".py" not in str(content)
        client.send(call("name", sequence=2))
        assert client.receive() == (REPLY, 2, (VALUE, "noop"))


def test_an_error_of_the_policy_tells_no_secrets(open_vlagents) -> None:
    with Client(open_vlagents()) as client, pytest.raises(RuntimeError, match="policy_failed") as error:
        client.act(document(sleep_s="text"))
    assert "Traceback" not in str(error.value)
    assert "sleep" not in str(error.value)


def test_the_clients_memory_is_read_in_place(open_vlagents) -> None:
    segment = Segment(create=True, size=16 * 16 * 3)
    try:
        segment.buf[:] = bytes([77]) * segment.size
        payload = {"shm_name": segment.name, "shape": [16, 16, 3], "dtype": "uint8"}
        arm = {"cameras": {"front": payload}, "camera_data_type": "shared_memory", "joints": np.ones(1)}
        text = json_numpy.dumps({"obs": {"arm": arm}, "language_instruction": "x"})
        port = open_vlagents()
        with Client(port) as one:
            assert one.act(text)[0] == 77
        with Client(port) as two:  # after another's end
            assert two.act(text)[0] == 77
        with Client(open_vlagents(shared_memory=False)) as off, pytest.raises(RuntimeError, match="shared memory"):
            off.act(text)
    finally:
        segment.close()
        segment.unlink()


def test_a_slow_a_dead_and_a_silent_client_hold_up_nobody(open_vlagents, replicas: Replicas) -> None:
    port = open_vlagents(idle_s=4.0)  # the good one is silent for less, on a busy machine, too
    with Client(port) as half, Client(port) as silent, Client(port) as deaf:
        half.send(call("act", document())[:20])  # and no more
        deaf.send(call("act", document()) * 3)  # and does not read
        with Client(port) as good:
            for i in range(1, 6):
                assert good.act(document(3, "x"))[-1] == i
            for slow in (silent, deaf):
                while slow.socket.recv(4096):
                    pass  # until the server hangs up
        wait_for(lambda: sessions(replicas) == 0)


def test_one_client_more_than_the_limit_is_turned_away(open_vlagents) -> None:
    port = open_vlagents(sessions=2)
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


@pytest.mark.own_process
def test_mutated_frames_end_their_own_client_at_most(open_vlagents, replicas: Replicas) -> None:
    """Over as many connections as they end; a good client acts all the while."""
    port = open_vlagents(sessions=16)
    choose = random.Random(5)
    frames = [call("act", document(9, side=4)), call("name"), request(1, Handler.GETROOT, (VALUE, ()))]
    frames += [request(1, Handler.GETATTR, (TUPLE, ((LOCAL, ROOT), (VALUE, "act"))))]
    threads, held = threading.active_count(), psutil.Process().memory_info().rss
    with Client(port) as good:
        acts, sent = 0, 0
        while sent < FRAMES:
            with socket.create_connection(("127.0.0.1", port), timeout=20) as bad:
                for _ in range(20):
                    frame = bytearray(choose.choice(frames))
                    for _ in range(choose.randrange(1, 4)):
                        frame[choose.randrange(5 if choose.random() < 0.9 else 0, len(frame))] = choose.randrange(256)
                    sent += 1
                    try:
                        bad.sendall(frame)
                    except OSError:
                        break
            acts += 1
            assert good.act(document(3, "x"))[-1] == acts
    wait_for(lambda: sessions(replicas) == 0)
    wait_for(lambda: threading.active_count() <= threads)
    assert psutil.Process().memory_info().rss - held < GROWTH


def test_with_keys_on_the_dialect_is_refused_unless_the_deployment_accepts_clients_without(open_vlagents) -> None:
    """The protocol has no place for a key."""
    with pytest.raises(ConfigError, match="without_key: true"):
        open_vlagents(check=lambda _: NoKey.OPEN)
    with Client(open_vlagents(check=lambda _: NoKey.OPEN, without_key=True)) as client:
        assert client.act(document())[-1] == 1


def test_a_taken_port_is_named_with_the_cure() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=rf"vlagents: cannot listen on 127.0.0.1:{port}.*choose another port"):
            reserve("vlagents", "127.0.0.1", port, timeout_s=0)
    with pytest.raises(ConfigError, match="no address"):
        reserve("vlagents", "no.such.host.invalid", port, timeout_s=0)


def test_a_reserved_port_accepts_nobody_before_the_dialect_is_served() -> None:
    with reserve("vlagents", "127.0.0.1", 0) as listener, pytest.raises(ConnectionRefusedError):
        socket.create_connection(listener.getsockname(), timeout=5)


def test_a_reply_of_the_protocol_is_of_bounded_kinds() -> None:
    with pytest.raises(TypeError):
        rpyc.reply(1, object())


def test_a_ping_is_answered_with_its_text_and_nothing_else(open_vlagents, caplog: pytest.LogCaptureFixture) -> None:
    with Client(open_vlagents()) as client:
        for boxed, kind in (
            ((TUPLE, ((VALUE, "abc"),)), REPLY),
            ((TUPLE, ()), REPLY),
            ((TUPLE, ((LOCAL, ROOT),)), EXCEPTION),
            ((TUPLE, ((TUPLE, ((LOCAL, ROOT),)),)), EXCEPTION),
            ((TUPLE, ((VALUE, 1.5),)), EXCEPTION),
        ):
            client.send(request(1, Handler.PING, boxed))
            assert client.receive()[0] == kind
    assert "failed" not in caplog.text
