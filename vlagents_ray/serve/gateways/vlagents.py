"""The door for clients of the package `vlagents`: RPyC, a thread a client, a session a client."""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
import time
import uuid
from typing import Any

from vlagents_ray.contract import ActionSpec
from vlagents_ray.errors import ConfigError, InvalidInput, MalformedMessage, MessageTooLarge, VLAgentsError
from vlagents_ray.interface import Obs
from vlagents_ray.serve.gateways.config import GripperArgs, VlagentsArgs
from vlagents_ray.serve.gateways.door import House, listen
from vlagents_ray.serve.gateways.segments import SharedMemory
from vlagents_ray.serve.gateways.talk import Talk
from vlagents_ray.wire import json_numpy, rpyc, vlagents
from vlagents_ray.wire.presets import read_mapping
from vlagents_ray.wire.rpyc import Call, Handler

logger = logging.getLogger(__name__)

_FRAME_S = 30.0  # from the first byte of a message to its last
_SEND_S = 10.0  # for a client to take an answer
_END_S = 3.0
_METHODS = ("act", "reset", "name", "is_initialized", "git_status")


class VlagentsDoor:
    """Listens on a socket that is bound already."""

    def __init__(self, house: House, args: VlagentsArgs, listener: socket.socket, version: str) -> None:
        if house.check is not None and not args.without_key:
            raise ConfigError(
                "dialects.vlagents: the server wants API keys, and this protocol has none; take the door away, or "
                "let everybody in here who reaches its port: without_key: true"
            )
        self._house = house
        self._listener = listener
        self.name = args.name or house.app
        self.version = version
        self.shared_memory = args.shared_memory
        self.mapping = None if args.mapping is None else read_mapping(args.mapping)
        self.parts = self._parts(args)
        self._clients: dict[threading.Thread, socket.socket] = {}
        self._lock = threading.Lock()
        self._closing = False
        self._accepting = threading.Thread(target=self._accept, name="vlagents-door", daemon=True)

    def open(self) -> None:
        """Let clients in."""
        listen(self._listener)
        self._accepting.start()

    def alive(self) -> bool:
        """Does it still let clients in?"""
        return self._accepting.is_alive()

    def close(self) -> None:
        """Hang up on everybody; their sessions end."""
        self._closing = True
        _hang_up(self._listener)
        with self._lock:
            clients = dict(self._clients)
        for connection in clients.values():
            _hang_up(connection)
        deadline = time.monotonic() + _END_S
        if self._accepting.ident is not None:
            self._accepting.join(_END_S)
        self._listener.close()
        for thread in clients:
            thread.join(max(0.0, deadline - time.monotonic()))

    def _accept(self) -> None:
        while not self._stopped():
            try:
                connection, peer = self._listener.accept()
            except OSError as error:
                if self._stopped():
                    break
                logger.warning("vlagents: cannot let a client in: %s", error)
                time.sleep(0.1)  # out of descriptors: others have to leave first
                continue
            client = _Client(self, self._house, connection, near=_is_near(connection))
            thread = threading.Thread(target=self._serve, args=(client,), name=f"vlagents {peer[0]}", daemon=True)
            with self._lock:
                full = len(self._clients) >= self._house.sessions
                if not full:
                    self._clients[thread] = connection
            if full:
                logger.warning(
                    "vlagents: %d clients are connected, the limit; one was turned away", self._house.sessions
                )
                connection.close()
            else:
                thread.start()

    def _stopped(self) -> bool:
        return self._closing

    def _serve(self, client: _Client) -> None:
        try:
            client.run()
        finally:
            with self._lock:
                del self._clients[threading.current_thread()]

    def _parts(self, args: VlagentsArgs) -> dict[str, vlagents.Part] | vlagents.Part:
        if args.robots:
            return {name: self._part(robot.start, robot.stop, robot.gripper) for name, robot in args.robots.items()}
        return self._part(None, None, args.gripper)

    def _part(self, start: int | None, stop: int | None, gripper: GripperArgs | None) -> vlagents.Part:
        if gripper is None:
            return vlagents.Part(start, stop)
        spec = ActionSpec() if self._house.contract is None else self._house.contract.action
        return vlagents.Part(
            start,
            stop,
            gripper.column,
            _first(gripper.open, spec.gripper_open, 1.0),
            _first(gripper.closed, spec.gripper_closed, 0.0),
        )


class _Client:
    """One connection, from its first byte to its last."""

    def __init__(self, door: VlagentsDoor, house: House, connection: socket.socket, *, near: bool) -> None:
        self._door = door
        self._house = house
        self._connection = connection
        self._talk = Talk(house.connect)
        self._segments = SharedMemory(near=near and door.shared_memory)

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
            _hang_up(self._connection)
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
            return self._door.name
        if method == "is_initialized":
            return True  # the door opens when the policy can act
        return json_numpy.dumps({"vlagents_ray": self._door.version})

    def _act(self, text: str | bytes) -> str:
        seen = vlagents.read_act(text, self._house.limits, self._segments)
        obs = self._ours(seen.obs)
        act = self._talk.act(obs, seen.instruction) if seen.robots else self._talk.act_on(obs)
        parts = self._door.parts
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
        if self._door.mapping is None:
            return obs
        theirs: dict[str, Any] = {"cameras": obs.cameras, "state": obs.state, "info": obs.info}
        if obs.gripper is not None:
            theirs["gripper"] = obs.gripper
        return self._door.mapping.obs(theirs, self._house.limits)[0]

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


def _first(*values: float | None) -> float:
    return next(value for value in values if value is not None)


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


def _hang_up(connection: socket.socket) -> None:
    """Wake whoever waits for it."""
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
