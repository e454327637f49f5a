"""The endpoint for learners on other machines, which send new weights as safetensors.

    WS   /v1/weights?mode=keep   push a header, then the values in parts; each part is acknowledged
    GET  /v1/weights             return the newest version of each replica
    POST /v1/weights/sleep       stop acting, and free memory, until "wake"
    POST /v1/weights/restore     allocate the memory again, still without acting
    POST /v1/weights/wake        act again

`vlagents_ray.serve.weights.Rest` describes the last three.

A connection is one push, and the push ends with the connection. Therefore, all parts of a push
reach one replica, and no data of a push remain if its learner dies. A learner sends the values
after the header is acknowledged. At most 16 parts, 1 MiB each, are unacknowledged, so that no proxy
on the path buffers many parts. The header is checked against the policy's weights before memory is
allocated, so that the size of these weights bounds the push. Keys need the scope "weights". Without
keys, only processes of this machine may push.
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
from vlagents_ray.serve.access.charges import Account
from vlagents_ray.serve.endpoints.http_messages import deny
from vlagents_ray.serve.weights import PushOptions, Rest
from vlagents_ray.weights.safetensors import MESSAGE_BYTES, ValueSpec, ValuesReader
from vlagents_ray_learn.weight_push import PushResult

logger = logging.getLogger(__name__)

PATH = "/v1/weights"
PART = "weights"  # registered name of the replica's part that has these routes
LEAST_RATE = 2**18  # minimum average rate of a push, bytes/s, since it blocks other pushes
_SCOPE = "weights"
_DIGITS = 20  # maximum number of digits of a version's number
_BOOLEANS = {"true": True, "false": False}  # values in the query of a URL


class ReceivesWeights(Protocol):
    """The replicas of a policy, one of which receives new weights for all of them."""

    def read_header(self, header: bytes, options: PushOptions) -> dict[str, ValueSpec]:
        """Return the types and shapes of the announced values.

        Raises:
            InvalidWeights: The values do not fit the policy.
        """

    async def push_received(self, values: Mapping[str, Any], options: PushOptions) -> PushResult:
        """Make all replicas use new weights. `values` contains arrays by name."""

    async def rest_all(self, rest: Rest) -> None:
        """Make all replicas sleep, restore their memory, or wake."""

    async def versions(self) -> list[int]:
        """Return the newest version of each replica."""


def weights_routes(
    replicas: ReceivesWeights, slow_s: float, *, open_to_network: bool
) -> list[BaseRoute]:
    """Return the routes for new weights.

    Args:
        replicas: Receives the weights.
        slow_s: The maximum time until the next part of a push arrives, s.
        open_to_network: Whether other machines can reach the server without a key. In this case,
            pushes are rejected.
    """
    endpoint = _WeightsEndpoint(replicas, slow_s, open_to_network)
    return [
        Route(PATH, endpoint.show),
        Route(PATH + "/{step}", endpoint.rest, methods=["POST"]),
        WebSocketRoute(PATH, endpoint.receive),
    ]


class _WeightsEndpoint:
    """The handlers of the routes. At most one push is received at a time."""

    def __init__(self, replicas: ReceivesWeights, slow_s: float, open_to_network: bool) -> None:
        self._replicas, self._slow_s = replicas, slow_s
        self._scopes = ScopeCheck("weights", open_to_network=open_to_network)
        self._receiving = False

    async def show(self, http: HttpRequest) -> Response:
        """Return the newest version of each replica."""
        self._scopes.require(_SCOPE)
        return JSONResponse({"versions": await self._replicas.versions()})

    async def rest(self, http: HttpRequest) -> Response:
        """Make the replicas sleep, restore their memory, or wake, depending on the path."""
        self._scopes.require(_SCOPE)
        rest = _read_rest(http.path_params["step"], http.query_params)
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

        with suppress(WebSocketDisconnect, RuntimeError):  # The learner has disconnected.
            await socket.send_text(json.dumps(answer))
            await socket.close()

    async def _receive_push(self, socket: WebSocket) -> dict[str, Any]:
        """Receive the weights of a push, make the replicas use them, and return the answer."""
        if self._receiving:
            raise Overloaded(
                "weights: another push is in progress here; push again when it has ended"
            )
        self._receiving = True
        try:
            options = _read_options(socket.query_params)
            caller = current_caller()
            header = await self._receive_message(socket)
            Account(caller).charge().require()  # a push counts as one request
            if isinstance(caller, Caller):
                caller.note("pushes weights:", f"mode {options.mode}")
            specs = await asyncio.to_thread(self._replicas.read_header, header, options)
            reader = ValuesReader(specs)

            begun = time.monotonic()
            while reader.received < reader.size:
                await socket.send_text(json.dumps({"received": reader.received}))
                reader.add(await self._receive_message(socket))
                elapsed_s = time.monotonic() - begun
                if elapsed_s > self._slow_s + reader.received / LEAST_RATE:
                    raise MalformedMessage(
                        f"weights: expected at least {LEAST_RATE} bytes a second, as another push "
                        f"may wait, got {reader.received} in {elapsed_s:.0f} s"
                    )

            # All values have arrived, so the push no longer depends on the learner's connection.
            pushed = await asyncio.shield(self._replicas.push_received(reader.values(), options))
            return {
                "version": pushed.version,
                "fingerprint": pushed.fingerprint,
                "replicas": len(pushed.replicas),
            }
        finally:
            self._receiving = False

    async def _receive_message(self, socket: WebSocket) -> bytes:
        """Return the next message: the header, or a part of the values.

        Raises:
            MalformedMessage: No message arrives in time, or the message is empty or a text.
            MessageTooLarge: The message is too long.
            WebSocketDisconnect: The learner has disconnected.
        """
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
            raise MalformedMessage("weights: expected a binary message, got text")
        if len(data) > MESSAGE_BYTES:
            raise MessageTooLarge(
                f"weights: expected a part of at most {MESSAGE_BYTES} bytes, got {len(data)}"
            )
        if not data:
            raise MalformedMessage(
                "weights: expected a header or a part of the values, got an empty message"
            )
        return data


def _read_rest(step: Any, query: Mapping[str, str]) -> Rest:
    """Return the requested step: sleeping, restoring memory or waking.

    Args:
        step: "sleep", "restore" or "wake".
        query: The options in the query of the URL, such as `offload=false&at_most_s=60`.

    Raises:
        InvalidInput: The step is unknown, or an option is wrong.
    """
    parsers: dict[str, Callable[[str], Any]] = {
        "offload": _BOOLEANS.__getitem__,
        "at_most_s": float,
    }
    try:
        options = {name: parsers[name](value) for name, value in query.items()}
        return Rest(step, **options)
    except (KeyError, ValueError) as error:
        raise InvalidInput(
            "weights: expected the step sleep, restore or wake, offload=true or false, and "
            f"at_most_s=SECONDS, got {step[:20]!r}, {shown(dict(query), 99)}"
        ) from error


def _read_options(query: Mapping[str, str]) -> PushOptions:
    """Return the options of a push from the query of its URL, such as `mode=keep&partial=true`.

    Raises:
        InvalidInput: An option is unknown, or its value is wrong.
    """
    option_names = {field.name for field in fields(PushOptions)}
    options: dict[str, Any] = {}
    for name, value in query.items():
        if name not in option_names:
            raise InvalidInput(
                "weights: expected the options mode, partial, allow_same, pin or version, got "
                f"{name[:40]!r}"
            )
        if name == "mode":
            options[name] = value
        elif name == "version" and value.isdecimal() and len(value) <= _DIGITS:
            options[name] = int(value)
        elif name != "version" and value in _BOOLEANS:
            options[name] = _BOOLEANS[value]
        else:
            expected = "a number" if name == "version" else "true or false"
            raise InvalidInput(f"weights: {name}: expected {expected}, got {value[:40]!r}")
    return PushOptions(**options)
