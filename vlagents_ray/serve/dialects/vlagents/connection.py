"""The RPyC connection of one client of the package `vlagents`, from the first byte to the last."""

from __future__ import annotations

import contextlib
import logging
import socket
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vlagents_ray.errors import InvalidInput, MalformedMessage, MessageTooLarge, VLAgentsError, shown
from vlagents_ray.interface import Obs
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.dialects.base import GatewayContext
from vlagents_ray.serve.dialects.gateway_sessions import GatewaySessions
from vlagents_ray.serve.dialects.vlagents import codec as vlagents_codec
from vlagents_ray.serve.dialects.vlagents.client_shm import SharedMemory
from vlagents_ray.serve.engine.admission import MessageAdmission
from vlagents_ray.wire import json_numpy
from vlagents_ray.wire.mapping import KeyMapping
from vlagents_ray.wire.vlagents import rpyc
from vlagents_ray.wire.vlagents.rpyc import Handler, RpycCall

logger = logging.getLogger(__name__)

_FRAME_S = 30.0  # maximum time of a message, from its first byte to its last
_SEND_S = 10.0  # maximum time for a client to accept a reply
_METHODS = ("act", "reset", "name", "is_initialized", "git_status")


@dataclass(frozen=True, slots=True)
class Terms:
    """The settings of the deployment for this protocol."""

    name: str  # name of the model, which clients must state
    version: str  # version of this package
    shared_memory: bool  # whether the shared memory of clients on this machine is read
    mapping: KeyMapping | None  # None if clients use our names
    parts: Mapping[str, vlagents_codec.Part] | vlagents_codec.Part  # columns of each robot, or of the only one


class VlagentsConnection:
    """One connection of a client, from its first byte to its last."""

    def __init__(self, context: GatewayContext, terms: Terms, connection: socket.socket) -> None:
        self._context = context
        self._terms = terms
        self._connection = connection
        self._session = GatewaySessions(context.connect, context.contract)
        self._session.show(NoKey.OPEN, None)  # the protocol has no key, and the deployment accepted that
        self._segments = SharedMemory(same_machine=terms.shared_memory and _is_same_machine(connection))

    def run(self) -> None:
        """Process the client's requests until it disconnects, is silent for too long, or sends an invalid message."""
        try:
            self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            while (frame := self._receive()) is not None:
                if not self._handle(*frame):
                    return
        except (InvalidInput, OSError, ValueError) as error:
            logger.info("vlagents: disconnected a client: %s", error)
        except Exception:
            logger.exception("vlagents: disconnected a client")
        finally:
            shut_down(self._connection)
            self._connection.close()
            self._segments.close()
            self._session.close()

    def _handle(self, body: bytearray, compressed: bool) -> bool:
        """Process one message; return False if the client closes the connection."""
        try:
            call = rpyc.read_call(body, compressed, self._context.limits.body_bytes)
        except rpyc.Refused as refused:
            self._send(rpyc.exception(refused.sequence, "AttributeError", str(refused)))
            return True
        if call is None:
            return True
        if call.handler is Handler.CLOSE:
            return False
        self._send(self._answer(call))
        return True

    def _answer(self, call: RpycCall) -> bytes:
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

    def _value(self, call: RpycCall) -> Any:
        if call.handler is Handler.PING:
            return _echo(call)
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
            return True  # the gateway accepts clients only then
        return json_numpy.dumps({"vlagents_ray": self._terms.version})

    def _act(self, text: str | bytes) -> str:
        admission = self._admission(text)
        seen = vlagents_codec.read_act(text, admission, self._segments)
        obs = self._ours(seen.obs)
        act = self._session.act(obs, seen.instruction) if seen.robots else self._session.act_on(obs)
        admission.release()
        parts = self._terms.parts
        if isinstance(parts, vlagents_codec.Part):
            if len(seen.robots) > 1:
                raise InvalidInput(
                    f"got the robots {list(seen.robots)[:8]}; state their columns in dialects.vlagents.robots"
                )
            parts = dict.fromkeys(seen.robots, parts)
        return vlagents_codec.write_act(act, seen.robots, parts)

    def _reset(self, text: str | bytes) -> str:
        admission = self._admission(text)
        episode = vlagents_codec.read_reset(text, admission, self._segments)
        obs = self._ours(episode.seen.obs)
        info = self._session.reset(obs, episode.seen.instruction, **episode.kwargs)
        admission.release()
        return json_numpy.dumps(info)

    def _admission(self, text: str | bytes) -> MessageAdmission:
        return MessageAdmission(self._context.admission, self._context.limits, None, len(text), inline=False)

    def _ours(self, obs: Obs) -> Obs:
        """Return the observation under our names, converted if the deployment has a mapping."""
        if self._terms.mapping is None:
            return obs
        theirs: dict[str, Any] = {"cameras": obs.cameras, "state": obs.state, "info": obs.info}
        if obs.gripper is not None:
            theirs["gripper"] = obs.gripper
        ours, _ = self._terms.mapping.obs(theirs, self._context.limits, self._context.contract)
        if not self._session.begun:
            self._terms.mapping.warn_of_unread_cameras(theirs, "vlagents")
        return ours

    def _receive(self) -> tuple[bytearray, bool] | None:
        """Receive the next message, and whether it is compressed; None if the client disconnected before it."""
        header = self._read(rpyc.HEADER.size, self._context.idle_s, time.monotonic() + self._context.idle_s + _FRAME_S)
        if header is None:
            return None
        length, compressed = rpyc.read_header(header, self._context.limits.body_bytes)
        body = self._read(length, _FRAME_S, time.monotonic() + _FRAME_S)
        if body is None:
            raise ConnectionResetError("the client disconnected within a message")
        return body, compressed

    def _read(self, length: int, silent_s: float, deadline: float) -> bytearray | None:
        """Receive `length` bytes, allocating memory as they arrive; return None if the client disconnected before them.

        Args:
            length: The number of bytes.
            silent_s: Maximum time between two parts, s.
            deadline: End of the reception, s, of `time.monotonic()`.
        """
        data = bytearray()
        while len(data) < length:
            left_s = min(silent_s, deadline - time.monotonic())
            if left_s <= 0:
                raise MessageTooLarge("a message took longer than a client may take")
            self._connection.settimeout(left_s)
            more = self._connection.recv(min(length - len(data), 2**20))
            if not more:
                if data:
                    raise ConnectionResetError("the client disconnected within a message")
                return None
            data += more
        return data

    def _send(self, frame: bytes) -> None:
        self._connection.settimeout(_SEND_S)
        self._connection.sendall(frame)


def _echo(call: RpycCall) -> str | bytes | None:
    """Return the value with which a ping is answered."""
    match call.args:
        case ():
            return None
        case (str() | bytes() | None as said, *_):
            return said
    raise MalformedMessage(f"ping: got {shown(call.args[0])}, want text")


def _number(args: tuple[Any, ...]) -> int:
    """Return the number of the method that a client looks up."""
    match args:
        case (rpyc.Reference(rpyc.ROOT), str(name)) if name in _METHODS:
            return _METHODS.index(name) + 1
    raise MalformedMessage(f"the server has {list(_METHODS)} and nothing else")


def _called(call: RpycCall) -> tuple[str, tuple[Any, ...]]:
    """Return the name of the method that a client calls, by number or by name, and the arguments."""
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


def _is_same_machine(connection: socket.socket) -> bool:
    """Whether the client is on this machine, in which case both ends have the same address."""
    try:
        return bool(connection.getpeername()[0] == connection.getsockname()[0])
    except OSError:  # the client is gone already
        return False


def shut_down(connection: socket.socket) -> None:
    """Shut a connection down, which wakes the thread that reads from it."""
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
