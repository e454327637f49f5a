"""The live page, and the WebSocket that delivers its data.

    GET  /live             the page, which contains no data and needs no key
    GET  /v1/live          the current data of the replicas, as JSON without pictures; keys need the
                           scope "watch"
    WS   /v1/live          the same data with pictures, at most ten times a second
    POST /v1/live/command  a command, {"session": …, "do": "pause"}, see `CommandBoard.press`; keys
                           need the scope "operate"

A process that is not a replica, such as the driver of an evaluation, serves them with
`page_server`. Its page has no commands, but videos:

    GET  /v1/live/videos/7  a video to which the document refers by its number

The viewer requests each message, and lists the sessions whose pictures it shows: {"shown":
["arm-1", …]}. A slow viewer therefore misses old messages, and does not delay other viewers. The
answer consists of the length of a JSON document (32 bits, little-endian), the document, and the
files to which it refers by their index in `files`, the list of their lengths.

A page in a browser cannot set a header, so it sends its key among the subprotocols of the
WebSocket, as "vlagents.key.KEY".
"""

from __future__ import annotations

import asyncio
import json
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.resources import files as package_files
from pathlib import Path
from typing import Any

import uvicorn
from pydantic import BaseModel, ValidationError
from starlette.applications import Starlette
from starlette.requests import ClientDisconnect
from starlette.requests import Request as HttpRequest
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from vlagents_ray.errors import (
    ConfigError,
    MalformedMessage,
    MessageTooLarge,
    Overloaded,
    VLAgentsError,
)
from vlagents_ray.page_protocol import BACKLOG, PageListener, PageProtocol
from vlagents_ray.protocol.json_messages import problem
from vlagents_ray.serve.access.api_keys import (
    Caller,
    Keys,
    ScopeCheck,
    caller_name,
    current_caller,
    require_watch_keys,
)
from vlagents_ray.serve.access.audit import log_pressed
from vlagents_ray.serve.access.origin_check import require_same_origin
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.front import FrontMiddleware
from vlagents_ray.serve.endpoints.http_messages import answer_error, deny, html_response
from vlagents_ray_live.live_view import Fleet

PAGE = "/live"
PATH = "/v1/live"
_PROTOCOL = "vlagents.live"
_COMMAND = f"{PATH}/command"
_WATCH, _OPERATE = "watch", "operate"  # scopes of keys
_COMMAND_BYTES = 2**14  # maximum size of a command
_VIEWERS = 32  # maximum number of viewers
_SILENT_S = 30.0  # maximum time between two requests of a viewer
_SCRIPTS = ("evaluation.js", "live.js")
_CHARACTERS = 2**16  # maximum length of a viewer's message
_POLICY_VIOLATION = 1008  # a close code of WebSocket
_LAST_S = 0.5  # the time for viewers to receive the end of an evaluation, s
_END_S = 1  # the time limit for the connections of viewers to close, s
_LEAVE_S = 5.0  # the time limit for the whole shutdown, s

# A function that returns the file of the video with a number; None if there is no such video.
VideoFiles = Callable[[int], Path | None]


def live_routes(
    fleet: Fleet, *, open_to_network: bool, videos: VideoFiles | None = None
) -> list[BaseRoute]:
    """Return the routes of the live page.

    Args:
        fleet: The data of the page.
        open_to_network: Whether other machines reach this server without a key. In that case
            viewers are rejected, since the pictures of all robots would be public.
        videos: Finds the videos to which the document of an evaluation refers; None for the server
            of a policy.
    """
    endpoint = _LiveEndpoint(fleet, open_to_network, videos)
    routes: list[BaseRoute] = [
        Route(PAGE, _page),
        Route(PATH, endpoint.show),
        WebSocketRoute(PATH, endpoint.watch),
    ]
    if videos is None:
        return [*routes, Route(_COMMAND, endpoint.press, methods=["POST"])]
    return [*routes, Route(f"{PATH}/videos/{{number:int}}", endpoint.video)]


class _LiveEndpoint:
    """The handlers of the routes of the live page."""

    def __init__(self, fleet: Fleet, open_to_network: bool, videos: VideoFiles | None) -> None:
        self._fleet = fleet
        self._scopes = ScopeCheck("live", open_to_network=open_to_network)
        self._videos = videos
        self._watching = 0  # the number of viewers

    async def show(self, http: HttpRequest) -> Response:
        """Return the current data as JSON, without pictures."""
        self._require_watch(http)
        with self._fleet.viewer() as viewer:
            document, _ = await viewer.next()
        return JSONResponse(document)

    async def video(self, http: HttpRequest) -> Response:
        """Return a video of the evaluation."""
        self._require_watch(http)
        path = None if self._videos is None else self._videos(http.path_params["number"])
        if path is None:
            return Response(status_code=404)
        return FileResponse(path, media_type="video/mp4")

    def _require_watch(self, http: HttpRequest) -> None:
        """Raise an error unless the caller may see the sessions."""
        require_same_origin(http.headers)
        self._scopes.require(_WATCH)

    async def press(self, http: HttpRequest) -> Response:
        """Give a command to a session, and return its description."""
        self._scopes.require(_OPERATE)
        by = caller_name()
        try:
            command = await _command(http)
        except ClientDisconnect:
            return Response(status_code=499)
        pressed = await self._fleet.press(command.session, command.do, by, command.episode)
        log_pressed(by, f"{command.do!r} for session {command.session!r}")
        return JSONResponse(pressed)

    async def watch(self, socket: WebSocket) -> None:
        """Send the data with pictures to a viewer, until it disconnects."""
        subprotocols = socket.scope.get("subprotocols") or []
        try:
            self._scopes.require(_WATCH)
            if self._watching >= _VIEWERS:
                raise Overloaded(f"live: {_VIEWERS} viewers already watch; close one of them")
        except VLAgentsError as error:
            await deny(socket, error)
            return

        await socket.accept(_PROTOCOL if _PROTOCOL in subprotocols else None)
        caller = current_caller()
        if isinstance(caller, Caller):
            caller.note("watches", "the sessions")

        self._watching += 1
        try:
            with self._fleet.viewer() as viewer:
                while True:
                    viewer.shown = frozenset(await self._next_shown(socket))
                    document, files = await viewer.next()
                    self._scopes.require(_WATCH)
                    may_operate = self._videos is None and self._scopes.may(_OPERATE)
                    message = _message({**document, "may_operate": may_operate}, files)
                    await socket.send_bytes(message)
        except WebSocketDisconnect:
            return
        except VLAgentsError as error:
            with suppress(WebSocketDisconnect, RuntimeError):  # the viewer has disconnected
                await socket.send_text(json.dumps(problem(error)))
                await socket.close(_POLICY_VIOLATION)
        finally:
            self._watching -= 1

    async def _next_shown(self, socket: WebSocket) -> list[str]:
        """Wait for a viewer's request, and return the sessions whose pictures it shows."""
        try:
            message = await asyncio.wait_for(socket.receive(), _SILENT_S)
        except asyncio.TimeoutError:
            raise MalformedMessage(
                f"live: expected a request within {_SILENT_S:g} s; watch again"
            ) from None
        if message["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(message["code"])

        text = message.get("text") or (message.get("bytes") or b"").decode(errors="replace")
        try:
            return _ViewerRequest.model_validate_json(text[:_CHARACTERS]).shown
        except ValidationError as error:
            raise MalformedMessage(
                f'live: expected {{"shown": ["SESSION", ...]}}, got {text[:80]!r}'
            ) from error


class _ViewerRequest(BaseModel):
    """A viewer's request for the next message."""

    shown: list[str]  # ids of the sessions whose pictures the viewer shows


class _Command(BaseModel):
    """The body of a command."""

    session: str
    do: str
    # The episode that a mark ends, as in the session's data; default: the running episode.
    episode: str | None = None


async def _command(http: HttpRequest) -> _Command:
    """Return the command in a body; a body that is too long is not read completely."""
    header = http.headers.get("content-type", "")
    content_type = header.partition(";")[0].strip().lower()
    # The page of another site cannot send this type without the server's permission.
    if content_type != "application/json":
        raise MalformedMessage(
            f"content-type: expected application/json, got {content_type or 'none'!r}"
        )

    body = b""
    async for data in http.stream():
        body += data
        if len(body) > _COMMAND_BYTES:
            raise MessageTooLarge(f"live: a command of more than {_COMMAND_BYTES} bytes")
    try:
        return _Command.model_validate_json(body)
    except ValidationError as error:
        raise MalformedMessage(
            f'live: expected {{"session": ..., "do": ...}}, got {body[:80]!r}'
        ) from error


def _message(document: dict[str, Any], files: list[bytes]) -> bytes:
    """Return a message of the WebSocket: the document with the lengths of the files, and the
    files.
    """
    document = {**document, "files": [len(file) for file in files]}
    data = json.dumps(document, allow_nan=False, separators=(",", ":")).encode()
    return b"".join([struct.pack("<I", len(data)), data, *files])


async def _page(_: HttpRequest) -> Response:
    """Return the page."""
    html, style, *scripts = live_page()
    more = "connect-src 'self'; img-src blob: data:; media-src blob:"
    return html_response(html, styles=[style], scripts=scripts, more=more)


@cache
def live_page() -> list[str]:
    """Return the page with its style and scripts included, then the style, then the scripts."""
    folder = package_files(__package__) / "page"
    html = folder.joinpath("live.html").read_text(encoding="utf-8")
    included: list[str] = []
    for name in ("live.css", *_SCRIPTS):
        text = folder.joinpath(name).read_text(encoding="utf-8")
        html = html.replace(f"/* {name} */", text)
        included.append(text)
    return [html, *included]


@contextmanager
def page_server(
    fleet: Fleet, address: tuple[str, int], keys: Keys | None, *, name: str, videos: VideoFiles
) -> Iterator[str]:
    """Serve the live page of an evaluation on a thread within the context.

    Args:
        fleet: The data of the page.
        address: The host and the port on which the server listens; port 0 selects a free one.
        keys: The accepted keys; None, which only loopback allows, admits all clients.
        name: The application of the page, for keys that are limited to applications.
        videos: Finds the videos to which the document refers.

    Yields:
        The URL of the page.

    Raises:
        ConfigError: Other machines would reach the page without a key, or the address is in use.
    """
    host, port = address
    require_watch_keys(host, keys)
    try:
        listening = PageListener.bound(host, port)
    except OSError as error:
        raise ConfigError(
            f"live page: cannot listen on {host}:{port} ({error.strerror}); choose another port"
        ) from error

    routes = live_routes(fleet, open_to_network=False, videos=videos)
    inner_app = Starlette(routes=routes, exception_handlers={VLAgentsError: answer_error})
    app = FrontMiddleware(AccessMiddleware(inner_app, keys, name, public=[PAGE]))
    config = uvicorn.Config(
        app,
        log_config=None,
        lifespan="off",
        http=PageProtocol,
        ws="websockets-sansio",
        ws_per_message_deflate=False,
        backlog=BACKLOG,
        timeout_graceful_shutdown=_END_S,
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(
        target=lambda: asyncio.run(server.serve([listening])), name="live-page", daemon=True
    )
    thread.start()
    try:
        url_host = f"[{host}]" if ":" in host else host
        yield f"http://{url_host}:{listening.getsockname()[1]}{PAGE}"
    finally:
        if fleet.viewers:
            time.sleep(_LAST_S)
        server.should_exit = True
        thread.join(_LEAVE_S)  # the thread may be waiting for a lost Ray cluster
