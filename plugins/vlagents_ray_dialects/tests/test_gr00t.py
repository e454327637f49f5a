"""Tests of GR00T's clients, N1.5 and newer, over ZMQ: messages, sessions, and the effects of faulty
clients.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import random
import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gr00t_client
import msgpack
import numpy as np
import psutil
import pytest
import zmq
from eval_fakes import wait_for
from gr00t_client import PolicyClient
from in_memory_keys import ChangingKeys
from in_process_replicas import Replicas
from many import many

from vlagents_ray.errors import InvalidObservation, MalformedMessage, MessageTooLarge, VLAgentsError
from vlagents_ray.protocol.messages import MessageLimits
from vlagents_ray.serve.access import api_keys
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.dialects.base import GatewayContext
from vlagents_ray.serve.ports import free_port, reserve
from vlagents_ray_dialects.gr00t import GR00TDialect
from vlagents_ray_dialects.messages import gr00t as gr00t_codec

LIMITS = MessageLimits()


def said(
    endpoint: str, data: Any = None, encode: Callable[[Any], Any] = gr00t_client.encode, **more: Any
) -> bytes:
    """Return a request as the client packs it."""
    return msgpack.packb({"endpoint": endpoint, "data": data, **more}, default=encode)


def nested(b: int = 1, t: int = 1, texts: Any = None) -> dict[str, Any]:
    """Return an observation of N1.6 and newer."""
    video = np.arange(b * t, dtype=np.uint8).reshape(b, t, 1, 1, 1) * np.ones((4, 6, 3), np.uint8)
    state = np.arange(b * t, dtype=np.float32).reshape(b, t, 1) * np.ones(2, np.float32)
    return {
        "video": {"ego": video},
        "state": {"arm": state},
        "language": {"task": texts or [["go"]] * b},
    }


@pytest.mark.parametrize("encode", [gr00t_client.encode, gr00t_client.encode_packed])
def test_arrays_come_as_numpy_writes_them(encode: Callable[[Any], Any]) -> None:
    for dtype, shape in itertools.product(
        ("|u1", "<f4", "<f8", "<i8", "|b1"), ((), (3,), (2, 0, 3), (1, 2, 3, 4))
    ):
        array = np.ones(shape, dtype)
        request = gr00t_codec.read_request(said("get_action", {"a": array}, encode), LIMITS)
        assert request.packed == (encode is gr00t_client.encode_packed)
        assert request.data["a"].dtype == array.dtype
        assert np.array_equal(request.data["a"], array)


def test_a_fortran_array_and_text_arrays_are_read() -> None:
    array = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    data = gr00t_codec.read_request(
        said("get_action", {"a": array, "t": np.array(["go"])}), LIMITS
    ).data
    assert np.array_equal(data["a"], array)
    assert data["t"] == ["go"]


def test_observations_of_a_batch_are_taken_apart_and_actions_joined() -> None:
    asked = gr00t_codec.read_observations(
        {"observation": nested(3, 1, [["a"], ["b"], ["c"]]), "options": None}
    )
    assert (len(asked.each), asked.batched, asked.flat, asked.paired) == (3, True, False, True)
    last = [gr00t_codec.at_its_time_step(one) for one in asked.each]
    assert [int(one["video"]["ego"].max()) for one in last] == [0, 1, 2]
    assert [one["state"]["arm"].tolist() for one in last] == [[0, 0], [1, 1], [2, 2]]
    assert [one["language"] for one in last] == [{"task": "a"}, {"task": "b"}, {"task": "c"}]
    action, info = gr00t_codec.write_actions(
        [{"arm": np.full((4, 2), i)} for i in range(3)], asked, {"done": []}
    )
    assert action["arm"].shape == (3, 4, 2)
    assert info == {"done": []}


@pytest.mark.parametrize("batched", [True, False])
def test_n1_5_sends_flat_keys_and_gets_the_actions_alone(batched: bool) -> None:
    lead = (1, 1) if batched else (1,)
    data = {
        "video.ego": np.zeros((*lead, 4, 6, 3), np.uint8),
        "state.arm": np.zeros((*lead, 2)),
        "annotation.human.action.task_description": ["go"],
    }
    asked = gr00t_codec.read_observations(data)
    assert (asked.batched, asked.flat, asked.paired) == (batched, True, False)
    assert gr00t_codec.at_its_time_step(asked.each[0])["language"] == {"task": "go"}
    answer = gr00t_codec.write_actions([{"arm": np.zeros((4, 2))}], asked, {})
    assert answer["action.arm"].shape == ((1, 4, 2) if batched else (4, 2))


@pytest.mark.parametrize(
    "observation",
    [
        {},
        {"video": {"ego": np.zeros((4, 6, 3), np.uint8)}},
        {
            "video": {"ego": np.zeros((1, 1, 4, 6, 3), np.uint8)},
            "state": {"arm": np.zeros((2, 1, 2))},
        },
        {"video": {"ego": np.zeros((1, 0, 4, 6, 3), np.uint8)}},
        nested(1, 3),
        nested(2, 2),
        nested() | {"state": {"arm": np.zeros((1, 2, 2), np.float32)}},
        nested() | {"language": {"task": [["go", "stop"]]}},
        {"video": {"ego": "x"}},
        {"video": {"ego": np.zeros((0, 1, 4, 6, 3), np.uint8)}},
        {"video": [], "state": {"arm": np.zeros((1, 1, 2))}},
        nested(2, 1, [["a"], ["b"], ["c"]]),
        nested() | {"language": {"task": 3}},
        nested() | {"language": {"task": [["a"]], "other": [["b"]]}},
    ],
)
def test_an_observation_that_does_not_fit_is_refused(observation: dict[str, Any]) -> None:
    with pytest.raises(InvalidObservation):
        gr00t_codec.read_observations({"observation": observation})


def npy(header: bytes, content: bytes = b"") -> dict[str, Any]:
    return {
        "__ndarray_class__": True,
        "as_npy": b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + content,
    }


def pickled() -> dict[str, Any]:
    file = io.BytesIO()
    np.save(file, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    return {"__ndarray_class__": True, "as_npy": file.getvalue()}


@pytest.mark.parametrize(
    "array",
    [
        pickled(),
        npy(b"{'descr': '|u1', 'fortran_order': False, 'shape': (999999999999,), }\n"),
        npy(b"{'descr': '|u1', 'fortran_order': False, 'shape': (-1,), }\n"),
        npy(b"{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,), }\n", bytes(4)),
        npy(b"{'descr': '<c16', 'fortran_order': False, 'shape': (1,), }\n", bytes(16)),
        npy(b"(" * 900),
        {"__ndarray_class__": True, "as_npy": "text"},
        {"__ndarray_class__": True},
        {b"nd": True, b"kind": b"O", b"type": "|O", b"shape": [1], b"data": b"pickle"},
        {b"nd": True, b"kind": b"V", b"type": [["a", "<f4"]], b"shape": [1], b"data": bytes(4)},
        {b"nd": True, b"kind": b"", b"type": "<f4", b"shape": [2**40], b"data": bytes(4)},
    ],
)
def test_arrays_that_hold_objects_or_lie_are_refused(array: dict[str, Any]) -> None:
    with pytest.raises(MalformedMessage):
        gr00t_codec.read_request(said("get_action", {"a": array}), LIMITS)


@pytest.mark.parametrize("endpoint", ["kill", "", 3, "get_action2"])
def test_there_is_no_kill(endpoint: Any) -> None:
    with pytest.raises(MalformedMessage, match="endpoint"):
        gr00t_codec.read_request(said(endpoint), LIMITS)


def test_too_many_values_and_too_deep_ones_are_refused() -> None:
    with pytest.raises(VLAgentsError):
        gr00t_codec.read_request(said("get_action", {str(i): {} for i in range(20_000)}), LIMITS)
    with pytest.raises(VLAgentsError):
        gr00t_codec.read_request(
            said("get_action", {str(i): [0] * 500 for i in range(100)}), LIMITS
        )
    with pytest.raises(MalformedMessage):
        gr00t_codec.read_request(b"\x91" * 100_000, LIMITS)
    with pytest.raises(MessageTooLarge):
        gr00t_codec.read_request(bytes(2000), MessageLimits(body_bytes=1024))


def test_a_header_made_to_be_searched_for_long_is_refused_at_once() -> None:
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (" + b"1" * 28 + b"x"
    file = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    begun = time.process_time()
    with pytest.raises(MalformedMessage):
        gr00t_codec.read_request(
            said("get_action", {"a": {"__ndarray_class__": True, "as_npy": file}}), LIMITS
        )
    # With backtracking, each digit doubled the time: 28 digits took ten seconds.
    assert time.process_time() - begun < 1.0


def test_arrays_of_text_count_by_their_texts() -> None:
    with pytest.raises(MessageTooLarge, match="values"):
        gr00t_codec.read_request(
            said("get_action", {str(i): np.full((60, 100), "x") for i in range(2)}), LIMITS
        )


FRAMES = int(os.environ.get("VLAGENTS_RAY_FUZZ", many(5000)))
GROWTH = 64 * 2**20  # allowed growth of the memory, bytes, for any number of frames


def sessions(replicas: Replicas) -> int:
    return len(replicas.engines[0].sessions)


def seen(pixel: int, text: str = "abc", batch: int = 1) -> dict[str, Any]:
    pixels = np.arange(pixel, pixel + batch, dtype=np.uint8).reshape(batch, 1, 1, 1, 1)
    return {
        "video": {"ego": pixels * np.ones((8, 8, 3), np.uint8)},
        "state": {"arm": np.full((batch, 1, 3), 0.5, np.float32)},
        "language": {"task": [[text]] * batch},
    }


def so100(pixel: int, text: str) -> dict[str, Any]:
    """Return an observation as N1.5's SO-100 client (examples/SO-100/eval_lerobot.py) builds it:
    two cameras, and a batch of one.
    """
    return {
        "video.front": np.full((1, 8, 8, 3), pixel, np.uint8),
        "video.wrist": np.zeros((1, 8, 8, 3), np.uint8),
        "state.single_arm": np.full((1, 5), 3.0),
        "state.gripper": np.ones((1, 1)),
        "annotation.human.task_description": [text],
    }


def rows(action: dict[str, np.ndarray], of: int = 0) -> list[float]:
    return action["action"][of, 0].tolist()


def test_each_client_has_a_session(open_dialect, replicas: Replicas) -> None:
    port = open_dialect("gr00t")
    with PolicyClient(port, packed=True) as red, PolicyClient(port) as blue:
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


def test_a_batch_is_as_many_sessions(open_dialect, replicas: Replicas) -> None:
    with PolicyClient(open_dialect("gr00t")) as client:
        for step in (1, 2):
            action, _ = client.get_action(seen(100, batch=4))
            assert [rows(action, i) for i in range(4)] == [
                [100 + i, 0.5, -1, 3, step] for i in range(4)
            ]
        assert sessions(replicas) == 4
        assert rows(client.get_action(seen(7))[0]) == [7, 0.5, -1, 3, 3]
        assert sessions(replicas) == 1


@pytest.mark.parametrize("preset", ["gr00t", "gr00t-n1.5"])
def test_each_preset_delivers_what_either_generation_sends(
    open_dialect, replicas: Replicas, preset: str
) -> None:
    port = open_dialect(
        "gr00t",
        mapping={"preset": preset, "action": {"action.arm": {"stop": 3}, "hand": {"start": 3}}},
    )
    with PolicyClient(port, n15=True) as client:
        action = client.get_action_n15(so100(9, "abcd"))
        assert (action["action.arm"][0].tolist(), action["action.hand"][0].tolist()) == (
            [9, 3, -1],
            [4, 1],
        )
    with PolicyClient(port) as client:
        action, _ = client.get_action(seen(10))
        assert (action["arm"][0, 0].tolist(), action["hand"][0, 0].tolist()) == (
            [10, 0.5, -1],
            [3, 1],
        )


@pytest.mark.parametrize(
    ("n15", "mapping", "names"),
    [
        (
            True,
            {
                "preset": "gr00t-n1.5",
                "cameras": {"front": "video.webcam"},
                "state": {"joints": "state.single_arm"},
            },
            {
                "video": ["video.webcam"],
                "state": ["state.single_arm"],
                "action": ["action"],
                "language": ["annotation.human.task_description"],
            },
        ),
        (
            False,
            {
                "cameras": {"front": "video/ego_view"},
                "state": {"joints": ["state/arm", "state/hand"]},
            },
            {
                "video": ["ego_view"],
                "state": ["arm", "hand"],
                "action": ["action"],
                "language": ["task"],
            },
        ),
        # The policy declares no contract.
        (False, "gr00t", {"action": ["action"], "language": ["task"]}),
    ],
)
def test_a_config_has_the_clients_names_as_its_generation_reads_them(
    open_dialect, n15, mapping, names
) -> None:
    with PolicyClient(open_dialect("gr00t", mapping=mapping), n15=n15) as client:
        config = client.get_modality_config()
    assert {name: one["modality_keys"] for name, one in config.items()} == names
    assert all("delta_indices" in one for one in config.values())


def test_cameras_that_the_mapping_does_not_read_are_logged_once(
    open_dialect, caplog: pytest.LogCaptureFixture
) -> None:
    port = open_dialect(
        "gr00t", mapping={"cameras": {"front": "video/front"}, "state": {"*": "state/*"}}
    )
    for _ in range(2):
        with PolicyClient(port, n15=True) as client:
            for _ in range(2):
                client.get_action_n15(so100(9, "abcd"))
    [said] = [one for one in caplog.messages if "which the policy does not receive" in one]
    assert said.startswith("gr00t: a client sends the cameras ['video/wrist']")


class Limited:
    """Clients of a gateway with keys, whose replica has no keys, like a replica on another
    machine.
    """

    def __init__(self, open_dialect: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(api_keys, "_CHECK_S", 0.0)
        self.known = ChangingKeys()
        self.port = open_dialect("gr00t", check=lambda key: self.known.keys.check(key, "noop"))

    def client(self, name: str, **allowed: Any) -> PolicyClient:
        return PolicyClient(self.port, self.known.add(name, **allowed))


@pytest.fixture
def limited(open_dialect: Any, monkeypatch: pytest.MonkeyPatch) -> Limited:
    return Limited(open_dialect, monkeypatch)


@pytest.mark.slow
def test_a_keys_rate_holds_wherever_the_replica_is(limited: Limited, replicas: Replicas) -> None:
    with limited.client("slow", rate=1e-3) as client, limited.client("lab") as other:
        assert client.ping()["status"] == "ok"
        for ask in (client.ping, client.reset, lambda: client.get_action(seen(1))):
            with pytest.raises(RuntimeError, match="too_many_requests"):
                ask()
        assert sessions(replicas) == 0
        assert rows(other.get_action(seen(7))[0])[-1] == 1
    with limited.client("lone", rate=1) as client:  # the message that begins an episode counts once
        assert rows(client.get_action(seen(1))[0])[-1] == 1
    with limited.client("some", rate=3) as client:
        assert rows(client.get_action(seen(1))[0])[-1] == 1
        with pytest.raises(RuntimeError, match="too_many_requests"):
            client.get_action(seen(1, batch=9))
        # The rejected message began no episode of other sessions.
        wait_for(lambda: _went_on(client))


@pytest.mark.slow
def test_who_is_over_the_rate_of_its_key_is_not_read_for_a_while(limited: Limited) -> None:
    with limited.client("greedy", rate=1e-3) as client, limited.client("lab") as other:
        client.ping()
        begun = time.monotonic()
        for _ in range(2):
            with pytest.raises(RuntimeError, match="too_many_requests"):
                client.ping()
        # The reader pauses for a second after each refusal; the pause after the last refusal is
        # still to come.
        assert time.monotonic() - begun >= 1.0
        assert other.ping()["status"] == "ok"


def _went_on(client: PolicyClient) -> bool:
    try:
        action, _ = client.get_action(seen(1))
    except RuntimeError as refused:
        if "too_many_requests" in str(refused):
            return False
        raise
    assert rows(action)[-1] == 2
    return True


def test_a_keys_sessions_hold_wherever_the_replica_is(limited: Limited, replicas: Replicas) -> None:
    with limited.client("pair", sessions=2) as one, PolicyClient(limited.port, "vlr_pair") as two:
        one.get_action(seen(1))
        with pytest.raises(RuntimeError, match="too_many_requests"):
            two.get_action(seen(1, batch=2))
        two.get_action(seen(1))
        with pytest.raises(RuntimeError, match="too_many_requests"):
            one.get_action(seen(1, batch=2))
        assert sessions(replicas) == 2
        assert rows(one.get_action(seen(1))[0])[-1] == 2


def test_sessions_of_a_revoked_key_end_by_themselves(limited: Limited, replicas: Replicas) -> None:
    with limited.client("leaver") as client, limited.client("lab") as other:
        client.get_action(seen(1))
        other.get_action(seen(1))
        limited.known.change("leaver", revoked=True)
        wait_for(lambda: sessions(replicas) == 1)
        assert rows(other.get_action(seen(1))[0])[-1] == 2
        with pytest.raises(RuntimeError, match="revoked"):
            client.get_action(seen(1))
        wait_for(lambda: limited.known.keys._connections == {"lab": 1})


def test_nothing_of_a_message_is_read_before_its_key(
    limited: Limited, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[bytes] = []
    monkeypatch.setattr(
        "vlagents_ray_dialects.messages.gr00t.read_request", lambda *_: read.append(b"")
    )
    limited.known.add("lab")
    deep = b"\x91" * 100_000
    head = b"\x82\xa9api_token\xa5wrong\xa4data"
    for message in (
        deep,
        head + deep,
        b"\x82\xa4data" + deep,
        b"\xdf\xff\xff\xff\xff",
        b"\x81\xa9api_token" + deep,
    ):
        assert b"error" in _raw(limited.port, message)
    assert not read


@pytest.mark.parametrize("before", [0, 1, 15])
def test_the_key_is_found_among_the_first_fields(before: int) -> None:
    fields = {f"field-{index}": {"nested": [index] * 10} for index in range(before)}
    message = msgpack.packb({**fields, "api_token": "key", "data": [[1] * 100]})
    assert gr00t_codec.read_token(message, LIMITS) == "key"


def test_a_key_behind_many_fields_or_a_name_with_many_values_is_not_searched() -> None:
    many = {str(index): index for index in range(9_000)}
    assert gr00t_codec.read_token(msgpack.packb({**many, "api_token": "key"}), LIMITS) is None
    names = (
        b"\x82" + msgpack.packb(many) + b"\x01" + msgpack.packb("api_token") + msgpack.packb("key")
    )
    with pytest.raises(MalformedMessage):
        gr00t_codec.read_token(names, LIMITS)
    with pytest.raises(MalformedMessage):
        gr00t_codec.read_token(msgpack.packb({"api_token": many}), LIMITS)


def _raw(port: int, message: bytes) -> bytes:
    with zmq.Context() as context, context.socket(zmq.REQ) as client:
        client.setsockopt(zmq.LINGER, 0)
        client.setsockopt(zmq.RCVTIMEO, 10_000)
        client.connect(f"tcp://127.0.0.1:{port}")
        client.send(message)
        return client.recv()


@pytest.mark.parametrize(
    "greeting", [b"\x04\x00one\x02\x00x", b"\xff" + bytes(8) + b"\x7f\x01\x05\x00\x00"]
)
def test_peers_of_zmqs_first_protocols_are_hung_up_on(open_dialect, greeting: bytes) -> None:
    """ZMQ's library kept some of their dead connections forever: about one in 6,000 of the fuzzer's
    connections.
    """
    port = open_dialect("gr00t")
    with (
        socket.create_connection(("127.0.0.1", port), timeout=30) as peer,
        contextlib.suppress(ConnectionError),
    ):
        peer.sendall(greeting)
        while peer.recv(4096):
            pass
    with PolicyClient(port) as client:
        client.ping()


def test_a_client_that_says_nothing_is_forgotten(open_dialect, replicas: Replicas) -> None:
    with PolicyClient(open_dialect("gr00t", idle_s=0.5)) as client:
        assert rows(client.get_action(seen(1))[0])[-1] == 1
        wait_for(lambda: sessions(replicas) == 0)
        assert rows(client.get_action(seen(2))[0]) == [2, 0.5, -1, 3, 1]


def test_one_client_more_than_the_limit_is_told_so_unless_another_has_no_session(
    open_dialect,
) -> None:
    port = open_dialect("gr00t", sessions=2)
    with PolicyClient(port) as one, PolicyClient(port) as two, PolicyClient(port) as three:
        one.get_action(seen(1))
        two.ping()
        three.get_action(seen(3))  # takes the place of the client that only sent a ping
        with pytest.raises(RuntimeError, match="unavailable: 2 clients"):
            two.ping()
        assert rows(one.get_action(seen(1))[0])[-1] == 2


def test_a_slow_and_a_greedy_client_hold_up_nobody(open_dialect) -> None:
    port = open_dialect("gr00t")
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
        # This peer never sends a greeting.
        with socket.create_connection(("127.0.0.1", port)), PolicyClient(port) as good:
            for step in range(1, 6):
                assert rows(good.get_action(seen(5))[0]) == [5, 0.5, -1, 3, step]
    finally:
        deaf.close()
        context.term()


@pytest.mark.slow
@pytest.mark.own_process
def test_mutated_messages_get_an_error_or_an_answer(open_dialect, replicas: Replicas) -> None:
    """A valid client acts all the time; memory and the number of threads do not grow."""
    port = open_dialect("gr00t", sessions=16)
    choose = random.Random(3)
    request = {"endpoint": "get_action", "data": {"observation": seen(9), "options": None}}
    messages = [
        msgpack.packb(request, default=encode)
        for encode in (gr00t_client.encode, gr00t_client.encode_packed)
    ]
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
                bad.send(
                    bytes(
                        message[: choose.randrange(1, len(message) + 1)]
                        if number % 4 == 0
                        else message
                    )
                )
                msgpack.unpackb(bad.recv())
                if number % 200 == 0:
                    assert rows(good.get_action(seen(5))[0])[-1] == number // 200 + 1
            assert threading.active_count() <= threads + 2
            assert psutil.Process().memory_info().rss - held < GROWTH
    finally:
        bad.close()
        context.term()


@pytest.mark.slow
def test_a_dialect_that_ends_answers_every_request(replicas: Replicas) -> None:
    config = GR00TDialect.Config(port=free_port())
    context = GatewayContext(
        "noop",
        lambda _key, priority: replicas.agent(priority=priority or "robot", timeout_s=20.0),
        MessageLimits(),
        8,
        30.0,
        None,
        NoKey.OPEN,
    )
    dialect = GR00TDialect("gr00t", config, context)
    dialect.serve(reserve("gr00t", "127.0.0.1", config.port))
    with PolicyClient(config.port) as waiting, PolicyClient(config.port) as late:
        for client in (waiting, late):
            client.get_action(seen(5))
        replicas.frozen.add(0)
        answers: dict[str, str] = {}

        def ask(name: str, client: PolicyClient) -> None:
            try:
                answers[name] = str(client.get_action(seen(5)))
            # The client's own error contains the server's text.
            except Exception as error:  # noqa: BLE001
                answers[name] = str(error)

        threads = [threading.Thread(target=ask, args=("waiting", waiting))]
        threads[0].start()
        wait_for(lambda: any(client._unanswered for client in dialect._clients._clients.values()))
        closing = threading.Thread(target=dialect.close)
        closing.start()
        wait_for(dialect._stopping.is_set)
        threads.append(threading.Thread(target=ask, args=("late", late)))
        threads[1].start()
        for thread in (closing, *threads):
            thread.join(20)
        assert sorted(answers) == ["late", "waiting"], "a client waits for ever"
        assert all("stopping" in text for text in answers.values()), answers
    replicas.frozen.clear()


# The pauses of clients between an answer and the next request, s.
PAUSES_S = (0.0, 0.001, 0.002, 0.01, 0.03, 0.1)
RESTARTS = 3


@pytest.mark.slow
def test_no_client_waits_for_ever_when_the_gateway_restarts_however_often_it_asks(
    replicas: Replicas,
) -> None:
    """ZeroMQ sends a request only once, so a request that an ended gateway does not read is never
    answered.
    """
    port = free_port()

    def begin() -> GR00TDialect:
        context = GatewayContext(
            "noop", lambda *_: replicas.agent(), MessageLimits(), 8, 30.0, None, NoKey.OPEN
        )
        dialect = GR00TDialect("gr00t", GR00TDialect.Config(port=port), context)
        dialect.serve(reserve("gr00t", "127.0.0.1", port))
        return dialect

    answered = [0] * len(PAUSES_S)
    over = threading.Event()

    def ask(index: int, pause_s: float) -> None:
        with contextlib.closing(zmq.Context.instance().socket(zmq.REQ)) as client:
            client.setsockopt(zmq.LINGER, 0)
            client.connect(f"tcp://127.0.0.1:{port}")
            while not over.is_set():
                client.send(said("ping"))
                while not client.poll(50):
                    if over.is_set():
                        return
                answer = msgpack.unpackb(client.recv())
                answered[index] += "error" not in answer
                assert "stopping" in answer.get("error", "stopping")
                time.sleep(pause_s)

    with ThreadPoolExecutor(len(PAUSES_S)) as clients:
        asking = [clients.submit(ask, *each) for each in enumerate(PAUSES_S)]
        try:
            for _ in range(RESTARTS):
                dialect = begin()
                before = list(answered)
                wait_for(lambda before=before: all(np.greater(answered, before)), 20)
                dialect.close()
        finally:
            over.set()
    for one in asking:
        one.result()


def test_the_client_of_gr00t_n1_gets_an_error_that_it_can_raise(open_dialect: Any) -> None:
    client = PolicyClient(open_dialect("gr00t"))
    # A file of `torch.save`, which is a ZIP archive.
    client.socket.send(b"PK\x03\x04" + bytes(100))
    assert client.socket.recv() == b"ERROR"
    assert client.ping() == {"status": "ok", "message": "Server is running"}
    client.close()
