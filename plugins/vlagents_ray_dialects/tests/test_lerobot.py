"""Tests of clients of LeRobot's asynchronous inference over real gRPC: their sessions, and the
effects of faulty clients.
"""

from __future__ import annotations

import contextlib
import itertools
import random
import socket
import threading
from collections.abc import Iterator
from functools import partial
from typing import Any

import grpc
import numpy as np
import pytest
from eval_fakes import wait_for
from in_process_replicas import Replicas
from lerobot_messages import (
    BEGIN,
    END,
    FEATURES,
    MIDDLE,
    AsyncClient,
    field_of,
    parts_of,
    pickled,
    robot_saw,
    setup,
)
from many import many

from vlagents_ray_dialects.gateway_sessions import GatewaySessions
from vlagents_ray_dialects.messages import lerobot


@pytest.fixture
def open_lerobot(open_dialect: Any) -> Any:
    return partial(open_dialect, "lerobot")


def sessions(replicas: Replicas) -> int:
    return len(replicas.engines[0].sessions)


def rows(answer: list) -> list[list[float]]:
    return [action.action.tolist() for action in answer]


def status_of(error: pytest.ExceptionInfo[grpc.RpcError]) -> tuple[str, str]:
    return error.value.code().name, error.value.details()


def test_each_client_has_a_session_and_gets_its_chunks(open_lerobot, replicas: Replicas) -> None:
    port = open_lerobot()
    with AsyncClient(port) as red, AsyncClient(port) as blue:
        red.begin(), blue.begin(actions_per_chunk=1)
        answer = red.act(robot_saw(4, pixel=10))
        # A row contains a pixel, the first number of the state, -1 for no gripper, the length of
        # the task, and the number of the act.
        assert rows(answer) == [[10, 0.5, -1, 3, 1], [10, 0.5, -1, 3, 2]]
        assert [(action.timestep, round(action.timestamp, 4)) for action in answer] == [
            (4, 1004),
            (5, 1004.0333),
        ]
        assert rows(blue.act(robot_saw(0, pixel=20, task="ab"))) == [[20, 0.5, -1, 2, 1]]
        assert rows(red.act(robot_saw(5, pixel=11)))[0] == [11, 0.5, -1, 3, 2]
        # A new task begins an episode.
        assert rows(red.act(robot_saw(6, pixel=11, task="another")))[0] == [11, 0.5, -1, 7, 1]
        assert sessions(replicas) == 2


def test_the_sessions_of_clients_that_disconnect_end_at_once(
    open_lerobot, replicas: Replicas
) -> None:
    port = open_lerobot(idle_s=600.0)
    with AsyncClient(port).begin() as silent:
        assert rows(silent.act(robot_saw(0, pixel=1)))[0][4] == 1
        for _ in range(12):  # more than the 8 sessions that the gateway may have
            with AsyncClient(port).begin() as robot:
                assert rows(robot.act(robot_saw(0, pixel=2)))[0][4] == 1
        wait_for(lambda: sessions(replicas) == 1, timeout_s=5.0)
        assert rows(silent.act(robot_saw(1, pixel=1)))[0][4] == 2


def test_the_newest_observation_is_acted_on_and_a_time_step_once(open_lerobot) -> None:
    with AsyncClient(open_lerobot()).begin() as robot:
        robot.send(robot_saw(0, pixel=1))
        robot.send(robot_saw(0, pixel=2))
        assert rows(robot.actions())[0][0] == 2
        # Ignored, as the policy has received an observation of this time step.
        robot.send(robot_saw(0, pixel=3))
        robot.send(robot_saw(1, pixel=4))
        assert rows(robot.actions())[0][0] == 4
        robot.send(robot_saw(1, pixel=5, must_go=True))  # the robot has no action left
        robot.send(robot_saw(1, pixel=6))
        assert rows(robot.actions())[0][0] == 5


def test_who_asks_before_the_observation_gets_its_actions(open_lerobot) -> None:
    with AsyncClient(open_lerobot()).begin() as robot:
        answer = robot.get.future(b"", timeout=20)
        robot.send(robot_saw(0, pixel=9))
        assert answer.result()


def test_without_an_observation_there_are_no_actions(
    open_lerobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vlagents_ray_dialects.lerobot._WAIT_S", 0.05)
    with AsyncClient(open_lerobot()).begin() as robot:
        assert robot.actions() == []


def test_ready_begins_an_episode(open_lerobot, replicas: Replicas) -> None:
    with AsyncClient(open_lerobot()).begin() as robot:
        assert rows(robot.act(robot_saw(0)))[0][4] == 1
        assert rows(robot.act(robot_saw(1)))[0][4] == 2
        robot.begin()
        assert rows(robot.act(robot_saw(0)))[0][4] == 1
        assert sessions(replicas) == 1


def test_an_observation_in_many_parts(open_lerobot) -> None:
    with AsyncClient(open_lerobot()).begin() as robot:
        robot.send_parts(parts_of(pickled(robot_saw(0, pixel=7)), 40), timeout=20)
        assert rows(robot.actions())[0][0] == 7


def test_a_mapping_gives_the_policys_names(open_lerobot) -> None:
    mapping = {
        "cameras": {"top": "observation.images.front"},
        "state": {"q": {"key": "observation.state", "start": 1}},
    }
    with AsyncClient(open_lerobot(mapping=mapping)).begin() as robot:
        # This mapping has no instruction.
        assert rows(robot.act(robot_saw(0, pixel=6)))[0][:4] == [6, 0.25, -1, 0]
    mapping["cameras"] = {"top": "observation.images.side"}
    with (
        AsyncClient(open_lerobot(mapping=mapping)).begin() as robot,
        pytest.raises(grpc.RpcError, match=r"missing_camera: camera 'observation\.images\.side'"),
    ):
        robot.send(robot_saw(0))


def test_policy_instructions_that_do_not_fit_are_refused(open_lerobot) -> None:
    many_images = {f"observation.images.{n}": {"dtype": "image"} for n in range(17)}
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"checkpoint": "you/pi0"}, "expected 'me/act', the checkpoint of this server"),
        ({"rename_map": {"a": "b"}}, "rename_map"),
        ({"actions_per_chunk": 0}, "an integer of 1 or more"),
        (
            {"lerobot_features": {"observation.state": {"dtype": "string"}}},
            "expected 'observation.state' of float32",
        ),
        (
            {"lerobot_features": {"observation.state": {"dtype": "float32", "names": None}}},
            "expected `names`",
        ),
        ({"lerobot_features": {"observation.state": None}}, "expected a dict, got NoneType"),
        ({"lerobot_features": []}, "expected dicts, got list, dict"),
        ({"lerobot_features": many_images}, "expected at most 16 cameras"),
        ({"policy_type": 3}, "policy_type: expected text, got 3"),
        ({"policy_type": len}, "names 'builtins' 'len'"),
    ]
    with AsyncClient(open_lerobot(checkpoint="me/act")) as robot:
        for changes, says in wrong:
            with pytest.raises(grpc.RpcError) as error:
                robot.begin(**changes)
            assert status_of(error)[0] in ("INVALID_ARGUMENT", "RESOURCE_EXHAUSTED")
            assert says in status_of(error)[1]


def test_a_bad_observation_is_refused_and_the_next_is_acted_on(open_lerobot) -> None:
    wrong = [
        (robot_saw(99, front=None), "front"),
        (robot_saw(99, front=np.zeros((8, 8, 3), np.float64) + 7), "float64 from 7 to 7"),
        (robot_saw(99, front=np.zeros((8, 8), np.uint8)), "camera 'observation.images.front'"),
        (robot_saw(99, **{"gripper.pos": "open"}), "'gripper.pos': expected a number, got str"),
        (robot_saw(-1), "timestep: expected an integer in [0, 2**31), got -1"),
        (robot_saw(2**31), "timestep: expected an integer in [0, 2**31), got 2147483648"),
        (setup(), "expected a TimedObservation with its fields, got RemotePolicyConfig"),
        (b"no pickle", "protocol 4 or 5"),
    ]
    with AsyncClient(open_lerobot()).begin() as robot:
        for step, (observation, says) in enumerate(wrong):
            data = observation if isinstance(observation, bytes) else pickled(observation)
            with pytest.raises(grpc.RpcError) as error:
                robot.send_parts(parts_of(data), timeout=20)
            assert status_of(error)[0] == "INVALID_ARGUMENT"
            assert says in status_of(error)[1]
            assert rows(robot.act(robot_saw(step, pixel=3)))[0][0] == 3
        robot.begin(lerobot_features={**FEATURES, "observation.images.wrist": {"dtype": "image"}})
        with pytest.raises(grpc.RpcError, match="missing_camera: camera 'wrist'"):
            robot.send(robot_saw(0))


def test_nothing_is_done_before_ready_and_the_instructions(
    open_lerobot, replicas: Replicas
) -> None:
    with AsyncClient(open_lerobot()) as robot:
        for attempt in (
            lambda: robot.send(robot_saw(0)),
            robot.actions,
            lambda: robot.instruct(field_of(1, pickled(setup())), timeout=20),
        ):
            with pytest.raises(
                grpc.RpcError, match="Ready: expected one over this connection, got none"
            ) as error:
                attempt()
            assert status_of(error)[0] == "FAILED_PRECONDITION"
        robot.ready(b"", timeout=20)
        with pytest.raises(
            grpc.RpcError, match="SendPolicyInstructions: expected one after Ready, got none"
        ):
            robot.send(robot_saw(0))
        assert sessions(replicas) == 0


def _unended() -> Iterator[bytes]:
    yield field_of(1, BEGIN) + field_of(2, b"abc")


def test_messages_that_are_none_are_refused(open_lerobot) -> None:
    wrong: list[tuple[Iterator[bytes], str]] = [
        (iter([]), "ended before its last part"),
        (_unended(), "ended before its last part"),
        (iter([*_unended(), *_unended()]), "begins twice"),
        (iter([field_of(1, 0)]), "expected transfer state 1, 2 or 3, got 0"),
        (iter([field_of(1, 9)]), "expected transfer state 1, 2 or 3, got 9"),
        (iter([b"\x12\xff"]), "ends too early"),
        (iter([b"\x80" * 20]), "a number that ends too early"),
        (iter([b"\x0b"]), "unknown type"),
        (
            itertools.repeat(field_of(1, MIDDLE) + field_of(2, bytes(2**18))),
            "more than 2097152 bytes",
        ),
    ]
    with AsyncClient(open_lerobot()).begin() as robot:
        for step, (messages, says) in enumerate(wrong):
            with pytest.raises(grpc.RpcError, match=says):
                robot.send_parts(messages, timeout=20)
            assert rows(robot.act(robot_saw(step, pixel=3)))[0][0] == 3


def test_a_compressed_message_is_not_decompressed(open_lerobot) -> None:
    with AsyncClient(open_lerobot()).begin() as robot:
        bomb = field_of(1, END) + field_of(2, bytes(3 * 2**20))
        with pytest.raises(grpc.RpcError) as error:
            robot.send_parts(iter([bomb]), timeout=20, compression=grpc.Compression.Gzip)
        assert status_of(error)[0] in ("UNIMPLEMENTED", "INTERNAL")


def test_an_observation_that_takes_too_long_ends(
    open_lerobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vlagents_ray_dialects.lerobot._UPLOAD_S", 0.2)
    monkeypatch.setattr("vlagents_ray_dialects.acceptor.TICK_S", 0.05)
    goes_on = threading.Event()

    def slowly() -> Iterator[bytes]:
        yield from _unended()
        goes_on.wait(60)

    with AsyncClient(open_lerobot()).begin() as robot:
        try:
            with pytest.raises(grpc.RpcError) as error:
                robot.send_parts(slowly(), timeout=20)
            assert status_of(error)[0] == "CANCELLED"
        finally:
            goes_on.set()
        assert rows(robot.act(robot_saw(0, pixel=3)))[0][0] == 3


def test_a_client_that_is_gone_loses_its_session(
    open_lerobot, replicas: Replicas, monkeypatch
) -> None:
    monkeypatch.setattr("vlagents_ray_dialects.acceptor.TICK_S", 0.05)
    port = open_lerobot(idle_s=0.2)
    with AsyncClient(port).begin() as robot:
        robot.act(robot_saw(0))
        wait_for(lambda: sessions(replicas) == 0)


def test_there_are_so_many_clients_and_one_without_a_session_makes_room(open_lerobot) -> None:
    port = open_lerobot(sessions=2)
    with (
        AsyncClient(port) as idle,
        AsyncClient(port) as first,
        AsyncClient(port) as second,
        AsyncClient(port) as third,
    ):
        idle.begin()
        first.begin().act(robot_saw(0))
        second.begin().act(robot_saw(0))
        with pytest.raises(grpc.RpcError, match="2 clients are connected, the limit") as error:
            third.ready(b"", timeout=20)
        assert status_of(error)[0] == "UNAVAILABLE"
        with pytest.raises(
            grpc.RpcError, match="Ready: expected one over this connection, got none"
        ):
            idle.send(robot_saw(0))


def test_an_unknown_method_is_not_served(open_lerobot) -> None:
    with AsyncClient(open_lerobot()) as robot, pytest.raises(grpc.RpcError) as error:
        robot.channel.unary_unary("/transport.LearnerService/Ready")(b"", timeout=20)
    assert status_of(error)[0] == "UNIMPLEMENTED"


def test_no_other_process_shares_the_port(open_lerobot) -> None:
    port = open_lerobot()
    server = grpc.server(None, options=[("grpc.so_reuseport", 1)])
    with pytest.raises(RuntimeError, match="bind"):
        server.add_insecure_port(f"127.0.0.1:{port}")


def test_what_is_no_error_of_ours_is_logged_and_not_shown(
    open_lerobot, caplog, monkeypatch
) -> None:
    monkeypatch.setattr(lerobot, "frame", lambda *_: 1 / 0)
    with AsyncClient(open_lerobot()).begin() as robot, pytest.raises(grpc.RpcError) as error:
        robot.send(robot_saw(0))
    status, details = status_of(error)
    assert (status, "ZeroDivisionError" in caplog.text, "division" in details) == (
        "INTERNAL",
        True,
        False,
    )


def test_a_time_step_whose_action_failed_may_come_again(
    open_lerobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    act = GatewaySessions.act
    monkeypatch.setattr(GatewaySessions, "act", lambda *_: 1 / 0)
    with AsyncClient(open_lerobot()).begin() as robot:
        with pytest.raises(grpc.RpcError, match="internal error"):
            robot.act(robot_saw(3))
        monkeypatch.setattr(GatewaySessions, "act", act)
        assert robot.act(robot_saw(3, pixel=5))


def test_garbage_instead_of_grpc_holds_up_nobody(open_lerobot) -> None:
    port, choose = open_lerobot(), random.Random(1)
    preface = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
    with AsyncClient(port).begin() as robot:
        robot.act(robot_saw(0))
        for number in range(many(300)):
            with (
                contextlib.suppress(OSError),
                socket.create_connection(("127.0.0.1", port), timeout=10) as connection,
            ):
                connection.sendall(preface * (number % 3 > 0))
                if number % 3 == 2:  # a frame of any kind
                    connection.sendall(
                        b"\0\0" + bytes([9, choose.randrange(11)]) + choose.randbytes(5)
                    )
                connection.sendall(choose.randbytes(choose.randrange(200)))
        assert rows(robot.act(robot_saw(1, pixel=4)))[0] == [4, 0.5, -1, 3, 2]
