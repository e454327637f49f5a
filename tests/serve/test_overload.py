"""The cost of a message is checked before it is incurred: against the key's rate and against
memory, and on the right thread.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import gc
import http.client
import os
import socket
import struct
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import api_key_replica
import numpy as np
import psutil
import pytest
from api_key_replica import (
    ATTEMPTS,
    KeyedReplica,
    Visitor,
    _read_reply,
    _read_vla_eval,
    keyed_replica,
    over_websocket,
)
from eval_fakes import wait_for
from frozen_rates import freeze, requests_charged
from gr00t_client import PolicyClient
from in_flight import read_requests
from in_memory_keys import ChangingKeys
from probes import bytes_probe, is_probe_answer
from websockets.exceptions import InvalidStatus

import vlagents_ray
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.shm import ShmTransport
from vlagents_ray.client.transports.websocket import Stream
from vlagents_ray.errors import (
    DeadlineExceeded,
    MessageTooLarge,
    Overloaded,
    PolicyUnavailable,
    TooManyRequests,
    VLAgentsError,
)
from vlagents_ray.images import codecs, jpeg_png
from vlagents_ray.images.codecs import decode_files
from vlagents_ray.images.image_file import ImageFile
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol import frame_layout, json_messages
from vlagents_ray.protocol.frames import (
    CONTENT_TYPE,
    Decoded,
    decode_replies,
    decode_requests,
    encode_replies,
    encode_requests,
)
from vlagents_ray.protocol.messages import (
    DEFAULT_LIMITS,
    STREAM_BYTES,
    Budget,
    LocalAddress,
    MessageLimits,
    Reply,
    Request,
)
from vlagents_ray.serve.access import api_keys
from vlagents_ray.serve.access.api_keys import Identity, NoKey
from vlagents_ray.serve.access.charges import REFUSALS, Account, free
from vlagents_ray.serve.dialects.base import GatewayContext
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.endpoints.shm import ShmServer, UnixConnection
from vlagents_ray.serve.engine.admission import (
    Admission,
    ArrivingBytes,
    MessageAdmission,
    NeedsDecodingThread,
)
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.wire import json_numpy
from vlagents_ray_dialects import gr00t
from vlagents_ray_dialects.messages import gr00t as gr00t_codec
from vlagents_ray_dialects.messages import msgpack
from vlagents_ray_dialects.messages import openpi as openpi_codec
from vlagents_ray_dialects.messages import openvla as openvla_codec
from vlagents_ray_dialects.messages import vla_eval as vla_eval_codec
from vlagents_ray_dialects.messages import xpolicylab as xpolicylab_codec

JPEG = jpeg_png.encode_jpeg(np.full((32, 32, 3), 9, np.uint8))
PNG = jpeg_png.encode_png(np.full((32, 32, 3), 9, np.uint8))
LARGE = jpeg_png.encode_jpeg(np.zeros((1100, 1000, 3), np.uint8), 1, "420")  # more than a megapixel
DECODED = 32 * 32 * 3
SLACK = 48 * 2**20  # bytes of buffers in the kernel and the interpreter
OBS = Obs({"front": np.zeros((8, 8, 3), np.uint8)})
SEEN = {"cameras": {"front": {"$": ["img", 0]}}}


def frame(*requests: dict[str, Any], files: list[bytes] | None = None) -> bytes:
    return b"".join(
        frame_layout.pack({"requests": list(requests)}, [JPEG] if files is None else list(files))
    )


def reset(**more: Any) -> dict[str, Any]:
    return {"op": "reset", "obs": SEEN, **more}


def message_admission(
    most: int = 10**9,
    limits: MessageLimits = DEFAULT_LIMITS,
    caller: Identity = NoKey.OPEN,
) -> MessageAdmission:
    return MessageAdmission(Admission(most), limits, Account(caller).charge())


# Checks before anything is decoded.


@pytest.fixture(scope="module")
def replica(tmp_path_factory: pytest.TempPathFactory) -> Iterator[KeyedReplica]:
    with keyed_replica(tmp_path_factory.mktemp("plasma")) as one:
        yield one


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return a growing list of called decoders, and of parsers outside the test's own thread, in
    which its clients run.
    """
    by: list[str] = []
    for module, name in (
        (jpeg_png, "decode_file"),
        (frame_layout, "parse_json"),
        (json_messages, "parse_json"),
        (json_numpy, "loads"),
        (json_numpy, "decode_base64"),
        (msgpack, "unpack"),
        (api_key_replica, "read_header"),
        (openpi_codec, "decode"),
        (openvla_codec, "decode"),
        (gr00t_codec, "read_request"),
        (vla_eval_codec, "decode"),
        (xpolicylab_codec, "decode"),
    ):
        original = getattr(module, name)

        def noted(
            *args: Any,
            original: Any = original,
            module: Any = module,
            name: str = name,
            **options: Any,
        ) -> Any:
            if module is jpeg_png or threading.current_thread() is not threading.main_thread():
                by.append(name)
            return original(*args, **options)

        monkeypatch.setattr(module, name, noted)
    return by


def _post(path: str, kind: str, content: bytes) -> Callable[[Visitor, str], str]:
    def attempt(visitor: Visitor, _when: str) -> str:
        visitor.become()
        connection = http.client.HTTPConnection("127.0.0.1", visitor.replica.port, timeout=10)
        headers = {
            "authorization": f"Bearer {visitor.shown}",
            "content-type": kind,
            "x-session-id": "robot-1",
        }
        connection.request("POST", path, content, headers)
        answer = connection.getresponse()
        if answer.status == 429:
            assert int(answer.headers["retry-after"]) >= 1
        answer.read()
        connection.close()
        return str(answer.status)

    return attempt


NOTHING_TO_DECODE = {
    *(endpoint for endpoint in ATTEMPTS if endpoint.startswith("`GET")),
    "`POST /v1/close`",  # the endpoint decodes no content
    "own port, another path",  # rejected
    "`WS /v1/weights`",  # rejected without the scope
    "`POST /v1/weights/{step}`",  # rejected without the scope
    "`POST /v1/weights/{step}`, scope `weights`",  # two options in the URL
    "`POST /v1/live/command`",  # rejected without the scope
    "`POST /v1/live/command`, scope `operate`",  # a name and a word, at most 16 KiB
    "`WS /v1/live`",  # rejected without the scope
    "`WS /v1/live`, scope `watch`",  # a viewer sends only names
}
NO_KEY = {
    *(endpoint for endpoint in ATTEMPTS if "`without_key: true`" in endpoint),
    "Serve handle (`serve://`)",
    "plasma (`serve://`)",
}


FORM = (
    b'--X\r\nContent-Disposition: form-data; name="obs"\r\n\r\n{}\r\n--X\r\nContent-Disposition: '
    b"form-data; "
    b'name="cameras.front"; filename="a"\r\n\r\n' + JPEG + b"\r\n--X--\r\n"
)
ACTS = {"`POST /v1/act`", "own port, HTTP act"}  # these reset a session first
# The endpoints that decode content for a key. docs/access.md lists all endpoints.
CARRY = {
    endpoint: attempt
    for endpoint, attempt in ATTEMPTS.items()
    if endpoint not in NOTHING_TO_DECODE | NO_KEY | ACTS
} | {
    f"{op}, {kind.partition(';')[0]}": _post(f"/v1/{op}", kind, content)
    for op in ("reset", "act")
    for kind, content in (
        ("multipart/form-data; boundary=X", FORM),
        (CONTENT_TYPE, frame({"op": op, "obs": SEEN})),
        ("application/json", b"{}"),
    )
}


def test_a_refused_body_that_is_long_is_not_read(replica: KeyedReplica) -> None:
    visitor = replica.visitor("over its rate")
    visitor.become()
    with socket.create_connection(("127.0.0.1", replica.port), timeout=10) as connection:
        head = (
            f"POST /v1/act HTTP/1.1\r\nhost: localhost\r\nauthorization: Bearer {visitor.token}\r\n"
        )
        # The body has not been sent yet.
        connection.sendall(f"{head}content-length: 60000000\r\n\r\n".encode())
        answer = b""
        while more := connection.recv(65536):  # until the server closes the connection
            answer += more
    assert b" 429 " in answer.splitlines()[0]
    assert b"retry-after: " in answer.lower()
    assert b"connection: close" in answer.lower()


def test_no_other_endpoint_is_left_out() -> None:
    assert ATTEMPTS.keys() >= NOTHING_TO_DECODE | NO_KEY | ACTS


@pytest.mark.parametrize("endpoint", CARRY)
def test_nothing_of_a_key_over_its_rate_is_decoded(
    replica: KeyedReplica, decoded: list[str], endpoint: str
) -> None:
    attempt, when = CARRY[endpoint], "with" if "gateway" in endpoint else "after"
    assert attempt(replica.visitor("over its rate"), when) == "429"
    assert decoded == []
    # 409 is the answer to an act before a reset.
    assert attempt(replica.visitor("right"), when) in ("done", "200", "409", "404")
    assert decoded != []


@pytest.mark.parametrize("path", ["/v1/stream", "own"])
def test_a_probe_through_a_websocket_counts_for_the_rate(replica: KeyedReplica, path: str) -> None:
    probe = bytes_probe(100)
    send = over_websocket(
        path,
        lambda _: probe,
        lambda got: "done" if is_probe_answer(got, probe) else _read_reply(got),
    )
    assert send(replica.visitor("right"), "after") == "done"
    assert send(replica.visitor("over its rate"), "after") == "429"


@pytest.mark.parametrize("endpoint", sorted(NO_KEY))
def test_endpoints_without_a_key_count_what_they_hold(
    replica: KeyedReplica, monkeypatch: pytest.MonkeyPatch, endpoint: str
) -> None:
    asked: list[int] = []
    begin = MessageAdmission.begin

    def noted(message: MessageAdmission, *args: Any) -> None:
        asked.append(1)
        begin(message, *args)

    monkeypatch.setattr(MessageAdmission, "begin", noted)
    visitor = replica.visitor("right")
    assert ATTEMPTS[endpoint](visitor, "with") == "done"
    assert asked


def test_nothing_that_serves_decodes_without_an_admission() -> None:
    """A dialect with a separate budget would check neither the key's nor the replica's limits."""
    package = Path(vlagents_ray.__file__).parent
    served = list((package / "serve").rglob("*.py"))
    assert package / "serve/engine/admission.py" in served
    for file in served:
        assert "Budget(" not in file.read_text().replace("class MessageAdmission(Budget):", ""), (
            file
        )
    # Files that the policy has seen are decoded again only by `vlagents_ray_live.ring`, one saved
    # recording at a time.
    for file in {*served, *(package / "protocol").glob("*.py")}:
        assert "jpeg_png" not in file.read_text(), file


def test_closing_is_free_and_decodes_nothing(decoded: list[str]) -> None:
    [answer] = read_requests(
        frame({"op": "close", "obs": SEEN, "history": [SEEN]}), Budget(DEFAULT_LIMITS)
    )
    assert isinstance(answer, Request)
    assert answer.obs is None
    assert answer.history == []
    assert decoded == []


# The memory that a message may use.


def test_each_image_is_decoded_once_however_often_it_is_named(decoded: list[str]) -> None:
    both = {
        "cameras": {"a": {"$": ["img", 0]}, "b": {"$": ["img", 1]}},
        "info": {"again": {"$": ["img", 0]}},
    }
    answers = read_requests(
        frame(*[{"op": "reset", "obs": both, "history": [both] * 5}] * 3, files=[JPEG, JPEG]),
        message_admission(),
    )
    assert all(isinstance(answer, Request) for answer in answers)
    assert decoded == ["decode_file"] * 2


def test_what_a_request_names_is_counted_each_time_and_taken_once() -> None:
    limits = MessageLimits(decoded_bytes=4 * DECODED)
    held = Admission(10**9)
    message = MessageAdmission(held, limits, free(NoKey.OPEN))
    good, bad = (
        {"op": "reset", "obs": SEEN, "history": [SEEN] * 3},
        {"op": "reset", "obs": SEEN, "history": [SEEN] * 4},
    )
    first, second, third = read_requests(frame(good, bad, good), message)
    assert isinstance(first, Request)
    assert isinstance(second, Reply)
    assert isinstance(second.error, MessageTooLarge)
    assert "limits.decoded_bytes" in str(second.error)
    assert isinstance(third, Request)
    assert held.held == DECODED
    message.release()
    assert held.held == 0

    def named(times: int) -> dict[str, Any]:
        return {
            "op": "reset",
            "obs": {"info": {str(n): {"$": ["nd", 0, "|u1", [1000]]} for n in range(times)}},
        }

    arrays = frame(named(4), named(5), files=[bytes(1000)])
    good_one, bad_one = read_requests(arrays, Budget(MessageLimits(decoded_bytes=4000)))
    assert isinstance(good_one, Request)
    assert isinstance(bad_one, Reply)
    assert isinstance(bad_one.error, MessageTooLarge)


def test_what_images_declare_is_refused_before_the_first_is_decoded(decoded: list[str]) -> None:
    with pytest.raises(MessageTooLarge):
        decode_files([JPEG, JPEG, JPEG], Budget(MessageLimits(decoded_bytes=2 * DECODED)))
    with pytest.raises(MessageTooLarge, match=r"limits\.pixels"):
        decode_files([PNG], Budget(MessageLimits(pixels=32 * 31)))
    assert decoded == []


def test_4k_cameras_pass_by_default() -> None:
    limits = DEFAULT_LIMITS
    assert max(3840 * 2160, 4096 * 2160) <= limits.pixels
    assert limits.decoded_bytes >= 3 * 4 * 3840 * 2160  # four images at once
    assert 4 * limits.decoded_bytes <= limits.in_flight_bytes


def test_a_png_that_changes_its_mind_about_its_size_is_refused() -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data))
            + kind
            + data
            + struct.pack(">I", zlib.crc32(data, zlib.crc32(kind)))
        )

    def header(side: int) -> bytes:
        return chunk(b"IHDR", struct.pack(">2I5B", side, side, 8, 2, 0, 0, 0))

    data = chunk(b"IDAT", zlib.compress(bytes(64 * (1 + 64 * 3))))
    liar = PNG[:8] + header(8) + header(64) + data + chunk(b"IEND", b"")
    with pytest.raises(VLAgentsError, match="PNG"):
        jpeg_png.decode(liar)


def test_robots_have_a_share_of_the_memory_for_themselves() -> None:
    whole = Admission(8 * DECODED)

    def message(priority: str) -> tuple[MessageAdmission, VLAgentsError | None]:
        one = MessageAdmission(whole, DEFAULT_LIMITS, free(NoKey.OPEN))
        [answer] = read_requests(frame(reset(priority=priority)), one)
        return one, answer.error if isinstance(answer, Reply) else None

    simulations = [message("simulation") for _ in range(6)]
    assert [error for _, error in simulations] == [None] * 6
    refused = message("simulation")[1]
    assert isinstance(refused, Overloaded)
    assert (refused.status, refused.retry_after_s) == (503, 1.0)
    robots = [message("robot") for _ in range(2)]
    assert [error for _, error in robots] == [None] * 2
    assert isinstance(message("robot")[1], Overloaded)
    del simulations[0]  # the message was answered or dropped
    assert message("robot")[1] is None
    assert isinstance(message("simulation")[1], Overloaded)  # robots keep the memory that they use
    # A limit into which the message will never fit.
    small = MessageAdmission(Admission(DECODED), DEFAULT_LIMITS, free(NoKey.OPEN))
    [answer] = read_requests(frame(reset(priority="simulation")), small)
    assert isinstance(answer, Reply)
    assert isinstance(answer.error, MessageTooLarge), "the client is not asked to wait"
    assert "limits.in_flight_bytes" in str(answer.error)


def test_a_key_takes_half_of_what_other_keys_leave_free() -> None:
    whole = Admission(8 * DECODED)

    def message(key: str) -> tuple[MessageAdmission, VLAgentsError | None]:
        one = MessageAdmission(whole, DEFAULT_LIMITS, free(NoKey.OPEN), share=key)
        [answer] = read_requests(frame(reset()), one)
        return one, answer.error if isinstance(answer, Reply) else None

    of_one = [message("one") for _ in range(5)]
    assert [type(error) for _, error in of_one] == [type(None)] * 4 + [Overloaded]
    of_other = [message("other") for _ in range(3)]
    assert [type(error) for _, error in of_other] == [type(None)] * 2 + [Overloaded]
    assert message("third")[1] is None
    for one, _ in of_one + of_other:
        one.release()
    assert whole.held == 0
    assert not whole._held_by


def test_incomplete_messages_give_way_to_a_complete_one() -> None:
    whole = Admission(100)
    given_up: list[str] = []

    def arriving(name: str, key: str | None, size: int) -> ArrivingBytes:
        one = ArrivingBytes(whole, key, True, lambda: given_up.append(name))
        one.resize(size)
        return one

    held = [arriving("a", "flood", 30), arriving("b", "flood", 20), arriving("c", None, 40)]
    whole.hold(20, True, 0, "robot")
    assert given_up == ["a"]
    with pytest.raises(Overloaded):
        held[0].resize(80)
    with pytest.raises(Overloaded):  # simulations cannot use the robots' memory
        whole.hold(30, False, 0)
    assert given_up == ["a"]
    whole.release(20, "robot")
    for one in held:
        one.release()
    assert whole.held == 0


def test_how_long_to_wait_travels_with_the_refusal() -> None:
    for error in (TooManyRequests("x"), Overloaded("x")):
        error.retry_after_s = 2.5
        told = decode_replies(encode_replies([Reply(error=error)]))[0].error
        assert type(told) is type(error)
        assert told.retry_after_s == 2.5  # type: ignore[union-attr]


# The thread on which a message is decoded.


class Sees(Agent):
    """A policy that returns the height of the camera's image."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {}

    def act(self, obs: Obs) -> Act:
        return Act(np.array([obs.cameras["front"].shape[0]], np.float32))


@pytest.fixture
def held_up(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[threading.Event, list[str]]]:
    """Block the decoding of large images until the event is set, and return the names of the
    threads that decode them.
    """
    go_on, threads, original = threading.Event(), [], jpeg_png.decode_file

    def decode(file: ImageFile) -> np.ndarray:
        image = original(file)
        if image.shape[0] > 1000:
            threads.append(threading.current_thread().name)
            assert go_on.wait(30)
        return image

    monkeypatch.setattr(jpeg_png, "decode_file", decode)
    yield go_on, threads
    go_on.set()


@pytest.fixture
def endpoints() -> Iterator[tuple[OwnPortServer, ShmServer]]:
    engine = Engine(Sees())
    own = OwnPortServer(engine, MessageLimits(), "127.0.0.1", None, NoKey.OPEN)
    near = ShmServer(engine, MessageLimits(), NoKey.OPEN)
    own.open(), near.open()
    engine.start()
    yield own, near
    engine.close()
    own.close(), near.close()
    assert engine.admission.held == 0


def _connected(own: OwnPortServer) -> Stream:
    return Stream(urlsplit("http://127.0.0.1"), own.address.port, own.address.path, 10)


def act(file: bytes, name: str, **more: Any) -> bytes:
    return b"".join(
        frame_layout.pack({"op": "act", "obs": SEEN, "request_id": name, **more}, [file])
    )


@pytest.mark.parametrize(
    ("priority", "threads"), [("simulation", "decode-others"), ("robot", "decode-robots")]
)
def test_a_robot_is_answered_while_anothers_image_is_decoded_and_order_is_kept(
    endpoints: tuple[OwnPortServer, ShmServer],
    held_up: tuple[threading.Event, list[str]],
    priority: str,
    threads: str,
) -> None:
    go_on, decoders = held_up
    own, near = endpoints
    robot, other = _connected(own), _connected(own)
    local = ShmTransport(near.address, Credentials(""))
    local.connect(10)
    for client in (robot, other):
        client.send(frame(reset()), 10)
        assert decode_replies(client.recv(10))[0].error is None
    small = Obs({"front": np.zeros((8, 8, 3), np.uint8)})
    assert local.call([Request("reset", small)], 10)[0].error is None
    other.send(act(LARGE, "large", priority=priority), 10)
    other.send(act(JPEG, "small", priority=priority), 10)
    wait_for(lambda: decoders != [])
    assert decoders[0].startswith(threads)
    for _ in range(3):
        robot.send(act(JPEG, "robot"), 10)
        assert decode_replies(robot.recv(10))[0].act is not None
        assert local.call([Request("act", small)], 10)[0].act is not None
    go_on.set()
    first, second = decode_replies(other.recv(10))[0], decode_replies(other.recv(10))[0]
    assert [(one.request_id, one.act.action.tolist()) for one in (first, second) if one.act] == [
        ("large", [1100.0]),
        ("small", [32.0]),
    ]
    assert len(decoders) == 1
    for client in (robot, other, local):
        client.close()


def test_a_frame_that_waits_for_another_to_be_decoded_spends_its_own_deadline(
    endpoints: tuple[OwnPortServer, ShmServer], held_up: tuple[threading.Event, list[str]]
) -> None:
    go_on, decoders = held_up
    client = _connected(endpoints[0])
    client.send(frame(reset()), 10)
    assert decode_replies(client.recv(10))[0].error is None
    # Both messages are read at once.
    client._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_CORK, 1)
    client.send(act(LARGE, "large"), 10)
    client.send(act(JPEG, "small", deadline_ms=200), 10)
    client._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_CORK, 0)
    wait_for(lambda: decoders != [])
    time.sleep(0.3)  # the deadline passes
    go_on.set()
    assert decode_replies(client.recv(10))[0].act is not None
    assert isinstance(decode_replies(client.recv(10))[0].error, DeadlineExceeded)
    client.close()


def test_a_frame_in_shared_memory_is_decoded_beside_the_policy_too(
    endpoints: tuple[OwnPortServer, ShmServer],
    held_up: tuple[threading.Event, list[str]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    go_on, decoders = held_up
    own, near = endpoints
    robot = _connected(own)
    robot.send(frame(reset()), 10)
    assert decode_replies(robot.recv(10))[0].error is None
    local = ShmTransport(near.address, Credentials(""))
    local.connect(10)
    large = frame_layout.pack(reset(), [LARGE])
    monkeypatch.setattr("vlagents_ray.client.transports.shm.request_parts", lambda *_: large)
    answers: list[Reply] = []
    asking = threading.Thread(
        target=lambda: answers.extend(local.call([Request("reset", Obs())], 30))
    )
    asking.start()
    wait_for(lambda: decoders != [])
    robot.send(act(JPEG, "robot"), 10)
    assert decode_replies(robot.recv(10))[0].act is not None
    go_on.set()
    asking.join(30)
    assert answers[0].error is None
    robot.close(), local.close()


def test_a_client_that_leaves_while_its_image_is_decoded_leaves_nothing(
    endpoints: tuple[OwnPortServer, ShmServer], held_up: tuple[threading.Event, list[str]]
) -> None:
    go_on, decoders = held_up
    own, _ = endpoints
    other = _connected(own)
    other.send(frame(reset(), files=[LARGE]), 10)
    wait_for(lambda: decoders != [])
    assert own.engine.admission.held > 0
    other.close()
    go_on.set()
    wait_for(lambda: not own._clients)
    wait_for(lambda: own.engine.admission.held == 0)
    assert len(own.engine.sessions) == 0


def test_an_event_loop_goes_on_while_a_message_is_decoded(
    held_up: tuple[threading.Event, list[str]],
) -> None:
    go_on, decoders = held_up

    async def run() -> Decoded:
        message = message_admission()
        reading = asyncio.ensure_future(
            message.decoded(lambda budget: decode_requests(frame(reset(), files=[LARGE]), budget))
        )
        while not decoders:
            await asyncio.sleep(0.001)
        assert not reading.done()
        go_on.set()
        return await reading

    assert len(asyncio.run(run()).requests) == 1


def test_images_of_a_long_message_are_decoded_where_it_was_read() -> None:
    """vla-eval's and XPolicyLab's images are decoded after their message."""

    def thread(_budget: Budget) -> str:
        return threading.current_thread().name

    async def run() -> list[str]:
        message = message_admission()
        return [await message.decoded(thread, long=True), await message.decoded(thread)]

    assert all(name.startswith("decode-") for name in asyncio.run(run()))


def test_a_message_that_is_read_again_elsewhere_counts_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    freeze(monkeypatch)
    known = ChangingKeys()
    message = message_admission(caller=known.keys.check(known.add("arm", rate=100), "app"))
    data = frame(reset(), reset(obs={"cameras": {"front": {"$": ["img", 1]}}}), files=[JPEG, LARGE])

    def read(budget: Budget) -> Decoded:
        return decode_requests(data, budget)

    with pytest.raises(NeedsDecodingThread):
        read(message)
    assert not message.decode_on_thread(read).result(30).refused
    assert requests_charged(known.keys, "arm") == 2


def test_simulations_images_are_decoded_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> Any:
        raise AssertionError("images were decoded on several cores")

    monkeypatch.setattr(codecs, "thread_map", refuse)
    two = {"cameras": {"a": {"$": ["img", 0]}, "b": {"$": ["img", 1]}}}
    known = ChangingKeys()
    token = known.add("simulations", priority="simulation")
    message = message_admission(caller=known.keys.check(token, "app"))
    data = frame(reset(obs=two), files=[LARGE, LARGE])
    assert (
        not message.decode_on_thread(lambda budget: decode_requests(data, budget))
        .result(30)
        .refused
    )


# Clients over their rate.


@pytest.mark.slow
def test_local_clients_over_their_rate_wait_without_threads_and_leave_nothing_behind(
    replica: KeyedReplica, monkeypatch: pytest.MonkeyPatch
) -> None:
    visitor = replica.visitor("right")
    replica.known.change(visitor.name, rate=1e-6)
    replica.known.keys.check(visitor.token, "app").take_request()
    started, read = [], []
    start, receive = threading.Thread.start, UnixConnection._receive

    def noted(thread: threading.Thread) -> None:
        # The thread "keys" reads the key file.
        if threading.current_thread().name.startswith("policy") and thread.name != "keys":
            started.append(thread.name)
        start(thread)

    def counted(one: UnixConnection, *args: Any) -> None:
        read.append(one)
        receive(one, *args)

    monkeypatch.setattr(threading.Thread, "start", noted)
    monkeypatch.setattr(UnixConnection, "_receive", counted)

    def held() -> list[UnixConnection]:
        return [
            one
            for one in list(replica.local._clients)
            if getattr(one.caller, "name", "") == visitor.name
        ]

    message = frame(reset())
    descriptor = os.memfd_create("message", os.MFD_ALLOW_SEALING)
    os.write(descriptor, message)
    fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
    crowd = [socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(8)]
    for one in crowd:
        one.connect("\0" + replica.local.address.socket)
        one.send(visitor.token.encode())
        for _ in range(6):
            socket.send_fds(one, [LocalAddress.REQUEST.pack(0, 0, len(message))], [descriptor])
    wait_for(lambda: len(held()) == len(crowd) and all(not one._polled for one in held()))
    wait_for(lambda: len(read) > 2)  # one per second among all that wait
    for one in crowd:
        one.close()
    left = len(read)
    wait_for(lambda: not held())
    os.close(descriptor)
    assert len(read) <= left + 2, "messages of clients that have left were read"
    assert started == []


@pytest.mark.parametrize("path", ["own", "/v1/stream", "/vla-eval"])
def test_what_cannot_be_read_counts_too(replica: KeyedReplica, path: str) -> None:
    """Otherwise garbage would be free for its sender."""
    visitor = replica.visitor("right")
    replica.known.change(visitor.name, rate=1e-6)
    wanted = {"own": _read_reply, "/v1/stream": _read_reply, "/vla-eval": _read_vla_eval}[path]
    assert over_websocket(path, lambda _: b"\xc1" * 1000, wanted)(visitor, "with") == "400"
    with pytest.raises(TooManyRequests):
        replica.known.keys.check(visitor.token, "app").take_request()


# The memory for messages is bounded in bytes, however many of the largest messages arrive.


def _rss() -> int:
    gc.collect()
    return int(psutil.Process().memory_info().rss)


def _keyed_stream(replica: KeyedReplica, token: str, path: str = "own") -> Stream:
    """Return a WebSocket at the replica's own port, or at a path of its HTTP port."""
    own = replica.own.address
    port, path = (own.port, own.path) if path == "own" else (replica.port, path)
    return Stream(
        urlsplit("http://127.0.0.1"), port, path, 10, {"authorization": f"Bearer {token}"}
    )


def _part(client: Stream, size: int) -> int:
    """Send all but the last byte of a message of that size, until the server reads no more; return
    the number of unsent bytes.
    """
    connection = client._socket
    connection.setblocking(False)
    data = memoryview(
        bytes([0x82, 0x80 | 127]) + struct.pack(">Q", size) + bytes(4) + bytes(size - 1)
    )
    connection.settimeout(0.5)
    with contextlib.suppress(OSError):  # the server reads no more
        while data:
            data = data[connection.send(data) :]
    return len(data)


@pytest.mark.slow
def test_parts_of_messages_of_a_key_are_bounded_by_its_rate(replica: KeyedReplica) -> None:
    visitor = replica.visitor("right")
    replica.known.change(visitor.name, rate=1)
    before = _rss()
    clients = [_keyed_stream(replica, visitor.token) for _ in range(5)]
    for client in clients:
        _part(client, STREAM_BYTES)
    mine = [
        one for one in list(replica.own._clients) if getattr(one.caller, "name", "") == visitor.name
    ]
    begun = [one for one in mine if one._received.size > 2**20 + 100]
    assert len(begun) <= 4  # one per second, since each took half a second
    assert replica.engine.admission.held <= len(begun) * STREAM_BYTES + 8 * 2**20
    assert _rss() - before < len(begun) * STREAM_BYTES + 8 * 2**20 + SLACK
    for client in clients:
        client.close()
    wait_for(lambda: replica.engine.admission.held == 0)


def test_a_connection_ends_after_some_refusals_in_a_row(
    replica: KeyedReplica, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(api_keys, "_THROTTLED_S", (0.02, 0.02))
    visitor = replica.visitor("right")
    client = _keyed_stream(replica, visitor.token)
    replica.known.change(visitor.name, rate=1e-6)
    replica.known.keys.check(visitor.token, "app").take_request()
    for _ in range(REFUSALS):
        client.send(encode_requests([Request("reset", OBS)]), 10)
        assert isinstance(decode_replies(client.recv(10))[0].error, TooManyRequests)
    with pytest.raises((ConnectionError, VLAgentsError)):
        client.recv(5)
    client.close()


def test_a_key_over_its_rate_is_read_on_none_of_its_connections(replica: KeyedReplica) -> None:
    visitor = replica.visitor("right")
    first, second = _keyed_stream(replica, visitor.token), _keyed_stream(replica, visitor.token)
    frame = encode_requests([Request("reset", OBS)])
    for client in (first, second):
        client.send(frame, 10)
        assert decode_replies(client.recv(10))[0].error is None
    replica.known.change(visitor.name, rate=1e-6)
    replica.known.keys.check(visitor.token, "app").take_request()

    first.send(frame, 10)
    assert isinstance(decode_replies(first.recv(10))[0].error, TooManyRequests)
    second.send(frame, 10)
    with pytest.raises(TimeoutError):  # the server does not read it for a second
        second.recv(0.1)
    with pytest.raises(InvalidStatus, match="429"):
        _keyed_stream(replica, visitor.token)
    first.close(), second.close()


@pytest.mark.slow
def test_the_messages_of_a_key_over_its_rate_stay_unread_at_uvicorns_websockets(
    replica: KeyedReplica, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading them would take time from robots, and memory until they are rejected."""
    monkeypatch.setattr(api_keys, "_THROTTLED_S", (3.0, 3.0))
    visitor = replica.visitor("right")
    client = _keyed_stream(replica, visitor.token, "/v1/stream")
    replica.known.change(visitor.name, rate=1e-6)
    caller = replica.known.keys.check(visitor.token, "app")
    caller.take_request()
    with pytest.raises(TooManyRequests):
        caller.take_request()
    assert _part(client, STREAM_BYTES) > STREAM_BYTES / 4, "the kernel's buffers contain 10 MB"
    replica.known.change(visitor.name, rate=None)
    client.close()
    # The server now reads the bytes in these buffers, which takes memory.
    wait_for(lambda: visitor.name not in replica.known.keys._connections)


def test_an_act_in_compact_form_is_read_again_after_a_refusal(replica: KeyedReplica) -> None:
    """The first message, which was rejected before it was parsed, contained the layout of its
    arrays.
    """
    visitor = replica.visitor("right")
    transport = ShmTransport(replica.local.address, Credentials(visitor.token))
    transport.connect(10)
    assert transport.call([Request("reset", OBS)], 10)[0].error is None
    replica.known.change(visitor.name, rate=1e-6)
    replica.known.keys.check(visitor.token, "app").take_request()
    assert isinstance(
        transport.call([Request("act", OBS, request_id="a")], 10)[0].error, TooManyRequests
    )
    replica.known.change(visitor.name, rate=None)
    [reply] = transport.call([Request("act", OBS, request_id="b")], 10)
    assert reply.error is None, reply.error
    transport.close()


@pytest.mark.slow
def test_parts_of_messages_before_a_key_are_bounded_at_groots_gateway(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """12 connections that each send part of a message of 24 MiB use at most the 64 MiB of one
    message, and part of another.
    """
    monkeypatch.setattr(gr00t, "_STRANGER_S", 3.0)
    monkeypatch.setattr(gr00t, "_MESSAGE_S", 3.0)
    context = GatewayContext(
        "app", _no_replica, DEFAULT_LIMITS, 8, 30.0, None, lambda _: NoKey.OPEN
    )
    dialect = gr00t.GR00TDialect("gr00t", gr00t.GR00TDialectConfig(), context)
    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    dialect.serve(listener)
    greeting = (
        b"\xff" + bytes(8) + b"\x7f" + b"\x03\x01" + b"NULL".ljust(20, b"\0") + b"\0" + bytes(31)
    )
    greeted = b"\x05READY" + b"\x0bSocket-Type" + struct.pack(">I", 6) + b"DEALER"
    before, held, part = _rss(), [], bytes(24 * 2**20)
    for _ in range(12):
        connection = socket.create_connection(("127.0.0.1", port), timeout=5)
        held.append(connection)
        connection.sendall(greeting)
        got = 0
        while got < 64:
            got += len(connection.recv(64 - got))
        connection.sendall(
            b"\x04" + bytes([len(greeted)]) + greeted + b"\x02" + struct.pack(">Q", 2 * len(part))
        )
        with contextlib.suppress(OSError):  # the server closes the connection in the meantime
            connection.sendall(part)
    assert _rss() - before < DEFAULT_LIMITS.body_bytes + len(part) + SLACK
    wait_for(lambda: all(_ended(one) for one in held))
    wait_for(lambda: _rss() - before < SLACK)
    for connection in held:
        connection.close()
    dialect.close()


def test_a_request_at_groots_gateway_counts_as_in_flight_for_its_key() -> None:
    admission, connecting = Admission(4 * 10**6), threading.Event()

    def connect(*_: object) -> RemoteAgent:
        connecting.wait(20)
        raise PolicyUnavailable("there is no replica")

    known = ChangingKeys()
    tokens = [known.add("one"), known.add("another")]
    check = partial(known.keys.check, app="app")
    context = GatewayContext("app", connect, DEFAULT_LIMITS, 8, 30.0, None, check, admission)
    dialect = gr00t.GR00TDialect("gr00t", gr00t.GR00TDialectConfig(), context)
    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    dialect.serve(listener)
    seen = {
        "video": {"ego": np.zeros((1, 1, 500, 800, 3), np.uint8)},
        "state": {},
        "language": {"task": [["go"]]},
    }

    def error_of(token: str, observation: dict[str, Any]) -> str:
        with PolicyClient(port, token) as client, pytest.raises(RuntimeError) as refused:
            client.get_action(observation)
        return str(refused.value)

    with ThreadPoolExecutor(3) as clients:
        first = clients.submit(error_of, tokens[0], seen)  # 1.2 MB, which wait for a replica
        wait_for(lambda: admission.held > 10**6)
        assert "overloaded" in error_of(tokens[0], seen)  # the share of a key is half
        other = clients.submit(error_of, tokens[1], seen)
        wait_for(lambda: admission.held > 2 * 10**6)
        connecting.set()
        assert "no replica" in first.result()
        assert "no replica" in other.result()
    wait_for(lambda: admission.held == 0)
    dialect.close()


def _no_replica(*_: object) -> RemoteAgent:
    raise PolicyUnavailable("there is no replica")


def _ended(connection: socket.socket) -> bool:
    connection.setblocking(False)
    try:
        while connection.recv(65536):
            pass
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True
