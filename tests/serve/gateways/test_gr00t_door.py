"""The ZMQ door: who gets what, and what a bad client can do to the others."""

from __future__ import annotations

import os
import random
import socket
import threading
import time
from typing import Any

import gr00t_client
import msgpack
import numpy as np
import psutil
import pytest
import zmq
from eval_fakes import wait_for
from gr00t_client import PolicyClient
from in_process import Replicas

from vlagents_ray.errors import InvalidInput

FRAMES = int(os.environ.get("VLAGENTS_RAY_FUZZ", "5000"))
GROWTH = 64 * 2**20  # bytes, whatever the number of frames


def sessions(replicas: Replicas) -> int:
    return len(replicas.engines[0].sessions)


def seen(pixel: int, text: str = "abc", batch: int = 1) -> dict[str, Any]:
    pixels = np.arange(pixel, pixel + batch, dtype=np.uint8).reshape(batch, 1, 1, 1, 1)
    return {
        "video": {"ego": pixels * np.ones((8, 8, 3), np.uint8)},
        "state": {"arm": np.full((batch, 1, 3), 0.5, np.float32)},
        "language": {"task": [[text]] * batch},
    }


def rows(action: dict[str, np.ndarray], of: int = 0) -> list[float]:
    return action["action"][of, 0].tolist()


@pytest.mark.parametrize("packed", [False, True])
def test_each_client_has_a_session(open_gr00t, replicas: Replicas, packed: bool) -> None:
    port = open_gr00t()
    with PolicyClient(port, packed=packed) as red, PolicyClient(port) as blue:
        assert red.ping() == {"status": "ok", "message": "Server is running"}
        action, info = red.get_action(seen(10))
        assert action["action"].shape == (1, 2, 5)
        assert action["action"].dtype == np.float32
        assert rows(action) == [10, 0.5, -1, 3, 1]
        assert info["done"] == [False]
        assert rows(blue.get_action(seen(20, "abcdef"))[0]) == [20, 0.5, -1, 6, 1]
        assert rows(red.get_action(seen(11))[0]) == [11, 0.5, -1, 3, 2]
        assert sessions(replicas) == 2
        assert red.reset() == {}
        assert rows(red.get_action(seen(12))[0])[-1] == 1
        assert rows(blue.get_action(seen(21, "abcdef"))[0])[-1] == 2


def test_a_batch_is_as_many_sessions(open_gr00t, replicas: Replicas) -> None:
    with PolicyClient(open_gr00t()) as client:
        for step in (1, 2):
            action, _ = client.get_action(seen(100, batch=4))
            assert [rows(action, i) for i in range(4)] == [[100 + i, 0.5, -1, 3, step] for i in range(4)]
        assert sessions(replicas) == 4
        assert rows(client.get_action(seen(7))[0]) == [7, 0.5, -1, 3, 3]
        assert sessions(replicas) == 1


def test_a_client_of_n1_5_sends_flat_keys(open_gr00t) -> None:
    mapping = {"preset": "gr00t", "action": {"arm": {"stop": 3}, "hand": {"start": 3}}}
    flat = {
        "video.ego": np.full((1, 8, 8, 3), 9, np.uint8),
        "state.arm": np.ones((1, 3)),
        "annotation.human.action.task_description": ["abcd"],
    }
    with PolicyClient(open_gr00t(mapping=mapping)) as client:
        action = client.get_action_n15(flat)
        assert action["action.arm"][0].tolist() == [9, 1, -1]
        assert action["action.hand"].tolist() == [[4, 1], [4, 2]]
        assert client.get_modality_config()["action"]["modality_keys"] == ["arm", "hand"]


def test_a_client_is_told_its_own_names(open_gr00t) -> None:
    mapping = {"cameras": {"front": "video/ego_view"}, "state": {"joints": ["state/arm", "state/hand"]}}
    with PolicyClient(open_gr00t(mapping=mapping)) as client:
        config = client.get_modality_config()
    assert config["video"] == {"delta_indices": [0], "modality_keys": ["ego_view"]}
    assert config["state"]["modality_keys"] == ["arm", "hand"]


def test_errors_are_told_without_a_traceback_and_the_client_goes_on(open_gr00t) -> None:
    with PolicyClient(open_gr00t(mapping={"cameras": {"front": "video/front"}})) as client:
        with pytest.raises(RuntimeError, match="missing_camera: camera 'video/front' is missing") as error:
            client.get_action(seen(1))
        assert ".py" not in str(error.value)
        with pytest.raises(RuntimeError, match="unknown endpoint 'kill'"):
            client.call_endpoint("kill", requires_input=False)
        assert client.ping()["status"] == "ok"


def test_a_key_is_checked_before_anything_is_done(open_gr00t, replicas: Replicas) -> None:
    def check(key: str | None) -> None:
        if key != "right":
            raise InvalidInput("no such key")

    port = open_gr00t(check=check)
    for token in (None, "wrong"):
        with PolicyClient(port, token) as client:
            for ask in (client.ping, client.reset, client.get_modality_config, lambda: client.get_action(seen(1))):
                with pytest.raises(RuntimeError, match="no such key"):
                    ask()
    assert sessions(replicas) == 0
    with PolicyClient(port, "right") as client:
        assert rows(client.get_action(seen(1))[0])[0] == 1


def test_a_client_that_says_nothing_is_forgotten(open_gr00t, replicas: Replicas) -> None:
    with PolicyClient(open_gr00t(idle_s=0.5)) as client:
        client.get_action(seen(1))
        assert sessions(replicas) == 1
        wait_for(lambda: sessions(replicas) == 0)
        assert rows(client.get_action(seen(2))[0]) == [2, 0.5, -1, 3, 1]


def test_one_client_more_than_the_limit_is_told_so_unless_another_has_no_session(open_gr00t) -> None:
    port = open_gr00t(sessions=2)
    with PolicyClient(port) as one, PolicyClient(port) as two, PolicyClient(port) as three:
        one.get_action(seen(1))
        two.ping()
        three.get_action(seen(3))  # takes the place of the one that only pinged
        with pytest.raises(RuntimeError, match="unavailable: 2 clients"):
            two.ping()
        assert rows(one.get_action(seen(1))[0])[-1] == 2


def test_a_slow_and_a_greedy_client_hold_up_nobody(open_gr00t) -> None:
    port = open_gr00t()
    context = zmq.Context()
    deaf = context.socket(zmq.DEALER)  # sends and never reads
    deaf.setsockopt(zmq.LINGER, 0)
    deaf.setsockopt(zmq.SNDTIMEO, 50)
    deaf.setsockopt(zmq.RCVHWM, 1)
    deaf.connect(f"tcp://127.0.0.1:{port}")
    request = {"endpoint": "get_action", "data": {"observation": seen(1), "options": None}}
    message = msgpack.packb(request, default=gr00t_client.encode)
    try:
        for _ in range(200):
            try:
                deaf.send_multipart([b"", message])
            except zmq.Again:
                break
        with socket.create_connection(("127.0.0.1", port)), PolicyClient(port) as good:  # one that never greets
            for step in range(1, 6):
                assert rows(good.get_action(seen(5))[0]) == [5, 0.5, -1, 3, step]
    finally:
        deaf.close()
        context.term()


def test_mutated_messages_get_an_error_or_an_answer(open_gr00t, replicas: Replicas) -> None:
    """A good client acts all the while; memory and threads stay what they were."""
    port = open_gr00t(sessions=16)
    choose = random.Random(3)
    request = {"endpoint": "get_action", "data": {"observation": seen(9), "options": None}}
    messages = [msgpack.packb(request, default=encode) for encode in (gr00t_client.encode, gr00t_client.encode_packed)]
    messages.append(msgpack.packb({"endpoint": "ping"}))
    context = zmq.Context()
    bad = context.socket(zmq.REQ)
    bad.setsockopt(zmq.RCVTIMEO, 20_000)
    bad.setsockopt(zmq.LINGER, 0)
    bad.connect(f"tcp://127.0.0.1:{port}")
    try:
        with PolicyClient(port) as good:
            good.ping()
            threads, held = threading.active_count(), psutil.Process().memory_info().rss
            for number in range(FRAMES):
                message = bytearray(choose.choice(messages))
                for _ in range(choose.randrange(1, 4)):
                    message[choose.randrange(len(message))] = choose.randrange(256)
                bad.send(bytes(message[: choose.randrange(1, len(message) + 1)] if number % 4 == 0 else message))
                msgpack.unpackb(bad.recv())
                if number % 200 == 0:
                    assert rows(good.get_action(seen(5))[0])[-1] == number // 200 + 1
            assert threading.active_count() <= threads + 2
            assert psutil.Process().memory_info().rss - held < GROWTH
    finally:
        bad.close()
        context.term()


def test_bytes_that_are_no_zmq_are_hung_up_on(open_gr00t) -> None:
    port = open_gr00t()
    choose = random.Random(1)
    for _ in range(200):
        with socket.create_connection(("127.0.0.1", port), timeout=20) as stranger:
            stranger.sendall(choose.randbytes(choose.randrange(1, 200)))
    with PolicyClient(port) as good:
        begun = time.monotonic()
        assert good.ping()["status"] == "ok"
        assert time.monotonic() - begun < 10
