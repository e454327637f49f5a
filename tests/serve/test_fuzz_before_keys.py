"""Fuzzing of every port of a replica with API keys by clients without access: no bytes crash the
replica, make its memory grow, or cause an act.

The tests fuzz the states of each protocol before authentication: nearly correct handshakes, and
complete requests before, with and after rejected ones, cut into segments at random positions.
`tests/integration/test_fuzz.py` fuzzes the states after authentication. CI runs some thousand
sequences. More can be run by hand, all generated from one seed:

    export VLAGENTS_FUZZ_SEQUENCES=1000000 VLAGENTS_FUZZ_SEED=1
    pytest tests/serve/test_fuzz_before_keys.py -s --timeout 7200
"""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import random
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import msgpack
import numpy as np
import psutil
import pytest
import zmq
from api_key_replica import ATTEMPTS, KeyedReplica, keyed_replica
from dialect_server import body, libero, seen
from eval_fakes import wait_for
from gr00t_client import encode as gr00t_encode
from hostile_messages import mutated
from many import many
from rpyc_client import LOCAL, ROOT, TUPLE, VALUE, call, document, request

from vlagents_ray.interface import Obs
from vlagents_ray.protocol.frames import CONTENT_TYPE, encode_requests
from vlagents_ray.protocol.messages import OPS, LocalAddress, Request
from vlagents_ray.serve.endpoints import access_middleware, http_messages
from vlagents_ray_dialects import gr00t
from vlagents_ray_dialects.messages import rpyc
from vlagents_ray_dialects.messages import vla_eval as vla_eval_codec
from vlagents_ray_dialects.messages.rpyc import Handler

SEQUENCES = int(os.environ.get("VLAGENTS_FUZZ_SEQUENCES", many(3000)))
SEED = int(os.environ.get("VLAGENTS_FUZZ_SEED", "1"))
EVERY = 500  # sequences between checks with a client that has a key
ANSWER_S = 20.0
GROWTH = 64 * 2**20  # bytes of memory growth, whatever the number of sequences
PATHS = ("/v1/stream", "/", "/openpi", "/roboarena", "/vla-eval", "/xpolicylab", "/nope")
KEYS = (None, "vlr_wrong", "vlr_leaver", "vlr_elsewhere", "vlr_", "\xe9", "x" * 5000)
PICTURE = np.full((8, 8, 3), 9, np.uint8)
RESET = encode_requests(
    [Request("reset", Obs({"front": PICTURE}), "move to the human", session="robot-1")]
)
ACT = encode_requests([Request("act", Obs({"front": PICTURE}), session="robot-1")])
FORM = b'--b\r\nContent-Disposition: form-data; name="obs"\r\n\r\n{}\r\n--b--'
Segments = list[bytes]


@dataclass
class Target:
    """A port, the pieces of nearly correct messages for it, and the endpoint that a client with a
    key uses.
    """

    name: str
    endpoint: str
    pieces: Callable[[KeyedReplica, random.Random], Segments]
    send: Callable[[KeyedReplica, random.Random, Segments], str]
    said: Counter[str] = field(default_factory=Counter)


def sequence(target: Target, replica: KeyedReplica, choose: random.Random) -> Segments:
    """Return correct and nearly correct pieces, possibly in a wrong order, cut into segments."""
    pieces = target.pieces(replica, choose)
    if choose.random() < 0.3:
        choose.shuffle(pieces)
    pieces = [mutated(choose, piece) if choose.random() < 0.4 else piece for piece in pieces]
    whole = b"".join(pieces)
    kind = choose.random()
    if kind < 0.4:
        return [whole]
    if kind < 0.7:
        return pieces
    cuts = sorted(choose.randrange(len(whole) + 1) for _ in range(choose.randint(1, 5)))
    return [whole[a:b] for a, b in zip([0, *cuts], [*cuts, len(whole)], strict=True)]


# The messages for each port.


def headers(choose: random.Random) -> bytes:
    key = choose.choice(KEYS)
    shown = choose.choice(
        (
            "Authorization: Bearer ",
            "authorization: Api-Key ",
            "x-api-key: ",
            "Authorization: Basic ",
        )
    )
    return b"" if key is None else f"{shown}{key}\r\n".encode("latin-1")


def handshake(choose: random.Random, path: str) -> bytes:
    return (
        f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    ).encode() + (headers(choose) + b"\r\n")


def frame(payload: bytes, opcode: int = 2) -> bytes:
    return bytes([0x80 | opcode, 0x80 | 126]) + len(payload).to_bytes(2, "big") + bytes(4) + payload


def frames(choose: random.Random) -> Segments:
    some = [
        RESET,
        ACT,
        libero(1, "task"),
        vla_eval_codec.encode(vla_eval_codec.VlaEvalMessage("observation", seen(1), 3)),
        b"VLA?" * 3,
    ]
    return [
        frame(choose.choice(some), choose.choice((2, 2, 2, 0, 1, 8, 9, 10, 3)))
        for _ in range(choose.randint(0, 3))
    ]


def at_own_port(replica: KeyedReplica, choose: random.Random) -> Segments:
    path = choose.choice(
        (replica.own.path, replica.own.path, "/", "/v1/stream", replica.own.path[:-1])
    )
    if choose.random() < 0.5:
        return [handshake(choose, path), *frames(choose)]
    return posts(choose, [f"{replica.own.path}/{op}" for op in OPS] + ["/v1/act"])


def at_http(_replica: KeyedReplica, choose: random.Random) -> Segments:
    if choose.random() < 0.4:
        path = choose.choice(PATHS)
        return [handshake(choose, path), *frames(choose)]
    paths = ("/v1/reset", "/v1/act", "/v1/close", "/act", "/docs", "/v1/metadata", "/healthz/")
    return posts(choose, paths)


def posts(choose: random.Random, paths: Sequence[str]) -> Segments:
    """Return HTTP requests."""
    path = choose.choice(paths)
    kind, content = choose.choice(
        (
            ("application/json", b'{"instruction": "move to the human"}'),
            (CONTENT_TYPE, RESET),
            ("application/json", repr(body(1)).encode()),
            (
                "multipart/form-data; boundary=b",
                b'--b\r\nContent-Disposition: form-data; name="obs"\r\n\r\n{}\r\n--b--',
            ),
        )
    )
    length = (
        f"Content-Length: {len(content)}\r\n"
        if choose.random() < 0.7
        else "Transfer-Encoding: chunked\r\n"
    )
    if "chunked" in length:
        content = f"{len(content):x}\r\n".encode() + content + b"\r\n0\r\n\r\n"
    method = choose.choice(("POST", "POST", "GET", "PUT", "OPTIONS"))
    head = (
        f"{method} {path} HTTP/1.1\r\nHost: x\r\nx-session-id: robot-1\r\nContent-Type: "
        f"{kind}\r\n{length}"
    )
    return [head.encode() + headers(choose) + b"\r\n", content] * choose.randint(1, 2)


def at_shm(_replica: KeyedReplica, choose: random.Random) -> Segments:
    key = (choose.choice(KEYS) or "-").encode()
    message = LocalAddress.REQUEST.pack(0, choose.choice((0, LocalAddress.COMPACT)), len(RESET))
    return [key, message, message + RESET[:200]]


def at_gr00t(_replica: KeyedReplica, choose: random.Random) -> Segments:
    observation = {
        "video": {"ego": PICTURE[None, None]},
        "language": {"task": [["move to the human"]]},
    }
    data = choose.choice(({"observation": observation, "options": None}, observation, {}, None))
    said = {
        "endpoint": choose.choice(("get_action", "reset", "ping", "get_modality_config", "kill")),
        "data": data,
    }
    if (key := choose.choice(KEYS)) is not None:
        said = {"api_token": key} | said if choose.random() < 0.5 else said | {"api_token": key}
    return [msgpack.packb(said, default=gr00t_encode)]


def at_zmq(replica: KeyedReplica, choose: random.Random) -> Segments:
    """Return ZMTP's greeting, handshake and frames, the layer below GR00T's messages."""
    greeting = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
    ready = b"\x05READY\x0bSocket-Type\x00\x00\x00\x03REQ\x08Identity\x00\x00\x00\x00"
    message = at_gr00t(replica, choose)[0]
    long = b"\x02" + len(message).to_bytes(8, "big") + message
    return [greeting, b"\x04" + bytes([len(ready)]) + ready, b"\x01\x00", long]


def at_vlagents(_replica: KeyedReplica, choose: random.Random) -> Segments:
    """Return messages before a client's first complete observation, since vlagents' protocol has no
    key.
    """
    getroot = request(1, Handler.GETROOT, (TUPLE, ()))
    getattr_ = request(2, Handler.GETATTR, (TUPLE, ((LOCAL, ROOT), (VALUE, "act"))))
    half = document(1, "move to the human").encode()[: choose.randint(0, 100)].decode()
    calls = [
        call("act", half),
        call("reset", half),
        call("name"),
        call("git_status"),
        call("act"),
        call("kill", "x"),
    ]
    return [
        getroot,
        getattr_,
        *choose.sample(calls, 2),
        rpyc.HEADER.pack(choose.randrange(2**32), 0),
    ]


# The ways of sending.


def over_tcp(
    port: Callable[[KeyedReplica], int], *, hangs_up: bool = True
) -> Callable[[KeyedReplica, random.Random, Segments], str]:
    def send(replica: KeyedReplica, choose: random.Random, segments: Segments) -> str:
        """Send segments until the server closes the connection, which it does once it has read all
        of them. ZMQ may wait for more.
        """
        said = b""
        with socket.socket() as connection:
            connection.settimeout(ANSWER_S if hangs_up else 0.5)
            # One address has only few ports per minute.
            connection.bind((f"127.0.0.{choose.randint(2, 250)}", 0))
            connection.connect(("127.0.0.1", port(replica)))
            gone = (ConnectionError,) if hangs_up else (ConnectionError, TimeoutError)
            with contextlib.suppress(*gone):  # the server did not wait for the remaining segments
                for segment in segments:
                    connection.sendall(segment)
                with contextlib.suppress(OSError):  # the server has closed the connection
                    connection.shutdown(socket.SHUT_WR)
                while more := connection.recv(65536):
                    said += more
        return (
            said[:12].decode("latin-1")
            if said.startswith(b"HTTP")
            else "something"
            if said
            else "nothing"
        )

    return send


def over_unix(replica: KeyedReplica, choose: random.Random, segments: Segments) -> str:
    said = 0
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        connection.settimeout(ANSWER_S)
        connection.connect(f"\0{replica.local.address.socket}")
        with contextlib.suppress(ConnectionError):
            for segment in segments:
                if choose.random() < 0.1:
                    descriptor = os.memfd_create("fuzz")
                    try:
                        socket.send_fds(connection, [segment[:60_000]], [descriptor])
                    finally:
                        os.close(descriptor)
                else:
                    connection.send(segment[:60_000])
            connection.shutdown(socket.SHUT_WR)
            while connection.recv(65536):
                said += 1
    return "answers" if said else "nothing"


_OF_THREAD = threading.local()


def over_zmq(replica: KeyedReplica, _choose: random.Random, segments: Segments) -> str:
    """Send one message with as many parts as there are segments. The server closes a connection
    after 64 messages without a key.
    """
    if not hasattr(_OF_THREAD, "context"):
        _OF_THREAD.context = zmq.Context()
    if (_OF_THREAD.__dict__.setdefault("sent", 0)) % 50 == 0:
        if hasattr(_OF_THREAD, "socket"):
            _OF_THREAD.socket.close()
        _OF_THREAD.socket = _OF_THREAD.context.socket(zmq.DEALER)
        _OF_THREAD.socket.setsockopt(zmq.LINGER, 0)
        _OF_THREAD.socket.setsockopt(zmq.RCVTIMEO, int(ANSWER_S * 1e3))
        _OF_THREAD.socket.connect(f"tcp://127.0.0.1:{replica.gr00t[False]}")
    _OF_THREAD.sent += 1
    _OF_THREAD.socket.send_multipart([b"", b"".join(segments)])
    answer = msgpack.unpackb(_OF_THREAD.socket.recv_multipart()[-1], strict_map_key=False)
    return str(answer.get("error", "done")).partition(":")[0]


TARGETS = [
    Target("own port", "own port", at_own_port, over_tcp(lambda replica: replica.own.address.port)),
    Target("HTTP", "`WS /v1/stream`", at_http, over_tcp(lambda replica: replica.port)),
    Target("shm", "shared memory", at_shm, over_unix),
    Target("gr00t", "GR00T's gateway, replica on another", at_gr00t, over_zmq),
    Target(
        "zmq",
        "GR00T's gateway, replica on its host",
        at_zmq,
        over_tcp(lambda replica: replica.gr00t[True], hangs_up=False),
    ),
    Target(
        "vlagents",
        "vlagents' gateway, `without_key: true`",
        at_vlagents,
        over_tcp(lambda replica: replica.vlagents),
    ),
]


@pytest.fixture(scope="module")
def replica(tmp_path_factory: pytest.TempPathFactory) -> Iterator[KeyedReplica]:
    with keyed_replica(tmp_path_factory.mktemp("plasma")) as one:
        one.known.add("leaver", revoked=True)
        one.known.add("elsewhere", apps=["another"])
        yield one


def attack(target: Target, replica: KeyedReplica, number: int, seed: int) -> None:
    choose = random.Random(seed)
    for begun in range(0, number, EVERY):
        for _ in range(min(EVERY, number - begun)):
            target.said[target.send(replica, choose, sequence(target, replica, choose))] += 1
        visitor = replica.visitor("right")
        assert ATTEMPTS[target.endpoint](visitor, "with") == "done", target.name
    if hasattr(_OF_THREAD, "socket"):
        _OF_THREAD.context.destroy()
        _OF_THREAD.__dict__.clear()


def held() -> tuple[int, int, int]:
    gc.collect()
    process = psutil.Process()
    return process.memory_info().rss, process.num_threads(), process.num_fds()


@pytest.mark.slow
def test_nothing_that_comes_before_a_key_crashes_bloats_or_acts(
    replica: KeyedReplica, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.ERROR)
    # test_gr00t_strangers.py and test_access_middleware.py test these pauses.
    monkeypatch.setattr(gr00t, "_REFUSAL_S", 0.001)
    for module in (access_middleware, http_messages):
        monkeypatch.setattr(module, "REFUSAL_S", 0.001)
    share = SEQUENCES // len(TARGETS)

    def attack_all(number: int, seed: int) -> None:
        with ThreadPoolExecutor(len(TARGETS)) as pool:
            list(
                pool.map(
                    lambda each: attack(each[1], replica, number, seed + each[0]),
                    enumerate(TARGETS),
                )
            )

    attack_all(share // 4, 100 * SEED)
    at_rest(replica)
    before = held()
    begun = time.perf_counter()
    attack_all(share - share // 4, 100 * SEED + 50)
    took_s = time.perf_counter() - begun
    at_rest(replica)
    after = held()
    print(f"\n{share * len(TARGETS)} sequences, the last three quarters in {took_s:.0f} s; before "
          "and after those: "
          f"{before[0] / 2**20:.0f} and {after[0] / 2**20:.0f} MiB, {before[1]} and {after[1]} "
          "threads, "
          f"{before[2]} and {after[2]} descriptors")  # fmt: skip
    for target in TARGETS:
        print(f"{target.name}: {dict(target.said.most_common(8))}")
    # Acts of clients with a key are excluded.
    assert [mark for mark in replica.policy.done if not mark.startswith("mark of ")] == []
    assert [
        record.getMessage() for record in caplog.records if record.levelno >= logging.ERROR
    ] == []
    assert after[0] - before[0] < GROWTH
    assert after[1] - before[1] < 10
    assert after[2] - before[2] < 20


def at_rest(replica: KeyedReplica) -> None:
    """Return whether no client is connected any more."""
    wait_for(lambda: not replica.own._clients and not replica.local._clients)
    wait_for(
        lambda: not any(thread.name.startswith("vlagents 127") for thread in threading.enumerate())
    )
    wait_for(lambda: not replica.known.keys._connections)
