"""The two WebSockets between a human at the live page and a robot, see `vlagents_ray.client.steering`.

    WS /v1/live/robot     the robot's: any key; the robot is offered under its own session
    WS /v1/live/control   the human's: keys need the scope "operate"

The page says {"session": …} first, and holds the robot from then on, unless it is told {"over": why}. It gets each beat
of the robot, {"beat": 42, "moves": true, "why": ""}, and answers it with what is pressed, {"seq", "beat", "axes",
"grips"}; {"release": true} gives the robot back. A page that goes without that leaves the robot paused.
"""

from __future__ import annotations

import asyncio
import json
import uuid
from collections.abc import Awaitable, Callable
from contextlib import suppress
from functools import partial
from typing import Any

from starlette.routing import BaseRoute, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from vlagents_ray.client.steering import ROBOT_PATH, SILENT_S, Steering
from vlagents_ray.errors import MalformedMessage, VLAgentsError, shown
from vlagents_ray.protocol.json_messages import problem
from vlagents_ray.serve.access.audit import log_pressed
from vlagents_ray.serve.access.scope_check import ScopeCheck, caller_name
from vlagents_ray.serve.endpoints.http_messages import deny
from vlagents_ray.serve.live.fleet import Exchange, Fleet
from vlagents_ray.serve.live.remote.robot_links import RobotLink, RobotLinks, read_beat

CONTROL_PATH = "/v1/live/control"
_OPERATE = "operate"  # scope of keys
_PROTOCOL = "vlagents.live"
_CHARACTERS = 2000  # longest message
_APART_S = 0.01  # least time between two messages of one connection, so that none floods the server, or a robot
_POLICY_VIOLATION = 1008  # WebSocket close code

Tell = Callable[[dict[str, Any]], Awaitable[dict[str, Any]]]
"""Tells the robot something, and returns `over` with the reason if the hold has ended."""


def remote_routes(fleet: Fleet, *, open_to_network: bool) -> list[BaseRoute]:
    """Return the routes by which humans move robots; that of robots only where there is a replica.

    Args:
        fleet: Finds the robots.
        open_to_network: Whether other machines reach this server without a key; nobody may then move a robot.
    """
    scopes = ScopeCheck("live", open_to_network=open_to_network)
    control: BaseRoute = WebSocketRoute(CONTROL_PATH, partial(_control, fleet, scopes))
    if fleet.robots is None:
        return [control]
    return [control, WebSocketRoute(ROBOT_PATH, partial(_robot, fleet.robots, scopes))]


async def _robot(links: RobotLinks, scopes: ScopeCheck, socket: WebSocket) -> None:
    """Serve the connection of a robot."""
    try:
        scopes.require(None)
    except VLAgentsError as error:
        await deny(socket, error)
        return
    await socket.accept()
    prefix = f"{name}/" if (name := caller_name()) else ""  # of its sessions' names in the engine
    link = RobotLink(partial(_send, socket))
    try:
        while True:
            said = read_beat(await _received(socket, scopes, None))
            links.put(prefix + said.pop("session"), link)
            await link.hear(said)
            await asyncio.sleep(_APART_S)
    except WebSocketDisconnect:
        pass
    except VLAgentsError as error:
        await _end(socket, problem(error))
    finally:
        links.remove(link, "the connection to the robot is lost")


async def _control(fleet: Fleet, scopes: ScopeCheck, socket: WebSocket) -> None:
    """Serve the connection of a human."""
    try:
        scopes.require(_OPERATE)
    except VLAgentsError as error:
        await deny(socket, error)
        return
    await socket.accept(_PROTOCOL if _PROTOCOL in (socket.scope.get("subprotocols") or []) else None)
    try:
        first = await _received(socket, scopes, _OPERATE)
        session = first.get("session")
        if not isinstance(session, str):
            raise MalformedMessage(f'live: got {shown(first)}, want {{"session": ...}} first')
        exchange = await fleet.exchange(session)
        if exchange is None:
            await _end(socket, {"over": "nobody can take over this robot from here; start it with RemoteLeader"})
            return
        hold = uuid.uuid4().hex
        if over := await exchange(session, hold, {"do": "take", "by": caller_name()}):
            await _end(socket, over)
            return
    except WebSocketDisconnect:
        return
    except VLAgentsError as error:
        await _end(socket, problem(error))
        return
    log_pressed(caller_name(), f"'take over' for session {session!r}")
    why = "the page has gone"
    try:
        why = await _hold(socket, scopes, partial(_told, exchange, session, hold))
    except VLAgentsError as error:
        why = str(error)
        await _end(socket, problem(error))
    finally:  # also if the key was revoked, which cancels this task
        log_pressed(caller_name(), f"'take over' for session {session!r}: over, {why}")
        with suppress(Exception):
            await exchange(session, hold, {"do": "gone", "why": why})


async def _told(exchange: Exchange, session: str, hold: str, message: dict[str, Any]) -> dict[str, Any]:
    answer = await exchange(session, hold, message)
    return {"over": "the connection to the robot is lost"} if answer is None else answer


async def _hold(socket: WebSocket, scopes: ScopeCheck, tell: Tell) -> str:
    """Pass on commands and beats until one side ends the hold; return why it is over."""
    beats = asyncio.ensure_future(_pass_beats(socket, tell))
    commands = asyncio.ensure_future(_pass_commands(socket, scopes, tell))
    try:
        done, _ = await asyncio.wait({beats, commands}, return_when=asyncio.FIRST_COMPLETED)
        return done.pop().result()
    except WebSocketDisconnect:
        return "the page has gone"
    finally:
        for task in (beats, commands):
            task.cancel()
        await asyncio.gather(beats, commands, return_exceptions=True)


async def _pass_beats(socket: WebSocket, tell: Tell) -> str:
    after = -1
    while True:
        said = await tell({"do": "wait", "after": after})
        if "over" in said:
            await _end(socket, said)
            return str(said["over"])
        if said:
            after = said["beat"]
            await socket.send_text(json.dumps(said))


async def _pass_commands(socket: WebSocket, scopes: ScopeCheck, tell: Tell) -> str:
    while True:
        message = await _received(socket, scopes, _OPERATE)
        if message.get("release"):
            await tell({"do": "release"})
            await _end(socket, {"over": "given back"})
            return "given back"
        told = await tell(Steering.of(message).message(""))
        if "over" in told:
            await _end(socket, told)
            return str(told["over"])
        await asyncio.sleep(_APART_S)


async def _received(socket: WebSocket, scopes: ScopeCheck, scope: str | None) -> dict[str, Any]:
    """Return the next message, which is an object.

    Raises:
        WebSocketDisconnect: There is none.
        MalformedMessage: It is something else, or does not come in time.
        Forbidden: The key has lost its scope.
    """
    try:
        message = await asyncio.wait_for(socket.receive(), SILENT_S)
    except asyncio.TimeoutError:
        raise MalformedMessage(f"live: nothing came for {SILENT_S:g} s; connect again") from None
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message["code"])
    scopes.require(scope)
    text = message.get("text") or (message.get("bytes") or b"").decode(errors="replace")
    try:
        found = json.loads(text[:_CHARACTERS])
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise MalformedMessage(f"live: got {text[:80]!r}, want a JSON object of at most {_CHARACTERS} characters")
    return found


async def _send(socket: WebSocket, message: dict[str, Any]) -> None:
    with suppress(WebSocketDisconnect, RuntimeError):  # it has gone meanwhile
        await socket.send_text(json.dumps(message))


async def _end(socket: WebSocket, message: dict[str, Any]) -> None:
    await _send(socket, message)
    with suppress(WebSocketDisconnect, RuntimeError):
        await socket.close(_POLICY_VIOLATION if "code" in message else 1000)
