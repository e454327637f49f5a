"""Scenarios of this project's own protocol."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from golden import JPEG_FILE, png

from tests.golden.scenarios import (
    EVERYWHERE,
    FRAMES,
    HTTP,
    LOCAL,
    STREAMS,
    TOGETHER,
    Send,
    asks,
    gets,
    http,
    scenario,
    server,
)
from tests.golden.traces import Step, Trace
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.frame_layout import pack
from vlagents_ray.protocol.frames import CONTENT_TYPE, encode_requests
from vlagents_ray.protocol.messages import LocalAddress, Request

PIXELS = np.full((8, 8, 3), 7, np.uint8)
SEEN = Obs({"front": PIXELS}, 0.5, {"joints": np.array([0.25, -0.5], np.float32)})
DRAWN = 10**15  # the step at which the first episode of a server begins


def reset(instruction: str | None = "pick", **more: Any) -> Request:
    return Request("reset", SEEN, instruction, request_id="r-1", **more)


def act(obs: Obs = SEEN, request_id: str = "a-1", **more: Any) -> Request:
    return Request("act", obs, request_id=request_id, **more)


def seen(**changes: Any) -> Request:
    """Return an act with a changed observation."""
    return act(replace(SEEN, **changes))


def asked(what: str, **more: Any) -> Request:
    """Return an act whose observation requests something special from the policy."""
    return act(replace(SEEN, info={"asked": what}), **more)


def node(op: str = "act", blobs: tuple[bytes, ...] = (), leave_out: str = "", **more: Any) -> bytes:
    """Return a frame with one request in JSON, with the given fields changed."""
    header = {
        "op": op,
        "obs": {"cameras": {}, "gripper": None, "state": {}, "info": {}},
        "request_id": "n-1",
    } | more
    header.pop(leave_out, None)
    return b"".join(pack(header, list(blobs)))


def image(file: bytes) -> bytes:
    """Return an act with an image file."""
    obs = {
        "cameras": {"front": {"$": ["img", 0]}},
        "gripper": 0.5,
        "state": {"joints": [0.25, -0.5]},
        "info": {},
    }
    return node(blobs=(file,), obs=obs)


def episodes() -> Iterator[Trace]:
    """Yield scenarios of normal episodes."""
    begin, first, second = asks(reset()), "s-1", "s-2"
    say = {
        "nothing": None,
        "yes": True,
        "whole": -7,
        "half": 0.5,
        "text": 'Würfel "é" \n',
        "bytes": b"\0\xff",
    }
    say |= {
        "nan": math.nan,
        "list": [1, [2.5]],
        "array": np.array([[1, 2]], np.int16),
        "inf": np.array([np.inf]),
    }
    answers = asks(asked("one row"), asked("done"), seen(info={"say": say}), seen(gripper=None))
    close = Request("close", request_id="c-1")
    yield from scenario(
        "an episode", EVERYWHERE, begin, asks(act(), act(request_id="a-2"), close, act())
    )
    yield from scenario("what an act answers", EVERYWHERE, begin, answers)
    yield from scenario(
        "an episode has an instruction and options",
        FRAMES,
        asks(reset("pick", kwargs={"seed": 3, "list": [1.5]}), act()),
        asks(reset("place it"), act()),
        asks(reset(None)),
        asks(reset(contract={"cameras": {"side": {}}, "action": {"dim": 3}}), act()),
    )
    yield from scenario(
        "several requests in a message",
        TOGETHER,
        asks([reset(session=first), reset("place it", session=second, priority="simulation")]),
        asks(
            [
                act(session=second),
                act(session="unknown", request_id="a-2"),
                act(session=first, request_id="a-3"),
            ]
        ),
        asks(
            [act(session=first), act(replace(SEEN, cameras={}), session=first), act(session=second)]
        ),
    )
    yield from scenario(
        "no session", TOGETHER, asks(act(), act(session="x"), replace(close, session="x"))
    )
    steps = (act(step=2**60 + 2**20), act(step=2**60 + 2**20), act(step=2**61), act(step=1))
    yield from scenario("steps", (*FRAMES, *LOCAL[:1]), asks(reset(step=2**60), *steps))
    yield from scenario(
        "full", ("handle", "http"), begin, asks(reset(), who="b"), asks(act()), sessions=1
    )
    yield from scenario(
        "not ready", ("/v1/stream", "handle", "http"), begin, asks(act()), ready=False
    )
    pixels = [replace(SEEN, cameras={"front": PIXELS + place}) for place in (1, 2)]
    again = asks(act(session=first), reset(history=pixels, step=2**60), act(), who="b")
    lost = [
        asks(reset(session=first), act(session=first)),
        Step("a", "leaves"),
        server("has no session"),
        again,
    ]
    yield from scenario(
        "a session is lost with its connection, and begins again", (*STREAMS, *LOCAL[:1]), *lost
    )
    yield from scenario(
        "an episode begins again",
        ("handle", *HTTP),
        asks(reset(history=pixels, step=2**60), act()),
    )
    yield from scenario(
        "a replica that drains",
        # At a replica's own port, an HTTP connection ends after an answer of a draining replica.
        [endpoint for endpoint in TOGETHER if endpoint != HTTP[1]],
        begin,
        asks(act()),
        server("drains"),
        asks(act(), reset()),
    )
    yield from scenario(
        "a session goes to another replica",
        ("/v1/stream", "http"),
        asks(reset(session=first), act(session=first), who="a0"),
        server("drains"),
        asks(act(session=first), who="a0"),
        Step("a0", "leaves"),
        asks(act(session=first, step=DRAWN + 2), who="b1"),
        replicas=2,
    )
    held = [begin, asks(reset(), who="b"), Send("a", asked("wait")), server("is acting")]
    # The deadline has passed before any server reads the request.
    held.append(Send("b", act(deadline_ms=0.001)))
    name, later = "a deadline that is over", asks(act(deadline_ms=1e6), who="b")
    yield from scenario(name, TOGETHER[2:4], *held, gets("b"), server("acts on"), gets("a"), later)
    yield from scenario(
        name,
        (*STREAMS, HTTP[1], *LOCAL[:1]),
        *held,
        server("acts on"),
        gets("a"),
        gets("b"),
        later,
    )
    yield from scenario(
        "the order of answers",
        (*STREAMS, *LOCAL[:1]),
        asks([reset(session=first), reset(session=second)]),
        [
            Send("a", asked("wait", session=first)),
            server("is acting"),
            Send("a", act(session=second, request_id="a-2")),
        ],
        [server("acts on"), gets(), gets()],
    )


def refusals() -> Iterator[Trace]:
    """Yield scenarios of requests that are rejected without any effect: an act follows before and
    after them.
    """
    begin, end = asks(reset()), asks(act())
    cameras = [
        {},
        {"side": PIXELS},
        *({"front": wrong} for wrong in (PIXELS[:4], PIXELS / 255, PIXELS[0])),
    ]
    states = [
        {},
        {"joints": np.zeros(3, np.float32)},
        {"joints": np.array([np.nan, 0], np.float32)},
    ]
    wrong = [
        *(seen(cameras=one) for one in cameras),
        *(seen(state=one) for one in states),
        seen(gripper=1.5),
    ]
    yield from scenario(
        "observations that do not fit the contract", TOGETHER, begin, asks(*wrong), end
    )
    jpeg = JPEG_FILE.read_bytes()
    files = [png(PIXELS), jpeg, jpeg[:40], png(np.zeros((16, 16, 3), np.uint8)), b"GIF89a"]
    yield from scenario("files of images", FRAMES, begin, asks(*map(image, files)))
    deep: Any = 1
    for _ in range(9):
        deep = [deep]
    large = [{"info": {"a": deep}}, {"info": {"list": [0] * 300}}, {"state": {"joints": [0] * 9}}]
    resets = [node("reset", instruction="x" * 81), node("reset", history=[{}] * 257)]
    too_large = asks(
        node(blobs=(bytes(4096),)), *(node(obs=obs) for obs in large), *resets, [act()] * 5
    )
    yield from scenario("too large", FRAMES, begin, too_large, end)
    odd = [
        b"",
        b"VLA",
        b"VLB\x01" + bytes(4),
        b"VLA\x02" + bytes(4),
        b"VLA\x01\xff\0\0\0{}",
        node()[:-1],
        node() + b"\0",
    ]
    odd += [
        b"VLA\x01\x02\0\0\0{}",
        b"VLA\x01\x02\0\0\0{]",
        node(leave_out="op"),
        node("jump"),
        node("observe"),
    ]
    odd += [
        node(leave_out="obs"),
        node(obs=7),
        node(colour="red"),
        node(obs={"colour": "red"}),
        node(kwargs={"a": 1}),
    ]
    odd += [
        node(obs={"cameras": {"front": {"$": ["nd", 5, "<f4", [1]]}}}),
        node(obs={"info": {"a": {"$": ["zip", 0]}}}),
    ]
    odd += [
        node(request_id="a b"),
        node(session=7),
        node(priority="human"),
        node(step="-1"),
        node(deadline_ms=0),
    ]
    odd += [
        node(obs={"gripper": "open"}),
        node(obs={"cameras": {"": [1]}}),
        node("reset", instruction=7),
    ]
    yield from scenario("malformed", FRAMES, begin, asks(*odd), end)
    failures = asks(
        asked("fail"), asked("wrong action"), asked("no info"), act(), reset("no reset"), act()
    )
    yield from scenario("the policy fails", TOGETHER, begin, failures)


def streams() -> Iterator[Trace]:
    """Yield scenarios that only WebSockets have."""
    begin, opened, end = asks(reset()), Step("a", "opens"), asks(act())
    yield from scenario("a handshake", STREAMS, opened, begin)
    yield from scenario("a handshake at another path", ("/v1/strea",), opened)
    yield from scenario(
        "full", STREAMS, begin, Step("b", "opens"), gets("b"), gets("b"), end, sessions=1
    )
    odd = asks((b"VLA?" + bytes(4) + b"xyz",), (b"VLA?",), (b"hello", b"\x81"))
    fragments = [Send("a", (b"part", b"\x02")), Send("a", (b"", b"\x80")), gets()]
    yield from scenario("probes, text, and a fragment", STREAMS, begin, odd, end, fragments)
    yield from scenario("a client says goodbye", STREAMS, begin, asks((b"\x03\xe8bye", b"\x88")))


def control_messages() -> Iterator[Trace]:
    """Yield scenarios that only the Unix sockets of shared memory and plasma have."""
    begin, end, head = asks(reset()), asks(act()), LocalAddress.REQUEST.pack
    message, memory = next(scenario("", LOCAL[:1], Send("a", act()))).steps[0].data
    again = (head(1, LocalAddress.COMPACT, len(memory)) + message[16:],)
    yield from scenario("memory files", LOCAL[:1], begin, end, asks(again, asked("large")), end)
    yield from scenario("full", LOCAL[:1], begin, gets("b"), gets("b"), end, sessions=1)
    odd = asks(
        (b"short",), (head(9, 0, 8),), (head(16, 0, 8), bytes(8)), (head(1, 0, 5000), bytes(8))
    )
    odd += asks((head(1, 2, 64), bytes(64)), (head(2, 2, 64) + bytes(4), bytes(64)))
    odd += asks((message[:-9], memory), (message[:8] + bytes(8) + message[16:], memory))
    yield from scenario("malformed control messages", LOCAL[:1], begin, odd, end)
    odd = asks((b"short",), (b"x" * 28 + bytes(4) + b"y", b""))
    yield from scenario("malformed control messages", LOCAL[1:], begin, odd)


def of_http() -> Iterator[Trace]:
    """Yield scenarios that only HTTP has: documents, forms, headers and other paths."""
    observed, file, frame = (
        {"gripper": 0.5, "state": {"joints": [0.25, -0.5]}},
        png(PIXELS),
        CONTENT_TYPE,
    )

    def form(document: bytes | dict[str, Any], **files: bytes) -> bytes:
        head = b'--edge\r\nContent-Disposition: form-data; name="%s"%s\r\n\r\n%s\r\n'
        obs = document if isinstance(document, bytes) else json.dumps(document).encode()
        parts = [
            head % (f"cameras.{name}".encode(), b'; filename="x"', data)
            for name, data in files.items()
        ]
        return b"".join([head % (b"obs", b"", obs)] * bool(obs) + parts + [b"--edge--\r\n"])

    def post(
        op: str, body: Any, kind: str = "", session: str = "s-1", **headers: str
    ) -> tuple[bytes]:
        data = body if isinstance(body, bytes) else json.dumps(body).encode()
        usual = "multipart/form-data; boundary=edge" if data[:2] == b"--" else "application/json"
        return (http("POST", f"/v1/{op}", data, kind or usual, session, **headers),)

    whole = form(observed, front=file)
    begin = asks(post("reset", form(observed | {"instruction": "pick"}, front=file)))
    say = form(
        observed | {"request_id": "j-1", "info": {"say": {"raw": 1, "list": [1.5, None]}}},
        front=file,
    )
    yield from scenario(
        "an episode in forms",
        HTTP,
        begin,
        asks(
            post("act", whole),
            post("act", say),
            post("act", whole, accept=frame, x_step=str(DRAWN + 2)),
        ),
        asks(
            post("act", whole, x_step="7"),
            post("act", whole, x_deadline_ms="1e6", x_priority="simulation"),
        ),
        asks((http("POST", "/v1/close", session="s-1"),), post("act", whole)),
    )
    bodies = [
        {},
        b"[1]",
        b"{",
        b'{"gripper": 1, "gripper": 2}',
        {"cameras": {}},
        {"colour": "red"},
        {"deadline_ms": -1},
    ]
    bodies += [
        form(b"", front=file),
        form({}, front=b"no image"),
        form({}, **{"": file}),
        b"--edge\r\nrubbish",
    ]
    bodies += [bytes(5000), b"\x1f\x8b12345678"]
    refused = asks(
        *(post("act", body) for body in bodies), post("act", {}, content_encoding="gzip")
    )
    yield from scenario("documents and forms that are refused", HTTP, begin, refused)
    headers = [
        {"session": "a b"},
        {"x_request_id": "a b"},
        {"x_deadline_ms": "soon"},
        {"x_priority": "human"},
    ]
    headers += [{"x_step": "-1"}, {"session": ""}, {"kind": "text/plain"}]
    frames = asks(
        post("act", encode_requests([reset()]), kind=frame), post("act", b"VLA", kind=frame)
    )
    refused = asks(*(post("act", whole, **header) for header in headers))
    yield from scenario("headers and frames that are refused", HTTP, begin, refused, frames)
    pages = asks((http("GET", "/healthz"),), (http("GET", "/v1/metadata"),))
    others = asks((http("GET", "/v1/nothing"),), (http("GET", "/v1/act"),))
    yield from scenario("other paths", ("http",), pages, others)
    yield from scenario(
        "other paths, while the policy loads",
        ("http",),
        pages,
        asks((http("GET", "/docs"),)),
        ready=False,
    )
