"""One client of the package `vlagents`: its RPyC connection, from the first byte to the last."""

from __future__ import annotations

import contextlib
import logging
import socket
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vlagents_ray.errors import InvalidInput, MalformedMessage, MessageTooLarge, VLAgentsError
from vlagents_ray.interface import Obs
from vlagents_ray.serve.gateways.door import House
from vlagents_ray.serve.gateways.segments import SharedMemory
from vlagents_ray.serve.gateways.talk import Talk
from vlagents_ray.wire import json_numpy, rpyc, vlagents
from vlagents_ray.wire.mapping import KeyMapping
from vlagents_ray.wire.rpyc import Call, Handler

logger = logging.getLogger(__name__)

_FRAME_S = 30.0  # from the first byte of a message to its last
_SEND_S = 10.0  # for a client to take an answer
_METHODS = ("act", "reset", "name", "is_initialized", "git_status")


@dataclass(frozen=True, slots=True)
class Terms:
    """What the deployment says of this protocol."""

    name: str  # of the model, which clients must give
    version: str  # of this package
    shared_memory: bool  # of clients on this machine is read
    mapping: KeyMapping | None  # None: their names are ours
    parts: Mapping[str, vlagents.Part] | vlagents.Part  # of each robot, or of the only one


class Client:
    """One connection, from its first byte to its last."""

    def __init__(self, house: House, terms: Terms, connection: socket.socket) -> None:
        self._house = house
        self._terms = terms
        self._connection = connection
        self._talk = Talk(house.connect)
        self._segments = SharedMemory(near=terms.shared_memory and _is_near(connection))

    def run(self) -> None:
        """Answer its requests until it is gone, silent for too long, or not understood."""
        try:
            self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            while (frame := self._receive()) is not None:
                if not self._handle(*frame):
                    return
        except (InvalidInput, OSError, ValueError) as error:
            logger.info("vlagents: hung up on a client: %s", error)
        except Exception:
            logger.exception("vlagents: hung up on a client")
        finally:
            hang_up(self._connection)
            self._connection.close()
            self._segments.close()
            self._talk.close()

    def _handle(self, body: bytearray, compressed: bool) -> bool:
        """Answer one message; False when that was the client's last."""
        try:
            call = rpyc.read_call(body, compressed, self._house.limits.body_bytes)
        except rpyc.Refused as refused:
            self._send(rpyc.exception(refused.sequence, "AttributeError", str(refused)))
            return True
        if call is None:
            return True
        if call.handler is Handler.CLOSE:
            return False
        self._send(self._answer(call))
        return True

    def _answer(self, call: Call) -> bytes:
        try:
            if call.handler is Handler.GETROOT:
                return rpyc.reference_reply(call.sequence, rpyc.ROOT)
            if call.handler is Handler.GETATTR:
                return rpyc.reference_reply(call.sequence, _number(call.args))
            return rpyc.reply(call.sequence, self._value(call))
        except VLAgentsError as error:
            return rpyc.exception(call.sequence, _builtin(error), f"{error.code}: {error}")
        except Exception:
            name = uuid.uuid4().hex
            logger.exception("vlagents: request %s failed", name)
            return rpyc.exception(
                call.sequence, "RuntimeError", f"internal error; the server's log has the details under {name}"
            )

    def _value(self, call: Call) -> Any:
        if call.handler is Handler.PING:
            return call.args[0] if call.args else None
        if call.handler is Handler.DEL:
            return None
        if call.handler is Handler.INSPECT:
            return tuple((name, None) for name in _METHODS)
        method, args = _called(call)
        return self._method(method, args)

    def _method(self, method: str, args: tuple[Any, ...]) -> Any:
        if method in ("act", "reset"):
            if len(args) != 1 or not isinstance(args[0], (str, bytes)):
                raise MalformedMessage(f"{method}: want one argument, text")
            return self._act(args[0]) if method == "act" else self._reset(args[0])
        if args:
            raise MalformedMessage(f"{method}: want no arguments")
        if method == "name":
            return self._terms.name
        if method == "is_initialized":
            return True  # the door opens when the policy can act
        return json_numpy.dumps({"vlagents_ray": self._terms.version})

    def _act(self, text: str | bytes) -> str:
        seen = vlagents.read_act(text, self._house.limits, self._segments)
        obs = self._ours(seen.obs)
        act = self._talk.act(obs, seen.instruction) if seen.robots else self._talk.act_on(obs)
        parts = self._terms.parts
        if isinstance(parts, vlagents.Part):
            if len(seen.robots) > 1:
                raise InvalidInput(
                    f"got the robots {list(seen.robots)[:8]}; state their columns in dialects.vlagents.robots"
                )
            parts = dict.fromkeys(seen.robots, parts)
        return vlagents.write_act(act, seen.robots, parts)

    def _reset(self, text: str | bytes) -> str:
        episode = vlagents.read_reset(text, self._house.limits, self._segments)
        obs = self._ours(episode.seen.obs)
        return json_numpy.dumps(self._talk.reset(obs, episode.seen.instruction, **episode.kwargs))

    def _ours(self, obs: Obs) -> Obs:
        """With our names, if the deployment says what theirs mean."""
        if self._terms.mapping is None:
            return obs
        theirs: dict[str, Any] = {"cameras": obs.cameras, "state": obs.state, "info": obs.info}
        if obs.gripper is not None:
            theirs["gripper"] = obs.gripper
        return self._terms.mapping.obs(theirs, self._house.limits)[0]

    def _receive(self) -> tuple[bytearray, bool] | None:
        """The next message and whether it is compressed; None when the client hung up between two."""
        header = self._read(rpyc.HEADER.size, self._house.idle_s, time.monotonic() + self._house.idle_s + _FRAME_S)
        if header is None:
            return None
        length, compressed = rpyc.read_header(header, self._house.limits.body_bytes)
        body = self._read(length, _FRAME_S, time.monotonic() + _FRAME_S)
        if body is None:
            raise ConnectionResetError("it hung up within a message")
        return body, compressed

    def _read(self, length: int, silent_s: float, deadline: float) -> bytearray | None:
        """`length` bytes; None if there are none any more. Memory is taken as they come."""
        data = bytearray()
        while len(data) < length:
            left_s = min(silent_s, deadline - time.monotonic())
            if left_s <= 0:
                raise MessageTooLarge("a message took longer than a client may take")
            self._connection.settimeout(left_s)
            more = self._connection.recv(min(length - len(data), 2**20))
            if not more:
                if data:
                    raise ConnectionResetError("it hung up within a message")
                return None
            data += more
        return data

    def _send(self, frame: bytes) -> None:
        self._connection.settimeout(_SEND_S)
        self._connection.sendall(frame)


def _number(args: tuple[Any, ...]) -> int:
    """The number of the method that a client looks up."""
    match args:
        case (rpyc.Reference(rpyc.ROOT), str(name)) if name in _METHODS:
            return _METHODS.index(name) + 1
    raise MalformedMessage(f"the server has {list(_METHODS)} and nothing else")


def _called(call: Call) -> tuple[str, tuple[Any, ...]]:
    """The method that a client calls, by its number or by its name, and the arguments."""
    match call.handler, call.args:
        case Handler.CALL, (rpyc.Reference(number), tuple(args), *options) if 0 < number <= len(_METHODS):
            name = _METHODS[number - 1]
        case Handler.CALLATTR, (rpyc.Reference(rpyc.ROOT), str(name), tuple(args), *options) if name in _METHODS:
            pass
        case _:
            raise MalformedMessage(f"rpyc: want a call of one of {list(_METHODS)} of the root")
    if any(options):
        raise MalformedMessage(f"{name}: takes no arguments by name")
    return name, args


def _builtin(error: VLAgentsError) -> str:
    if isinstance(error, TimeoutError):
        return "TimeoutError"
    return "ValueError" if isinstance(error, ValueError) else "RuntimeError"


def _is_near(connection: socket.socket) -> bool:
    """Is the client on this machine? Then both ends have the same address."""
    try:
        return bool(connection.getpeername()[0] == connection.getsockname()[0])
    except OSError:  # it is gone already
        return False


def hang_up(connection: socket.socket) -> None:
    """Wake whoever waits for it."""
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
