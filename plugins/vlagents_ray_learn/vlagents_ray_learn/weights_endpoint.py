"""The endpoint for learners on other machines: new weights in the safetensors format, over a
WebSocket.

    WS   /v1/weights?mode=keep   a header, then the values in parts, each of which is acknowledged
    GET  /v1/weights             the newest version of each replica
    POST /v1/weights/sleep       no acts, and less memory, until "wake"
    POST /v1/weights/restore     the memory back, still without acts
    POST /v1/weights/wake        acts again

`vlagents_ray.serve.weights.Rest` describes the last three.

One connection is one push, which ends with it, so that all of its parts reach one replica, and no
data of a push remain if its learner dies. A learner sends the values when the header is
acknowledged, and has at most 16 parts of 1 MiB without an answer, so that no proxy on the way
buffers many. The header is checked against the policy's own weights, whose size bounds the push,
before memory is allocated. Keys need the scope "weights"; without keys, only processes of this
machine may push.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import fields
from typing import Any, Protocol

from starlette.requests import Request as HttpRequest
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from vlagents_ray.errors import (
    InvalidInput,
    MalformedMessage,
    MessageTooLarge,
    Overloaded,
    VLAgentsError,
    shown,
)
from vlagents_ray.protocol.json_messages import problem
from vlagents_ray.serve.access.api_keys import Caller, ScopeCheck, current_caller
from vlagents_ray.serve.endpoints.http_messages import deny
from vlagents_ray.serve.weights import PushOptions, Rest
from vlagents_ray.weights.safetensors import MESSAGE_BYTES, ValueSpec, ValuesReader
from vlagents_ray_learn.weight_push import PushResult

logger = logging.getLogger(__name__)

PATH = "/v1/weights"
PART = "weights"  # name of the replica's part that has these routes, as it is registered
LEAST_RATE = 2**18  # minimum average rate of a push, bytes/s, since it blocks other pushes
_SCOPE = "weights"
_DIGITS = 20  # maximum number of digits of a version's number
_TRUTH = {"true": True, "false": False}


class ReceivesWeights(Protocol):
    """The replicas of a policy, of which one receives new weights for all."""

    def read_header(self, header: bytes, options: PushOptions) -> dict[str, ValueSpec]:
        """Return the types and shapes of the announced values; raise an error if they do not fit
        the policy.
        """

    async def push_received(self, values: Mapping[str, Any], options: PushOptions) -> PushResult:
        """Make all replicas act with new weights, whose `values` are arrays by name."""

    async def rest_all(self, rest: Rest) -> None:
        """Make all replicas take a step of a rest."""

    async def versions(self) -> list[int]:
        """Return the newest version of each replica."""


def weights_routes(
    replicas: ReceivesWeights, slow_s: float, *, open_to_network: bool
) -> list[BaseRoute]:
    """Return the routes for new weights, each part of which must arrive within `slow_s`, s.

    Pushes are refused if the server is `open_to_network`, i.e. if other machines reach it without a
    key.
    """
    endpoint = _WeightsEndpoint(replicas, slow_s, open_to_network)
    return [
        Route(PATH, endpoint.show),
        Route(PATH + "/{step}", endpoint.rest, methods=["POST"]),
        WebSocketRoute(PATH, endpoint.receive),
    ]


class _WeightsEndpoint:
    def __init__(self, replicas: ReceivesWeights, slow_s: float, open_to_network: bool) -> None:
        self._replicas, self._slow_s = replicas, slow_s
        self._scopes = ScopeCheck("weights", open_to_network=open_to_network)
        self._receiving = False

    async def show(self, http: HttpRequest) -> Response:
        self._scopes.require(_SCOPE)
        return JSONResponse({"versions": await self._replicas.versions()})

    async def rest(self, http: HttpRequest) -> Response:
        """Make the replicas take the step of a rest that the path names."""
        self._scopes.require(_SCOPE)
        rest = _rest(http.path_params["step"], http.query_params)
        caller = current_caller()
        if isinstance(caller, Caller):
            caller.note("the policy's rest:", rest.step)
        await self._replicas.rest_all(rest)
        return JSONResponse({})

    async def receive(self, socket: WebSocket) -> None:
        """Receive one push, and answer with its version or with the error."""
        try:
            self._scopes.require(_SCOPE)
        except VLAgentsError as error:
            await deny(socket, error)
            return

        await socket.accept()
        try:
            answer = await self._receive_push(socket)
        except WebSocketDisconnect:
            logger.info(
                "a push of weights ended before all of them had arrived; nothing was changed"
            )
            return
        except VLAgentsError as error:
            answer = problem(error)
        except Exception:
            logger.exception("a push of weights failed")
            answer = problem(VLAgentsError("internal error; the server's log has the details"))

        with suppress(WebSocketDisconnect, RuntimeError):  # the learner has disconnected
            await socket.send_text(json.dumps(answer))
            await socket.close()

    async def _receive_push(self, socket: WebSocket) -> dict[str, Any]:
        """Receive the weights of a push, make the replicas act with them, and return the answer."""
        if self._receiving:
            raise Overloaded("weights: another push is under way here; push again when it is over")
        self._receiving = True
        try:
            options = _options(socket.query_params)
            caller = current_caller()
            header = await self._message(socket)
            if isinstance(caller, Caller):
                caller.admit()  # a push counts as one request
                caller.note("pushes weights:", f"mode {options.mode}")
            specs = await asyncio.to_thread(self._replicas.read_header, header, options)
            reader = ValuesReader(specs)

            begun = time.monotonic()
            while reader.received < reader.size:
                await socket.send_text(json.dumps({"received": reader.received}))
                reader.add(await self._message(socket))
                elapsed_s = time.monotonic() - begun
                if elapsed_s > self._slow_s + reader.received / LEAST_RATE:
                    raise MalformedMessage(
                        f"weights: got {reader.received} bytes in {elapsed_s:.0f} s, want at least "
                        f"{LEAST_RATE} a second; another push may wait"
                    )

            # When all values have arrived, the push does not depend on the learner's connection.
            pushed = await asyncio.shield(self._replicas.push_received(reader.values(), options))
            return {
                "version": pushed.version,
                "fingerprint": pushed.fingerprint,
                "replicas": len(pushed.replicas),
            }
        finally:
            self._receiving = False

    async def _message(self, socket: WebSocket) -> bytes:
        """Return the next message: the header, or a part of the values."""
        try:
            message = await asyncio.wait_for(socket.receive(), self._slow_s)
        except asyncio.TimeoutError:
            raise MalformedMessage(
                f"weights: no part within {self._slow_s:g} s; is the connection that slow?"
            ) from None
        if message["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(message["code"])

        self._scopes.require(_SCOPE)
        data: bytes | None = message.get("bytes")
        if data is None:
            raise MalformedMessage("weights: got a text message, want a binary one")
        if len(data) > MESSAGE_BYTES:
            raise MessageTooLarge(
                f"weights: got a part of {len(data)} bytes, the limit is {MESSAGE_BYTES}"
            )
        if not data:
            raise MalformedMessage(
                "weights: got an empty message, want a header or a part of the values"
            )
        return data


def _rest(step: Any, query: Mapping[str, str]) -> Rest:
    """Return a step of a rest, with the options in the query of its URL, such as
    `offload=false&at_most_s=60`.
    """
    parsers: dict[str, Callable[[str], Any]] = {"offload": _TRUTH.__getitem__, "at_most_s": float}
    try:
        options = {name: parsers[name](value) for name, value in query.items()}
        return Rest(step, **options)
    except (KeyError, ValueError) as error:
        raise InvalidInput(
            f"rest: got {step[:20]!r}, {shown(dict(query), 99)}, want sleep, restore or wake, "
            "offload=true or false, and at_most_s=SECONDS"
        ) from error


def _options(query: Mapping[str, str]) -> PushOptions:
    """Return the options of a push from the query of its URL, such as `mode=keep&partial=true`."""
    known = {field.name for field in fields(PushOptions)}
    options: dict[str, Any] = {}
    for name, value in query.items():
        if name not in known:
            raise InvalidInput(
                f"weights: got the option {name[:40]!r}, want mode, partial, allow_same, pin or "
                "version"
            )
        if name == "mode":
            options[name] = value
        elif name == "version" and value.isdecimal() and len(value) <= _DIGITS:
            options[name] = int(value)
        elif name != "version" and value in _TRUTH:
            options[name] = _TRUTH[value]
        else:
            want = "a number" if name == "version" else "true or false"
            raise InvalidInput(f"weights: {name}: got {value[:40]!r}, want {want}")
    return PushOptions(**options)
