"""The live page, and the WebSocket that feeds it.

    GET /live      the page: it holds no data, and needs no key
    GET /v1/live   what the replicas do now, as JSON without pictures; keys need the scope "watch"
    WS  /v1/live   the same with pictures, at most ten times a second
    POST /v1/live/command   {"session": …, "do": "pause"}: see `CommandBoard.press`; keys need the scope "operate"
    WS  /v1/live/control, /v1/live/robot    a human moves a robot: see `vlagents_ray.serve.live.remote.endpoint`
    GET /v1/live/videos/7   a video to which the document refers by its number, where an evaluation is watched

The viewer asks for each message, with the sessions whose pictures it shows: {"shown": ["arm-1", …]}. So a slow viewer
misses what is old, and delays nobody. The answer is the length of a JSON document (32 bits, little-endian), the
document, and the files to which it refers by their index in `files`, the list of their lengths.

A page in a browser cannot set a header: it states its key among the WebSocket's subprotocols, as "vlagents.key.KEY".
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import json
import logging
import struct
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from importlib.resources import files as package_files
from pathlib import Path
from typing import Any

from starlette.requests import ClientDisconnect
from starlette.requests import Request as HttpRequest
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from vlagents_ray.errors import MalformedMessage, MessageTooLarge, Overloaded, VLAgentsError
from vlagents_ray.protocol.json_messages import problem
from vlagents_ray.serve.access.api_keys import Caller, current_caller
from vlagents_ray.serve.access.audit import log_pressed
from vlagents_ray.serve.access.scope_check import ScopeCheck, caller_name
from vlagents_ray.serve.endpoints.access_middleware import LIVE_PAGE
from vlagents_ray.serve.endpoints.http_messages import deny, problem_response, request_id
from vlagents_ray.serve.live.fleet import Fleet, Viewer
from vlagents_ray.serve.live.remote.endpoint import remote_routes

logger = logging.getLogger(__name__)

PATH = "/v1/live"
_PROTOCOL = "vlagents.live"
_COMMAND = f"{PATH}/command"
_WATCH, _OPERATE = "watch", "operate"  # scopes of keys
_COMMAND_BYTES = 2**14  # longest command
_VIEWERS = 32  # most viewers at once
_SILENT_S = 30.0  # longest time between two messages of a viewer
_SCRIPTS = ("evaluation.js", "takeover.js", "live.js")
_CHARACTERS = 2**16  # longest message of a viewer
_POLICY_VIOLATION, _TRY_AGAIN_LATER = 1008, 1013  # WebSocket close codes

VideoFiles = Callable[[int], Path | None]
"""Returns the file of the video with a number; None if there is none."""


def live_routes(fleet: Fleet, *, open_to_network: bool, videos: VideoFiles | None = None) -> list[BaseRoute]:
    """Return the routes of the live page.

    Args:
        fleet: Gathers what the page shows.
        open_to_network: Whether other machines reach this server without a key; nobody may then watch, as the pictures
            of all robots would be public.
        videos: Finds the videos to which the document refers, if it does.
    """
    endpoint = _LiveEndpoint(fleet, open_to_network, videos)
    routes: list[BaseRoute] = [
        Route(LIVE_PAGE, _page),
        Route(PATH, endpoint.show),
        WebSocketRoute(PATH, endpoint.watch),
        Route(_COMMAND, endpoint.press, methods=["POST"]),
    ]
    routes += remote_routes(fleet, open_to_network=open_to_network)
    return routes if videos is None else [*routes, Route(f"{PATH}/videos/{{number:int}}", endpoint.video)]


class _LiveEndpoint:
    def __init__(self, fleet: Fleet, open_to_network: bool, videos: VideoFiles | None) -> None:
        self._fleet = fleet
        self._scopes = ScopeCheck("live", open_to_network=open_to_network)
        self._videos = videos
        self._watching = 0

    async def show(self, http: HttpRequest) -> Response:
        try:
            self._scopes.require(_WATCH)
        except VLAgentsError as error:
            return problem_response(error, request_id(http))
        viewer = self._fleet.add()
        try:
            document, _ = await viewer.next()
            return JSONResponse(document)
        finally:
            self._fleet.remove(viewer)

    async def video(self, http: HttpRequest) -> Response:
        try:
            self._scopes.require(_WATCH)
        except VLAgentsError as error:
            return problem_response(error, request_id(http))
        path = None if self._videos is None else self._videos(http.path_params["number"])
        return Response(status_code=404) if path is None else FileResponse(path, media_type="video/mp4")

    async def press(self, http: HttpRequest) -> Response:
        try:
            self._scopes.require(_OPERATE)
            session, do, text = _command(await _body(http))
            by = caller_name()
            pressed = await self._fleet.press(session, do, text, by)
        except ClientDisconnect:
            return Response(status_code=499)
        except VLAgentsError as error:
            return problem_response(error, request_id(http))
        log_pressed(by, f"{do!r} {text!r} for session {session!r}" if text else f"{do!r} for session {session!r}")
        return JSONResponse(pressed)

    async def watch(self, socket: WebSocket) -> None:
        offered = socket.scope.get("subprotocols") or []
        try:
            self._scopes.require(_WATCH)
            if self._watching >= _VIEWERS:
                raise Overloaded(f"live: {_VIEWERS} viewers watch already; close one")
        except VLAgentsError as error:
            await deny(socket, error)
            return
        await socket.accept(_PROTOCOL if _PROTOCOL in offered else None)
        caller = current_caller()
        if isinstance(caller, Caller):
            caller.note("watches", "the sessions")
        viewer = self._fleet.add()
        self._watching += 1
        try:
            await self._feed(socket, viewer)
        except WebSocketDisconnect:
            return
        except VLAgentsError as error:
            with suppress(WebSocketDisconnect, RuntimeError):  # the viewer has gone meanwhile
                await socket.send_text(json.dumps(problem(error)))
                await socket.close(_POLICY_VIOLATION)
        finally:
            self._watching -= 1
            self._fleet.remove(viewer)

    async def _feed(self, socket: WebSocket, viewer: Viewer) -> None:
        while True:
            viewer.shown = frozenset(await self._asked(socket))
            document, files = await viewer.next()
            self._scopes.require(_WATCH)
            await socket.send_bytes(_message({**document, "may_operate": self._scopes.may(_OPERATE)}, files))

    async def _asked(self, socket: WebSocket) -> list[str]:
        try:
            message = await asyncio.wait_for(socket.receive(), _SILENT_S)
        except asyncio.TimeoutError:
            raise MalformedMessage(f"live: asked for nothing within {_SILENT_S:g} s; watch again") from None
        if message["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(message["code"])
        text = message.get("text") or (message.get("bytes") or b"").decode(errors="replace")
        try:
            shown = json.loads(text[:_CHARACTERS])["shown"]
            if not all(isinstance(name, str) for name in shown):
                raise TypeError
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise MalformedMessage(f'live: got {text[:80]!r}, want {{"shown": ["SESSION", ...]}}') from error
        return list(shown)


async def _body(http: HttpRequest) -> bytes:
    """Return the body of a command; of a longer one no more is read."""
    kind = http.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":  # which no other site's page can send unasked
        raise MalformedMessage(f"content-type: got {kind or 'none'!r}, want application/json")
    parts = b""
    async for part in http.stream():
        parts += part
        if len(parts) > _COMMAND_BYTES:
            raise MessageTooLarge(f"live: a command of more than {_COMMAND_BYTES} bytes")
    return parts


def _command(body: bytes) -> tuple[str, str, str]:
    """Return session, command and text in a body."""
    try:
        stated = json.loads(body)
        found = stated["session"], stated["do"], stated.get("text", "")
        if not all(isinstance(one, str) for one in found):
            raise TypeError
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise MalformedMessage(f'live: got {body[:80]!r}, want {{"session": ..., "do": ..., "text": ...}}') from error
    return found


def _message(document: dict[str, Any], files: list[bytes]) -> bytes:
    text = json.dumps({**document, "files": [len(file) for file in files]}, allow_nan=False, separators=(",", ":"))
    data = text.encode()
    return b"".join([struct.pack("<I", len(data)), data, *files])


async def _page(_: HttpRequest) -> Response:
    html, policy = live_page()
    return HTMLResponse(html, headers={"content-security-policy": policy, "cache-control": "no-cache"})


@cache
def live_page() -> tuple[str, str]:
    """Return the page with its style and script in it, and the policy that lets a browser load nothing else."""
    folder = package_files("vlagents_ray.serve.live") / "page"
    parts = {name: folder.joinpath(name).read_text(encoding="utf-8") for name in ("live.css", *_SCRIPTS)}
    html = folder.joinpath("live.html").read_text(encoding="utf-8")
    for name, part in parts.items():
        html = html.replace(f"/* {name} */", part)
    scripts = " ".join(_digest(parts[name]) for name in _SCRIPTS)
    own = f"script-src {scripts}; style-src {_digest(parts['live.css'])}; connect-src 'self'"
    media = "img-src blob: data:; media-src blob:"
    return html, f"default-src 'none'; {own}; {media}; base-uri 'none'; form-action 'none'"


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
