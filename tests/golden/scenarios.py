"""The notation of scenarios, and their encoding by the clients of each endpoint."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from tests.golden.traces import Step, Trace
from vlagents_ray.protocol.compact import CompactWriter
from vlagents_ray.protocol.frames import CONTENT_TYPE, encode_requests
from vlagents_ray.protocol.messages import LocalAddress, PlasmaAddress, Request

STREAMS = ("own port", "/v1/stream")
FRAMES = (*STREAMS, "handle")
LOCAL = ("shared memory", "plasma")
HTTP = ("http", "own port, http")
EVERYWHERE = (*FRAMES, *HTTP, *LOCAL)
TOGETHER = EVERYWHERE[:-1]  # plasma receives the same frames as shared memory

ScenarioMessage = Request | list[Request] | bytes | tuple[bytes, ...]
"""One or several requests; or a frame that no encoder writes; or all bytes to send, with the data
outside of the message.
"""


class Send(NamedTuple):
    """Send a message."""

    who: str
    message: ScenarioMessage


Steps = Send | Step | list["Steps"]


def asks(*messages: ScenarioMessage, who: str = "a") -> list[Steps]:
    """Send messages, and receive the answer to each before the next."""
    return [step for one in messages for step in (Send(who, one), gets(who))]


def gets(who: str = "a") -> Step:
    return Step(who, "gets")


def server(what: str) -> Step:
    return Step("server", what)


def scenario(name: str, at: Sequence[str], *steps: Steps, **settings: Any) -> Iterator[Trace]:
    """Yield the messages for each of the endpoints, without answers."""
    for endpoint in at:
        encoders: dict[str, Callable[[ScenarioMessage], tuple[bytes, ...]]] = {}
        found = []
        for step in _flat(list(steps)):
            if isinstance(step, Send):
                encode = encoders.setdefault(step.who, _encoder(endpoint, step.who))
                step = Step(step.who, "sends", data=encode(step.message))  # noqa: PLW2901
            found.append(step)
        yield Trace(name, [endpoint], settings, found)


def _flat(steps: list[Steps]) -> Iterator[Send | Step]:
    for one in steps:
        if isinstance(one, list):
            yield from _flat(one)
        else:
            yield one


def http(
    method: str, path: str, body: bytes = b"", kind: str = "", session: str = "", **headers: str
) -> bytes:
    """Return an HTTP request."""
    named = {"host": "robot", "x-session-id": session, "x-request-id": "h-1", "content-type": kind}
    named |= {"content-length": str(len(body))} if body or method == "POST" else {}
    named |= {key.replace("_", "-"): value for key, value in headers.items()}
    lines = [
        f"{method} {path} HTTP/1.1",
        *(f"{key}: {value}" for key, value in named.items() if value),
        "",
        "",
    ]
    return "\r\n".join(lines).encode() + body


def _encoder(endpoint: str, who: str) -> Callable[[ScenarioMessage], tuple[bytes, ...]]:
    """Return the function that encodes messages like the transports of `vlagents_ray.client`."""
    writer, sent = CompactWriter(), iter(range(1000))

    def encode(message: ScenarioMessage) -> tuple[bytes, ...]:
        if isinstance(message, tuple):
            return message
        requests = [message] if isinstance(message, Request) else message
        frame = requests if isinstance(requests, bytes) else encode_requests(requests)
        if endpoint in HTTP:
            op = "act" if isinstance(requests, bytes) else requests[0].op
            return (http("POST", f"/v1/{op}", frame, CONTENT_TYPE, who, accept=CONTENT_TYPE),)
        if endpoint not in LOCAL:
            return (frame,)
        arrays = None if isinstance(requests, bytes) else writer.write(requests)
        memory = frame if arrays is None else b"".join(map(bytes, arrays.parts()))
        flags, text = (0, b"") if arrays is None else (LocalAddress.COMPACT, arrays.message)
        if endpoint == "plasma":
            return PlasmaAddress.REQUEST.pack(who.encode().ljust(28, b"."), flags) + text, memory
        return LocalAddress.REQUEST.pack(
            next(sent) % LocalAddress.FILES, flags, len(memory)
        ) + text, memory

    return encode
