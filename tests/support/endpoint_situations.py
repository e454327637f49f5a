"""The bytes of each endpoint in each situation: what a client sends, and the complete answer.

`SITUATIONS` are the rows, and each `Endpoint` is a column. The answers are recorded in
tests/golden/endpoints, a file for each endpoint, as tests/golden describes: the recorded bytes are
sent, whatever today's encoders write, and everything that the server sends until the end of the
connection is compared, with the handshakes and the heads of frames. `tests.golden.masks` zeroes
what varies by nature: ids that are drawn at random, times, the headers Date and Server, and which
memory files are free again.

The endpoints of the core are below, in `CORE`; each plug-in has those of its own.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from golden import png

from tests.golden.own_protocol import PIXELS, act, asked, reset, seen
from tests.golden.replica import EACH_BYTE, KEY
from tests.golden.scenarios import (
    HTTP,
    ScenarioMessage,
    Send,
    Steps,
    asks,
    gets,
    http,
    scenario,
    server,
)
from tests.golden.traces import Step, Trace, differences, read, write
from vlagents_ray.protocol.frames import CONTENT_TYPE, encode_requests
from vlagents_ray.protocol.messages import LocalAddress, PlasmaAddress, Request

FOLDER = Path(__file__).parents[1] / "golden" / "endpoints"
RECORD = "python -m pytest tests/golden --record"
WRONG_KEY = "vlr_wrong"

SITUATIONS = (
    "metadata",
    "reset",
    "act",
    "act with a wrong shape",
    "unknown session",
    "wrong key",
    "expired deadline",
    "garbage",
    "half a message, then close",
    "stop of the server",
)


@dataclass(frozen=True)
class Endpoint:
    """One endpoint, and what its clients do in each situation.

    Args:
        name: Of its file, and in the ids of tests.
        line: Of `tests.golden.replica.Server.line`.
        situations: The steps by situation.
        not_applicable: The reason by situation, for those that this endpoint does not have.
        settings: Of `tests.golden.replica.Server`, in all situations.
    """

    name: str
    line: str
    situations: Mapping[str, Steps]
    not_applicable: Mapping[str, str]
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        described = [*self.situations, *self.not_applicable]
        if sorted(described) != sorted(SITUATIONS):
            raise ValueError(
                f"{self.name}: expected steps or a reason for each of {sorted(SITUATIONS)}, got "
                f"{sorted(described)}"
            )

    def scenario(self, situation: str) -> Trace:
        """What is sent, without the answers."""
        settings = dict(self.settings)
        if situation == "wrong key":
            settings["keys"] = True
        (trace,) = scenario(situation, [self.line], self.situations[situation], **settings)
        return trace


def cases(endpoints: Sequence[Endpoint]) -> list[tuple[Endpoint, str]]:
    """Each endpoint with each of its situations."""
    pairs = []
    for endpoint in endpoints:
        pairs += [(endpoint, each) for each in SITUATIONS if each in endpoint.situations]
    return pairs


def case_ids(endpoints: Sequence[Endpoint]) -> list[str]:
    """The ids of the tests of `cases`."""
    return [f"{endpoint.name}-{situation}" for endpoint, situation in cases(endpoints)]


def require_recorded_answers(endpoint: Endpoint, situation: str, folder: Path) -> None:
    """Send the recorded bytes to a new server; fail if an answer differs from the recorded one."""
    recorded = {trace.name: trace for trace in read(endpoint.name, FOLDER)}
    assert situation in recorded, f"{endpoint.name}, {situation}: not recorded; `{RECORD}` does"

    trace = recorded[situation]
    difference = differences(trace, trace.played(endpoint.line, folder))
    assert not difference, (
        f"{endpoint.name}, {situation}:\n{difference}\n"
        f"After an intended change, `{RECORD}` records the answers again; review that diff."
    )


def require_each_situation_recorded(endpoint: Endpoint) -> None:
    """Fail unless the file has what the table has, in its order."""
    recorded = [trace.name for trace in read(endpoint.name, FOLDER)]
    assert recorded == [name for name in SITUATIONS if name in endpoint.situations]


def record(endpoints: Sequence[Endpoint], folder: Path) -> None:
    """Write the files of these endpoints again."""
    for endpoint in endpoints:
        traces = []
        for _, situation in cases([endpoint]):
            traces.append(endpoint.scenario(situation).played(endpoint.line, folder))
        write(endpoint.name, traces, FOLDER)


# Steps that several protocols have.


def finishes(who: str = "a") -> Step:
    """Send no more, and read until the server ends the connection."""
    return Step(who, "finishes")


def handshake(path: str, key: str | None = None) -> bytes:
    """The handshake of a WebSocket; `{path}` is that of the replica's own port."""
    authorization = "" if key is None else f"Authorization: Bearer {key}\r\n"
    return (
        f"GET {path} HTTP/1.1\r\nHost: robot\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
        f"{authorization}\r\n"
    ).encode()


def websocket_frame(payload: bytes) -> bytes:
    """A client's binary frame, whose mask is zero."""
    size = len(payload)
    if size < 126:
        length = bytes([0x80 | size])
    elif size < 2**16:
        length = bytes([0x80 | 126]) + struct.pack(">H", size)
    else:
        length = bytes([0x80 | 127]) + struct.pack(">Q", size)
    return b"\x82" + length + bytes(4) + payload


NO_FRAME = b"\xff\xff no frame of a WebSocket"
NO_HTTP = b"neither HTTP nor a WebSocket\r\n\r\n"


# The endpoints of the core. A client has one connection, which is named like the client: "a", "b".

NOT_APPLICABLE: dict[str, dict[str, str]] = {
    "shared_memory": {"metadata": "its clients read the metadata over HTTP"},
    "plasma": {
        "metadata": "its clients read the metadata by the replica's method `attach`, under Ray",
        "wrong key": "only processes of the cluster and of the same user reach its socket",
    },
    "own_port": {"metadata": "its clients read the metadata over HTTP"},
    "v1_stream": {"metadata": "its clients read the metadata over HTTP"},
    "serve_handle": {
        "metadata": "its clients read the metadata by the replica's method `attach`, under Ray",
        "wrong key": "only processes of the cluster have a handle",
    },
    "own_port_http": {"metadata": "its clients read the metadata at the server's port"},
    "http_frame": {},
    "http_form": {},
    "http_json": {},
}

Say = Callable[[str, Request], ScenarioMessage]
"""What the client of that name sends for a request."""
OTHER_SHAPES = (
    seen(cameras={"front": PIXELS[:4]}),
    seen(state={"joints": np.zeros(3, np.float32)}),
)
UNKNOWN_SESSIONS = (act(), act(session="another"))


def _episode_steps(
    say: Say,
    connect: Callable[[str], list[Steps]],
    *,
    polled: bool,
    wrong: Sequence[Request] = OTHER_SHAPES,
    unknown: Sequence[Request] = UNKNOWN_SESSIONS,
) -> dict[str, list[Steps]]:
    """The situations that every endpoint of our own protocol has.

    `polled` is whether the policy's thread alone answers what is late: when it is free again.
    """

    def asked_by(who: str, *requests: Request) -> list[Steps]:
        return asks(*(say(who, request) for request in requests), who=who)

    begin = [connect("a"), asked_by("a", reset())]
    both_wait = [
        begin,
        connect("b"),
        asked_by("b", reset()),
        Send("a", say("a", asked("wait"))),
        server("is acting"),
        Send("b", say("b", act(deadline_ms=0.001))),  # over before any server gets to it
    ]
    if polled:
        answers = [server("acts on"), gets("a"), gets("b")]
    else:
        answers = [gets("b"), server("acts on"), gets("a")]
    return {
        "reset": [begin, finishes()],
        "act": [begin, asked_by("a", act(), act(request_id="a-2")), finishes()],
        "act with a wrong shape": [begin, asked_by("a", *wrong, act()), finishes()],
        "unknown session": [connect("a"), asked_by("a", *unknown), finishes()],
        "expired deadline": [both_wait, answers, asked_by("b", act()), finishes(), finishes("b")],
    }


def _websocket(name: str, line: str, path: str) -> Endpoint:
    def say(_who: str, request: Request) -> tuple[bytes]:
        return (websocket_frame(encode_requests([request])),)

    def connect(who: str, key: str | None = None) -> list[Steps]:
        return [Send(who, (handshake(path, key),)), gets(who)]

    frame = say("a", act())[0]
    half = (frame[: len(frame) // 2],)
    situations = _episode_steps(say, connect, polled=True) | {
        "wrong key": [
            [connect("a", WRONG_KEY), finishes()],
            [connect("b"), finishes("b")],
            [connect("c", KEY), asks(say("c", reset()), who="c"), finishes("c")],
        ],
        "garbage": [
            [connect("a"), asks(say("a", reset()), (websocket_frame(b"garbage"),))],
            [asks(say("a", act()), (NO_FRAME,)), finishes()],
            [asks((NO_HTTP,), who="b"), finishes("b")],
        ],
        "half a message, then close": [
            [connect("a"), asks(say("a", reset())), Send("a", half), finishes()],
            [connect("b"), asks(say("b", reset()), who="b"), finishes("b")],
        ],
        "stop of the server": [
            [connect("a"), asks(say("a", reset()), say("a", act()))],
            [server("stops"), gets("a"), finishes()],
        ],
    }
    return Endpoint(name, line + EACH_BYTE, situations, NOT_APPLICABLE[name])


def _unix(name: str, line: str) -> Endpoint:
    def say(_who: str, request: Request) -> Request:
        return request

    def connect(_who: str) -> list[Steps]:
        return []

    def in_memory(data: bytes) -> tuple[bytes, bytes]:
        """A message about a frame that no encoder writes."""
        if line == "plasma":
            return PlasmaAddress.REQUEST.pack(b"a".ljust(28, b"."), 0), data
        return LocalAddress.REQUEST.pack(9, 0, len(data)), data

    frame = encode_requests([act()])
    half = in_memory(frame[: len(frame) // 2])
    situations = _episode_steps(say, connect, polled=True) | {
        "wrong key": [
            [asks((WRONG_KEY.encode(),)), finishes()],
            [asks(reset(), who="b"), finishes("b")],
            [Send("c", (KEY.encode(),)), asks(reset(), who="c"), finishes("c")],
        ],
        "garbage": [asks(reset(), (b"garbage",), in_memory(b"garbage!"), act()), finishes()],
        # A message arrives as a whole, but the frame in the memory may not.
        "half a message, then close": [
            [asks(reset(), half), finishes()],
            [asks(reset(), who="b"), finishes("b")],
        ],
        "stop of the server": [asks(reset(), act()), server("stops"), finishes()],
    }
    reasons = NOT_APPLICABLE[name]
    applicable = {key: steps for key, steps in situations.items() if key not in reasons}
    return Endpoint(name, line, applicable, reasons)


def _handle(name: str) -> Endpoint:
    def say(_who: str, request: Request) -> Request:
        return request

    def connect(_who: str) -> list[Steps]:
        return []

    frame = encode_requests([act()])
    situations = _episode_steps(say, connect, polled=False) | {
        "garbage": [asks(reset(), b"garbage", act())],
        "half a message, then close": [asks(reset(), frame[: len(frame) // 2], act())],
        "stop of the server": [asks(reset(), act()), server("stops"), asks(act())],
    }
    return Endpoint(name, "handle", situations, NOT_APPLICABLE[name])


Body = Callable[[Request], tuple[str, bytes]]
"""Returns the content type and the body of a request over HTTP."""


def _http(
    name: str, body: Body, wrong: Sequence[Request], line: str = HTTP[0], **settings: Any
) -> Endpoint:
    def say(who: str, request: Request, **headers: str) -> tuple[bytes]:
        kind, data = body(request)
        if kind == CONTENT_TYPE:
            headers["accept"] = CONTENT_TYPE
        return (http("POST", f"/v1/{request.op}", data, kind, who, **headers),)

    def connect(_who: str) -> list[Steps]:
        return []

    def with_key(who: str, key: str) -> list[Steps]:
        return asks(say(who, reset(), authorization=f"Bearer {key}"), who=who)

    request = say("a", act())[0]
    half_body = len(body(act())[1]) // 2
    garbage = http("POST", "/v1/act", b"garbage", body(act())[0], "a")
    get = [(http("GET", path),) for path in ("/v1/metadata", "/healthz")]
    stopped = [asks(say("a", act())), finishes()] if line == HTTP[0] else [gets("a"), finishes()]
    situations = _episode_steps(
        say, connect, polled=line != HTTP[0], wrong=wrong, unknown=UNKNOWN_SESSIONS[:1]
    ) | {
        "metadata": [asks(*get), finishes()],
        "wrong key": [
            [with_key("a", WRONG_KEY), finishes()],
            [asks(say("b", reset()), who="b"), finishes("b")],
            [with_key("c", KEY), finishes("c")],
        ],
        "garbage": [
            [asks(say("a", reset()), (garbage,), say("a", act())), finishes()],
            [asks((NO_HTTP,), who="b"), finishes("b")],
        ],
        "half a message, then close": [
            [asks(say("a", reset())), Send("a", (request[:-half_body],)), finishes()],
            [asks(say("b", reset()), who="b"), finishes("b")],
        ],
        "stop of the server": [
            [asks(say("a", reset()), say("a", act())), server("stops")],
            stopped,
        ],
    }
    reasons = NOT_APPLICABLE[name]
    applicable = {key: steps for key, steps in situations.items() if key not in reasons}
    return Endpoint(name, line, applicable, reasons, settings)


def _frame_body(request: Request) -> tuple[str, bytes]:
    return CONTENT_TYPE, encode_requests([request])


def _document(request: Request) -> bytes:
    document: dict[str, Any] = {"request_id": request.request_id}
    if request.instruction is not None:
        document["instruction"] = request.instruction
    if request.deadline_ms is not None:
        document["deadline_ms"] = request.deadline_ms
    if request.obs is not None:
        document |= {"gripper": request.obs.gripper, "info": request.obs.info}
        document["state"] = {key: part.tolist() for key, part in request.obs.state.items()}
    return json.dumps(document).encode()


def _json_body(request: Request) -> tuple[str, bytes]:
    return "application/json", _document(request)


def _form_body(request: Request) -> tuple[str, bytes]:
    head = b'--edge\r\nContent-Disposition: form-data; name="%s"%s\r\n\r\n%s\r\n'
    parts = [head % (b"obs", b"", _document(request))]
    if request.obs is not None:
        for name, image in request.obs.cameras.items():
            file_name = f"cameras.{name}".encode()
            parts.append(head % (file_name, b'; filename="x"', png(image)))
    return "multipart/form-data; boundary=edge", b"".join([*parts, b"--edge--\r\n"])


CORE = (
    _unix("shared_memory", "shared memory"),
    _unix("plasma", "plasma"),
    _websocket("own_port", "own port", "{path}"),
    _websocket("v1_stream", "/v1/stream", "/v1/stream"),
    _handle("serve_handle"),
    _http("own_port_http", _frame_body, OTHER_SHAPES, HTTP[1]),
    _http("http_frame", _frame_body, OTHER_SHAPES),
    _http("http_form", _form_body, OTHER_SHAPES),
    # A document has no images.
    _http("http_json", _json_body, OTHER_SHAPES[1:], contract="state only"),
)
