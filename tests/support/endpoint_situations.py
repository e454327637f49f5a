"""The bytes of each endpoint in each situation: what a client sends, and the complete answer.

`SITUATIONS` are the rows of a table, and each `Endpoint` is a column. The answers are
recorded in tests/golden/endpoints, a file for each endpoint, in the format of tests/golden: the
recorded bytes are sent, independent of today's encoders, and everything that the server sends until
the end of the connection is compared, with the handshakes and the heads of frames.
`tests.golden.masks` zeroes values that differ in each run: random ids, times, the headers Date and
Server, and the list of free memory files.

The endpoints of the core are in `CORE` below; each plug-in defines its own endpoints. For an
endpoint whose clients have API keys, `costs` has the messages of a client with a key for each kind
in `MESSAGES`, and the number of requests that they charge to the key.
"""

from __future__ import annotations

import contextlib
import json
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from frozen_rates import freeze, requests_charged
from golden import png

from tests.golden.own_protocol import PIXELS, act, asked, reset, seen
from tests.golden.replica import EACH_BYTE, KEY, Server
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
RECORD = "python -m pytest tests/golden --record endpoints/"  # the name of the endpoint follows
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

# Kinds of messages. Only a control frame costs nothing.
MESSAGES = (
    "reset",
    "act",
    "close",
    "several requests",
    "malformed message",
    "control frame",
)
_RATE = 1000.0  # rate of the key whose charges are counted, requests/s


@dataclass(frozen=True)
class Cost:
    """Messages of the client "a", and the number of requests that they cost.

    Args:
        requests: The number of requests that are charged to the client's key.
        steps: The steps from the beginning of its connection to the answer to the last message.
    """

    requests: int
    steps: Steps


@dataclass(frozen=True)
class Endpoint:
    """One endpoint, and the steps of its clients in each situation.

    Args:
        name: The name of the recorded file, which is also part of the tests' ids.
        line: The argument of `tests.golden.replica.Server.line`.
        situations: The steps by situation.
        not_applicable: The reason for each situation that this endpoint does not have.
        settings: The settings of `tests.golden.replica.Server` in all situations.
        costs: The cost of each kind in `MESSAGES`, or the reason why the endpoint has no such
            message. Empty if the endpoint has no keys; then `not_applicable` has "wrong key".
    """

    name: str
    line: str
    situations: Mapping[str, Steps]
    not_applicable: Mapping[str, str]
    settings: Mapping[str, Any] = field(default_factory=dict)
    costs: Mapping[str, Cost | str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        described = [*self.situations, *self.not_applicable]
        if sorted(described) != sorted(SITUATIONS):
            raise ValueError(
                f"{self.name}: expected steps or a reason for each of {sorted(SITUATIONS)}, got "
                f"{sorted(described)}"
            )
        has_keys = "wrong key" in self.situations
        if sorted(self.costs) != (sorted(MESSAGES) if has_keys else []):
            raise ValueError(
                f"{self.name}: expected a cost or a reason for each of {sorted(MESSAGES)} if its "
                f"clients have keys, got {sorted(self.costs)}"
            )

    def cost(self, kind: str) -> Cost | None:
        """Return the messages of that kind and their cost; None if the endpoint has no such
        message.
        """
        cost = self.costs[kind]
        return cost if isinstance(cost, Cost) else None

    def played_cost(self, kind: str, folder: Path) -> float:
        """Send the messages of that kind to a new server; return the number of requests charged to
        the key.
        """
        cost = self.cost(kind)
        assert cost is not None
        settings = {**self.settings, "keys": True, "rate": _RATE}
        (trace,) = scenario(kind, [self.line], cost.steps, **settings)
        with pytest.MonkeyPatch.context() as patch, contextlib.ExitStack() as stack:
            freeze(patch)
            server = Server(stack, patch, folder, **settings)
            trace.played_at(server, self.line, stack)
            assert server.keys is not None
            return requests_charged(server.keys, KEY.removeprefix("vlr_"))

    def scenario(self, situation: str) -> Trace:
        """Return the messages of a situation, without their answers."""
        settings = dict(self.settings)
        if situation == "wrong key":
            settings["keys"] = True
        (trace,) = scenario(situation, [self.line], self.situations[situation], **settings)
        return trace


def cases(endpoints: Sequence[Endpoint]) -> list[tuple[Endpoint, str]]:
    """Return each endpoint with each of its situations."""
    pairs = []
    for endpoint in endpoints:
        pairs += [(endpoint, each) for each in SITUATIONS if each in endpoint.situations]
    return pairs


def costs(endpoints: Sequence[Endpoint]) -> list[Any]:
    """Return each endpoint whose clients have keys, with each kind of message that it has."""
    rows = []
    for endpoint in endpoints:
        for kind in endpoint.costs:
            if endpoint.cost(kind) is not None:
                rows.append(pytest.param(endpoint, kind, id=f"{endpoint.name}-{kind}"))
    return rows


def require_cost(endpoint: Endpoint, kind: str, folder: Path) -> None:
    """Fail unless the messages of that kind cost exactly the number in the table."""
    cost = endpoint.cost(kind)
    assert cost is not None
    assert endpoint.played_cost(kind, folder) == cost.requests


def case_ids(endpoints: Sequence[Endpoint]) -> list[str]:
    """Return the ids of the tests of `cases`."""
    return [f"{endpoint.name}-{situation}" for endpoint, situation in cases(endpoints)]


def require_recorded_answers(endpoint: Endpoint, situation: str, folder: Path) -> None:
    """Send the recorded bytes to a new server; fail if an answer differs from the recorded one."""
    recorded = {trace.name: trace for trace in read(endpoint.name, FOLDER)}
    command = f"{RECORD}{endpoint.name}"
    assert situation in recorded, f"{endpoint.name}, {situation}: not recorded; run `{command}`"

    trace = recorded[situation]
    difference = differences(trace, trace.played(endpoint.line, folder))
    assert not difference, (
        f"{endpoint.name}, {situation}:\n{difference}\n"
        f"After an intended change, `{command}` records the answers again; review that diff."
    )


def require_each_situation_recorded(endpoint: Endpoint) -> None:
    """Fail unless the recorded file has the situations of the table, in the same order."""
    recorded = [trace.name for trace in read(endpoint.name, FOLDER)]
    assert recorded == [name for name in SITUATIONS if name in endpoint.situations]


def record(endpoint: Endpoint, folder: Path) -> None:
    """Record the file of an endpoint again."""
    traces = []
    for _, situation in cases([endpoint]):
        traces.append(endpoint.scenario(situation).played(endpoint.line, folder))
    write(endpoint.name, traces, FOLDER)


# Steps that several protocols share.


def finishes(who: str = "a") -> Step:
    """Send no more, and read until the server ends the connection."""
    return Step(who, "finishes")


def handshake(path: str, key: str | None = None) -> bytes:
    """Return the handshake of a WebSocket; the path `{path}` is the path of the replica's own port."""
    authorization = "" if key is None else f"Authorization: Bearer {key}\r\n"
    return (
        f"GET {path} HTTP/1.1\r\nHost: robot\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
        f"{authorization}\r\n"
    ).encode()


PING = b"\x89\x80" + bytes(4)  # a ping from a client


def websocket_frame(payload: bytes) -> bytes:
    """Return a client's binary frame, whose mask is zero."""
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


# The endpoints of the core. Each client has one connection, which has the client's name: "a", "b".

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
"""Returns the message that the client of that name sends for a request."""
OTHER_SHAPES = (
    seen(cameras={"front": PIXELS[:4]}),
    seen(state={"joints": np.zeros(3, np.float32)}),
)
UNKNOWN_SESSIONS = (act(), act(session="another"))
# Several requests of one message. Closing a session costs nothing next to other requests.
SEVERAL = [
    *(reset(session=session) for session in ("x", "y", "z")),
    Request("close", session="x"),
]


def _episode_steps(
    say: Say,
    connect: Callable[[str], list[Steps]],
    *,
    polled: bool,
    wrong: Sequence[Request] = OTHER_SHAPES,
    unknown: Sequence[Request] = UNKNOWN_SESSIONS,
) -> dict[str, list[Steps]]:
    """Return the situations that every endpoint of this project's own protocol has.

    `polled` is whether only the policy's thread answers late requests, as soon as it is free again.
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
        # The deadline has passed before any server reads the request.
        Send("b", say("b", act(deadline_ms=0.001))),
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

    def sends(requests: int, *frames: bytes) -> Cost:
        """Return the cost of frames after the handshake with the key."""
        return Cost(requests, [connect("a", KEY), asks(*((each,) for each in frames))])

    first = say("a", reset())[0]
    several = websocket_frame(encode_requests(SEVERAL))
    costs: dict[str, Cost | str] = {
        "reset": sends(1, first),
        "act": sends(2, first, say("a", act())[0]),
        "close": sends(2, first, say("a", Request("close"))[0]),
        "several requests": sends(3, several),
        "malformed message": sends(1, websocket_frame(b"garbage")),
        "control frame": sends(0, PING),
    }
    endpoint_line = line + EACH_BYTE
    return Endpoint(name, endpoint_line, situations, NOT_APPLICABLE[name], costs=costs)


def _unix(name: str, line: str) -> Endpoint:
    def say(_who: str, request: Request) -> Request:
        return request

    def connect(_who: str) -> list[Steps]:
        return []

    def in_memory(data: bytes) -> tuple[bytes, bytes]:
        """Return a message about a frame that no encoder would write."""
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
        # A message always arrives complete, but the frame in the memory may be incomplete.
        "half a message, then close": [
            [asks(reset(), half), finishes()],
            [asks(reset(), who="b"), finishes("b")],
        ],
        "stop of the server": [asks(reset(), act()), server("stops"), finishes()],
    }
    reasons = NOT_APPLICABLE[name]
    applicable = {key: steps for key, steps in situations.items() if key not in reasons}
    if "wrong key" in reasons:
        return Endpoint(name, line, applicable, reasons)

    def sends(requests: int, *messages: ScenarioMessage) -> Cost:
        """Return the cost of messages after the key."""
        return Cost(requests, [Send("a", (KEY.encode(),)), asks(*messages)])

    costs: dict[str, Cost | str] = {
        "reset": sends(1, reset()),
        "act": sends(2, reset(), act()),
        "close": sends(2, reset(), Request("close")),
        "several requests": sends(6, SEVERAL, in_memory(encode_requests(SEVERAL))),
        "malformed message": sends(2, (b"garbage",), in_memory(b"garbage!")),
        "control frame": "its messages have no control frames",
    }
    return Endpoint(name, line, applicable, reasons, costs=costs)


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
"""Returns the content type and the body of an HTTP request."""


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

    def sends(requests: int, *messages: Request) -> Cost:
        """Return the cost of requests with the key."""
        posts = [say("a", message, authorization=f"Bearer {KEY}") for message in messages]
        return Cost(requests, asks(*posts))

    def post(op: str, kind: str, data: bytes) -> tuple[bytes]:
        return (http("POST", f"/v1/{op}", data, kind, "a", authorization=f"Bearer {KEY}"),)

    several: Cost | str = "a document or a form is one request"
    if body is _frame_body:
        frame = encode_requests([reset(session=session) for session in "bcd"])
        several = Cost(3, asks(post("reset", CONTENT_TYPE, frame)))
    costs: dict[str, Cost | str] = {
        "reset": sends(1, reset()),
        "act": sends(2, reset(), act()),
        "close": Cost(1, asks(post("close", "", b""))),
        "several requests": several,
        "malformed message": Cost(1, asks(post("act", body(act())[0], b"garbage"))),
        "control frame": "HTTP/1.1 has none",
    }
    reasons = NOT_APPLICABLE[name]
    applicable = {key: steps for key, steps in situations.items() if key not in reasons}
    return Endpoint(name, line, applicable, reasons, settings, costs)


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
    # A JSON document has no images.
    _http("http_json", _json_body, OTHER_SHAPES[1:], contract="state only"),
)
