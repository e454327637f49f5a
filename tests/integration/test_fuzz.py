"""Nearly correct messages at every endpoint of a real server: none crashes it, blocks it or makes
its memory grow.

CI sends some hundred messages to each endpoint. More can be sent by hand:

    VLAGENTS_FUZZ_FRAMES=200000 pytest tests/integration/test_fuzz.py -s --timeout 3600
"""

from __future__ import annotations

import http.client
import json
import os
import random
import time
import uuid
from collections import Counter, deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

import httpx
import numpy as np
import psutil
import pytest
from hostile_messages import changed, mutated
from websockets.exceptions import ConnectionClosedError
from websockets.sync.client import ClientConnection, connect

from tests.integration.conftest import serving
from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.protocol.frames import CONTENT_TYPE, decode_replies, encode_requests
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Budget, Request
from vlagents_ray.serve.launch.server import Server
from vlagents_ray_dialects.messages import openpi as openpi_codec
from vlagents_ray_dialects.messages import openvla as openvla_codec
from vlagents_ray_dialects.messages import vla_eval as vla_eval_codec
from vlagents_ray_dialects.messages import xpolicylab as xpolicylab_codec

FRAMES = int(os.environ.get("VLAGENTS_FUZZ_FRAMES", "1400"))
ANSWER_S = 60.0
EVERY = 100  # messages between checks with a correct one
PICTURE = np.full((8, 8, 3), 9, np.uint8)
OBS = Obs(
    {"front": PICTURE}, 0.5, {"joints": np.ones(3, np.float32)}, {"note": "x", "list": [1, 2.5]}
)
LIBERO = {
    "observation/image": PICTURE,
    "observation/wrist_image": PICTURE,
    "observation/state": np.array([1.0, 1, 1, 0, 0, 0, 0.02, -0.02]),
    "prompt": "task 4",
}
SGLANG = {
    "input": {
        "prompt": "task 4",
        "observation": {"images": {"front": PICTURE}, "state": np.ones(3)},
    },
    "parameters": {"action_horizon": 1, "seed": 3, "reset_mask": [True]},
    "runtime": {"response_format": "envelope", "return_timing": True},
}
SGLANG_BATCH = {
    "input": {
        "prompt": ["task 4", "task 5"],
        "observation": {
            "images": {"front": np.stack([PICTURE, PICTURE])},
            "state": np.ones((2, 3)),
        },
    },
    "parameters": {"session_ids": ["slot-0", "slot-1"], "reset_mask": [True, False]},
}
XPOLICYLAB = {
    "vision": {"cam_head": {"color": PICTURE}},
    "state": {"left_arm_joint_state": np.ones(6), "left_ee_joint_state": np.ones(1)},
    "instruction": "task 4",
    "env_idx": 0,
}
SEEN = {"images": {"front": PICTURE}, "task_description": "task 4", "state": np.ones(3)}
FENCE = vla_eval_codec.encode(vla_eval_codec.VlaEvalMessage("hello", {"protocol_version": 1}, 77))


@pytest.fixture(scope="module")
def server(shared_ray: None) -> Iterator[Server]:
    dialects = {
        "openpi": {"mapping": "openpi-libero"},
        "roboarena": {"mapping": "openpi-libero", "action_space": "joint_position"},
        "openvla": {},
        "sglang": {},
        "vla_eval": {},
        # The policy's rows have 7 numbers.
        "xpolicylab": {
            "mapping": {
                "preset": "xpolicylab",
                "action": {"left_arm_joint_state": {"stop": 6}},
                "action_gripper": {"index": 6},
            }
        },
    }
    with serving(
        "served_agents:Mirror", dialects=dialects, limits={"items": 1000, "body_bytes": 2**20}
    ) as server:
        yield server


def request(op: str) -> bytes:
    return encode_requests(
        [Request(op, OBS, instruction="task 4" if op == "reset" else None, request_id="r")]
    )  # type: ignore[arg-type]


@dataclass
class Target:
    """An endpoint, correct messages for it, and the answer to the last of them."""

    name: str
    path: str  # if empty, the replica's own port for WebSockets
    seeds: list[bytes]
    pixel: Callable[[bytes], float]  # returns the pixel in the answer to the last seed
    content_type: str = ""  # content type of an HTTP body; if empty, the endpoint is a WebSocket
    greeting: bool = False  # whether the server sends the first message
    trees: list[dict[str, Any]] = field(default_factory=list)  # messages before encoding
    encode: Callable[[Any], bytes] = openpi_codec.encode
    fence: bytes = b""  # a message that is always answered, for protocols with unanswered messages
    seen: Counter[str] = field(default_factory=Counter)


def as_json(tree: dict[str, Any]) -> bytes:
    return json.dumps(
        tree, default=lambda array: json.loads(openvla_codec.encode(np.asarray(array), twice=False))
    ).encode()


def as_vla_eval(tree: dict[str, Any]) -> bytes:
    fields = {"kind": "observation", "payload": {}, "seq": 3} | tree
    return vla_eval_codec.encode(
        vla_eval_codec.VlaEvalMessage(fields["kind"], fields["payload"], fields["seq"])
    )


def as_xpolicylab(tree: dict[str, Any]) -> bytes:
    fields = {"kind": "call", "id": uuid.uuid4().hex, "payload": {}} | tree
    labels = {"evaluation_id": "evaluation"}
    return xpolicylab_codec.encode(
        xpolicylab_codec.Frame(fields["kind"], fields["id"], labels, fields["payload"])
    )


def xpolicylab_pixel(answer: bytes) -> float:
    payload = xpolicylab_codec.decode(answer, Budget(DEFAULT_LIMITS)).payload
    return payload["actions"][0]["left_arm_joint_state"][0]


def frame_pixel(answer: bytes) -> float:
    act = decode_replies(answer)[0].act
    return -1.0 if act is None else act.action[0, 0]


def map_pixel(answer: bytes) -> float:
    return openpi_codec.decode(answer)["actions"][0, 0]


def sglang_pixel(answer: bytes) -> float:
    return openpi_codec.decode(answer)["data"][0]["action"]["values"][0, 0]


TARGETS = [
    Target("stream", "/v1/stream", [request("reset"), request("act")], frame_pixel),
    Target("port", "", [request("reset"), request("act")], frame_pixel),
    Target("frames", "/v1/act", [request("act")], frame_pixel, CONTENT_TYPE),
    Target(
        "openpi",
        "/openpi",
        [openpi_codec.encode(LIBERO)],
        map_pixel,
        greeting=True,
        trees=[LIBERO],
    ),
    Target(
        "roboarena",
        "/roboarena",
        [
            openpi_codec.encode({"endpoint": "reset"}),
            openpi_codec.encode(LIBERO | {"endpoint": "infer"}),
        ],
        map_pixel,
        greeting=True,
        trees=[LIBERO | {"endpoint": "infer", "session_id": "a"}],
    ),
    Target(
        "openvla",
        "/act",
        [
            b'{"image":%s,"instruction":"task 4","unnorm_key":null}'
            % openvla_codec.encode(PICTURE, twice=False)
        ],
        lambda a: openvla_codec.decode(b'{"a":%s}' % a)[0]["a"][0],
        "application/json",
        trees=[{"image": PICTURE, "instruction": "task 4", "unnorm_key": "a"}],
        encode=as_json,
    ),
    Target(
        "sglang",
        "/v1/actions/generations",
        [openpi_codec.encode(SGLANG_BATCH), openpi_codec.encode(SGLANG)],
        sglang_pixel,
        "application/msgpack",
        trees=[SGLANG, SGLANG_BATCH],
    ),
    Target(
        "sglang_realtime",
        "/v1/actions/realtime",
        [openpi_codec.encode(SGLANG_BATCH), openpi_codec.encode(SGLANG)],
        sglang_pixel,
        greeting=True,
        trees=[SGLANG, SGLANG_BATCH],
    ),
    Target(
        "xpolicylab",
        "/xpolicylab",
        [
            as_xpolicylab({"kind": "hello"}),
            as_xpolicylab({"payload": {"func_name": "update_obs_batch", "obs": [XPOLICYLAB]}}),
            as_xpolicylab({"payload": {"func_name": "get_action_batch", "obs": [0]}}),
            as_xpolicylab({"kind": "infer", "payload": {"observation": XPOLICYLAB}}),
        ],
        xpolicylab_pixel,
        trees=[
            {"kind": "infer", "payload": {"observation": XPOLICYLAB}},
            {"payload": {"func_name": "update_obs", "obs": XPOLICYLAB}},
            {"payload": {"func_name": "get_action"}},
        ],
        encode=as_xpolicylab,
    ),
    Target(
        "vla_eval",
        "/vla-eval",
        [
            FENCE,
            vla_eval_codec.encode(
                vla_eval_codec.VlaEvalMessage("episode_start", {"task": {"name": "a"}}, 2)
            ),
            vla_eval_codec.encode(vla_eval_codec.VlaEvalMessage("observation", SEEN, 3)),
        ],
        lambda a: vla_eval_codec.decode(a).payload["actions"][0],
        fence=FENCE,
        trees=[
            {"payload": SEEN},
            {"kind": "hello", "payload": {"protocol_version": 1}},
            {"kind": "episode_start", "payload": {"task": {}}},
        ],
        encode=as_vla_eval,
    ),
]


def attack(target: Target, server: Server, frames: int, seed: int) -> None:
    """Send many messages. Raise an error if the server hangs, reports an internal error, or later
    rejects a correct message.
    """
    choose = random.Random(seed)
    talk = over_http if target.content_type else over_websocket
    for begun in range(0, frames, EVERY):
        bad = [nearly_right(target, choose) for _ in range(min(EVERY, frames - begun))]
        answer = talk(target, server, bad)
        assert target.pixel(answer) == 9


def nearly_right(target: Target, choose: random.Random) -> bytes:
    """Return a message with wrong bytes, or half of the time with wrong content if there is
    a tree.
    """
    if target.trees and choose.random() < 0.5:
        return target.encode(changed(choose, choose.choice(target.trees)))
    return mutated(choose, choose.choice(target.seeds))


def note(target: Target, answer: bytes | str) -> None:
    text = answer if isinstance(answer, str) else answer[:2000].decode("latin-1")
    assert "internal error" not in text, f"{target.name}: {text}"
    assert "Traceback" not in text, f"{target.name}: {text}"
    target.seen["text" if isinstance(answer, str) else "binary"] += 1


def over_http(target: Target, server: Server, bad: list[bytes]) -> bytes:
    connection = http.client.HTTPConnection(urlsplit(server.url).netloc, timeout=ANSWER_S)
    headers = {"content-type": target.content_type, "accept": target.content_type}
    if target.path == "/v1/act":
        headers["x-session-id"] = "fuzz"
        connection.request("POST", "/v1/reset", request("reset"), headers)
        assert connection.getresponse().read()
    for body in bad:
        connection.request("POST", target.path, body, headers)
        response = connection.getresponse()
        note(target, response.read())
        target.seen[str(response.status)] += 1
    connection.request("POST", target.path, target.seeds[-1], headers)
    answer = connection.getresponse().read()
    connection.close()
    return answer


def over_websocket(target: Target, server: Server, bad: list[bytes]) -> bytes:
    waiting = deque(bad)
    while waiting:
        try:
            with opened(target, server) as socket:
                while waiting:
                    socket.send(waiting.popleft())
                    if target.fence:
                        socket.send(target.fence)
                    note(target, wait_for_answer(target, socket))
        except ConnectionClosedError as closed:
            if closed.rcvd is None:  # the server ended the connection without a close frame
                raise
            target.seen["closed"] += 1
    with opened(target, server) as socket:
        for seed in target.seeds:
            socket.send(seed)
            answer = b"" if b"episode_start" in seed else socket.recv(timeout=ANSWER_S)
    if not isinstance(answer, bytes):
        raise TypeError(answer)
    return answer


def wait_for_answer(target: Target, socket: ClientConnection) -> bytes | str:
    """Wait for the answer to the last message, or with a fence for the answers to all messages
    before it. An error in openpi's form ends the connection.
    """
    while True:
        answer = socket.recv(timeout=ANSWER_S)
        if isinstance(answer, str) and answer != "reset successful":
            note(target, answer)
            socket.recv(timeout=ANSWER_S)  # raises ConnectionClosedError
        if not target.fence or vla_eval_codec.decode(answer).seq == 77:  # type: ignore[arg-type]
            return answer


@contextmanager
def opened(target: Target, server: Server) -> Iterator[ClientConnection]:
    url = server.url.replace("http://", "ws://") + target.path
    if not target.path:
        own = httpx.get(f"{server.url}/v1/metadata", timeout=ANSWER_S).json()["stream"]
        url = f"ws://127.0.0.1:{own['port']}{own['path']}"
    with connect(url, compression=None, ping_interval=None, open_timeout=ANSWER_S) as socket:
        if target.greeting:
            socket.recv(timeout=ANSWER_S)
        yield socket


def test_no_message_crashes_hangs_or_bloats_the_server(server: Server) -> None:
    with RemoteAgent(server.url, transport="http") as agent:
        process = psutil.Process(agent.reset(OBS, "task 4")["pid"])
        share = FRAMES // len(TARGETS)

        def attack_all(frames: int, seed: int) -> None:
            with ThreadPoolExecutor(len(TARGETS)) as pool:
                list(pool.map(lambda target: attack(target, server, frames, seed), TARGETS))

        attack_all(share // 4, 1)
        before = (process.memory_info().rss, process.num_threads(), process.num_fds())
        begun = time.perf_counter()
        attack_all(share - share // 4, 2)
        after = (process.memory_info().rss, process.num_threads(), process.num_fds())
        took = time.perf_counter() - begun
        print(f"\n{share * len(TARGETS)} messages, the last three quarters in {took:.0f} s")
        print(
            f"replica before and after them: {before[0] / 2**20:.0f} and {after[0] / 2**20:.0f} "
            f"MiB, {before[1]} and {after[1]} threads, {before[2]} and {after[2]} descriptors"
        )
        for target in TARGETS:
            print(f"{target.name}: {dict(target.seen)}")
        assert process.is_running()
        assert agent.act(OBS).action[0, 0] == 9
        assert after[0] - before[0] < 64 * 2**20
        assert after[1] - before[1] < 20
        assert after[2] - before[2] < 20
