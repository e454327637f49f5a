"""Serves clients of the package `vlagents` over RPyC, with one thread and one session per
client.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import logging
import os
import re
import socket
import stat
import threading
import time
from collections.abc import Mapping
from typing import Any, ClassVar

from pydantic import BaseModel, Field, model_validator

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import (
    InvalidInput,
    InvalidObservation,
    MalformedMessage,
    PolicyUnavailable,
    VLAgentsError,
    shown,
)
from vlagents_ray.interface import Obs
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.config.dialects import DialectConfig, KeylessPortConfig
from vlagents_ray.serve.dialects.base import GatewayContext, PortDialect
from vlagents_ray.serve.endpoints.connection import ANSWERS_S, wait_delivered
from vlagents_ray.serve.engine.admission import MessageAdmission
from vlagents_ray.wire import json_numpy
from vlagents_ray_dialects.acceptor import Acceptor
from vlagents_ray_dialects.client_reader import ClientReader, share_of, shut_down
from vlagents_ray_dialects.gateway_sessions import GatewaySessions, internal_error
from vlagents_ray_dialects.messages import rpyc, vlagents
from vlagents_ray_dialects.messages.rpyc import Handler, RpycCall

logger = logging.getLogger(__name__)

_FRAME_S = 30.0  # maximum time of a message, from its first byte to its last
_SEND_S = 10.0  # maximum time for a client to accept a reply
_METHODS = ("act", "reset", "name", "is_initialized", "git_status")
_FOLDER = "/dev/shm"  # noqa: S108 - the folder of Linux for shared memory
# The names that Python's `SharedMemory` generates; clients may name no other file in the folder.
_NAME = re.compile(r"/?(psm_[0-9a-f]{1,32})")
_KEPT = 64  # maximum number of segments of a client that are kept open
_END_S = 3.0  # maximum time for the answers to requests when the dialect ends


class VlagentsConnection:
    """One connection of a client, from its first byte to its last.

    Args:
        dialect: The dialect.
        connection: The connection.
    """

    def __init__(self, dialect: VlagentsDialect, connection: socket.socket) -> None:
        context = dialect.context
        self._context = context
        self._dialect = dialect
        self._connection = connection
        self._session = GatewaySessions(context.connect, context.contract)
        # The protocol has no key, which the deployment has accepted.
        self._session.show(NoKey.OPEN, None)

        robot = dialect.config.priority == "robot"
        self._share = share_of(connection)  # the name of the client's share of the bytes in flight
        self._reader = ClientReader(connection, context.admission, robot=robot)
        self._segments = SharedMemory(same_machine=_is_same_machine(connection))
        self._sending = threading.Lock()
        # The sequence number of the request that is being processed.
        self._unanswered: int | None = None

    def run(self) -> None:
        """Process the client's requests until it disconnects, is silent for too long, or sends
        an invalid message.
        """
        try:
            self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            while not self._dialect.closing:
                frame = self._receive()
                if frame is None:
                    return
                body, compressed = frame
                if not self._handle(body, compressed):
                    return
        except (VLAgentsError, OSError, ValueError) as error:
            logger.info("vlagents: disconnected a client: %s", error)
        except Exception:
            logger.exception("vlagents: disconnected a client")
        finally:
            wait_delivered(self._connection, time.monotonic() + ANSWERS_S)
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
        self._unanswered = call.sequence
        return self._send_answer(self._answer(call))

    def _send_answer(self, answer: bytes) -> bool:
        """Answer the current request; return False if `end` has answered it already."""
        with self._sending:
            unanswered, self._unanswered = self._unanswered, None
            if unanswered is not None:
                self._send(answer)
        return unanswered is not None

    def stop_reading(self) -> None:
        """Read no further requests, so that the connection ends after the answer to the current
        one; called on any thread.
        """
        shut_down(self._connection, socket.SHUT_RD)

    def end(self) -> None:
        """Answer the current request with an error, and end the connection; called on any
        thread.
        """
        error = PolicyUnavailable("the server is stopping; connect again")
        # Without a request there is nothing to answer, and the lock may be held for a client that
        # reads an answer slowly.
        if self._unanswered is not None:
            with self._sending:
                sequence, self._unanswered = self._unanswered, None
                if sequence is not None:
                    text = f"{error.code}: {error}"
                    # The client may have disconnected, or may not read.
                    with contextlib.suppress(OSError):
                        self._send(rpyc.exception(sequence, "RuntimeError", text))
        shut_down(self._connection)

    def _answer(self, call: RpycCall) -> bytes:
        """Return the frame that answers a request, which may be an exception."""
        try:
            if call.handler is Handler.GETROOT:
                return rpyc.reference_reply(call.sequence, rpyc.ROOT)
            if call.handler is Handler.GETATTR:
                return rpyc.reference_reply(call.sequence, _number(call.args))
            return rpyc.reply(call.sequence, self._value(call))
        except VLAgentsError as error:
            class_name = "RuntimeError"
            if isinstance(error, TimeoutError):
                class_name = "TimeoutError"
            elif isinstance(error, ValueError):
                class_name = "ValueError"
            return rpyc.exception(call.sequence, class_name, f"{error.code}: {error}")
        except Exception:  # noqa: BLE001 - logged, and answered
            return rpyc.exception(call.sequence, "RuntimeError", internal_error("vlagents"))

    def _value(self, call: RpycCall) -> Any:
        """Return the value of the reply to a request."""
        if call.handler is Handler.PING:
            return _echo(call)
        if call.handler is Handler.DEL:
            return None
        if call.handler is Handler.INSPECT:
            return tuple((name, None) for name in _METHODS)

        method, args = _called(call)
        if method in ("act", "reset"):
            if len(args) != 1 or not isinstance(args[0], (str, bytes)):
                raise MalformedMessage(f"{method}: expected one argument, text, got {shown(args)}")
            return self._act(args[0]) if method == "act" else self._reset(args[0])

        if args:
            raise MalformedMessage(f"{method}: expected no arguments, got {shown(args)}")
        if method == "name":
            return self._dialect.config.name or self._context.app
        if method == "is_initialized":
            return True  # the gateway accepts clients only when the policy is loaded
        return json_numpy.dumps({"vlagents_ray": importlib.metadata.version("vlagents-ray")})

    def _act(self, text: str | bytes) -> str:
        """Return the result of the method `act`."""
        admission = self._admission(text)
        request = vlagents.read_act(text, admission, self._segments)
        obs = self._ours(request.obs)
        if request.robots:
            act = self._session.act(admission.charge, obs, request.instruction)
        else:
            act = self._session.act_on(admission.charge, obs)
        admission.release()

        columns = self._dialect.columns
        if isinstance(columns, vlagents.RobotColumns):
            if len(request.robots) > 1:
                raise InvalidInput(
                    f"expected one robot, got {list(request.robots)[:8]}; list their columns in "
                    "dialects.vlagents.robots"
                )
            columns = dict.fromkeys(request.robots, columns)
        return vlagents.write_act(act, request.robots, columns)

    def _reset(self, text: str | bytes) -> str:
        """Return the result of the method `reset`."""
        admission = self._admission(text)
        request, options = vlagents.read_reset(text, admission, self._segments)
        obs = self._ours(request.obs)
        info = self._session.reset(admission.charge, obs, request.instruction, **options)
        admission.release()
        return json_numpy.dumps(info)

    def _admission(self, text: str | bytes) -> MessageAdmission:
        """Return the admission of a request, which counts its bytes."""
        robot = self._dialect.config.priority == "robot"
        return MessageAdmission(
            self._context.admission,
            self._context.limits,
            self._session.account.charge(),
            len(text),
            robot=robot,
            inline=False,
            share=self._share,
        )

    def _ours(self, obs: Obs) -> Obs:
        """Return an observation with the policy's names, converted if the deployment has a
        mapping.
        """
        mapping = self._dialect.stated_mapping
        if mapping is None:
            return obs

        theirs: dict[str, Any] = {"cameras": obs.cameras, "state": obs.state, "info": obs.info}
        if obs.gripper is not None:
            theirs["gripper"] = obs.gripper
        ours, _ = mapping.obs(theirs, self._context.limits, self._context.contract)
        if not self._session.begun:
            mapping.warn_of_unread_cameras(theirs, "vlagents")
        return ours

    def _receive(self) -> tuple[bytearray, bool] | None:
        """Receive the next message, and whether it is compressed; None if the client
        disconnected before it.
        """
        idle_s = self._context.idle_s
        deadline = time.monotonic() + idle_s + _FRAME_S
        header = self._reader.read(rpyc.HEADER.size, idle_s, deadline)
        if header is None:
            return None

        length, compressed = rpyc.read_header(bytes(header), self._context.limits.body_bytes)
        body = self._reader.read(length, _FRAME_S, time.monotonic() + _FRAME_S)
        if body is None:
            raise ConnectionResetError("the client disconnected within a message")
        return bytearray(body), compressed

    def _send(self, frame: bytes) -> None:
        """Send a frame; raise `TimeoutError` if the client does not read it in time."""
        self._connection.settimeout(_SEND_S)
        self._connection.sendall(frame)


def _echo(call: RpycCall) -> str | bytes | None:
    """Return the value with which a ping is answered."""
    match call.args:
        case ():
            return None
        case (str() | bytes() | None as value, *_):
            return value
    raise MalformedMessage(f"ping: expected text, got {shown(call.args[0])}")


def _number(args: tuple[Any, ...]) -> int:
    """Return the number of the method whose name a client looks up."""
    match args:
        case (rpyc.Reference(rpyc.ROOT), str(name)) if name in _METHODS:
            return _METHODS.index(name) + 1
    raise MalformedMessage(f"the server has {list(_METHODS)} and nothing else")


def _called(call: RpycCall) -> tuple[str, tuple[Any, ...]]:
    """Return the name of the method that a client calls, by number or by name, and the
    arguments.
    """
    match call.handler, call.args:
        case Handler.CALL, (rpyc.Reference(number), tuple(args), *options) if (
            0 < number <= len(_METHODS)
        ):
            name = _METHODS[number - 1]
        case Handler.CALLATTR, (rpyc.Reference(rpyc.ROOT), str(name), tuple(args), *options) if (
            name in _METHODS
        ):
            pass
        case _:
            raise MalformedMessage(
                f"rpyc: expected a call of one of {list(_METHODS)} of the root, got another"
            )
    if any(options):
        raise MalformedMessage(f"{name}: expected no arguments by name, got some")
    return name, args


def _is_same_machine(connection: socket.socket) -> bool:
    """Return whether the client is on this machine, in which case both ends have the same
    address.
    """
    try:
        return bool(connection.getpeername()[0] == connection.getsockname()[0])
    except OSError:  # the client has disconnected
        return False


# Access by name to the shared memory of a client on this machine.
#
# Segments are copied, never mapped: if a client shrinks a mapped segment, SIGBUS would end this
# process. This module neither creates nor removes segments, nor registers them with Python's
# resource tracker, so that the client alone owns them.


class SharedMemory:
    """The segments of one client, kept open between its requests.

    Args:
        same_machine: Whether the client is on this machine; otherwise every name is rejected.
    """

    def __init__(self, *, same_machine: bool) -> None:
        self._same_machine = same_machine
        self._open: dict[str, int] = {}  # descriptors by name, the oldest first

    def read(self, name: str, size: int) -> bytearray:
        """Return a copy of the first bytes of a segment.

        Args:
            name: The name of the segment.
            size: The number of bytes.

        Raises:
            InvalidObservation: There is no such segment, or it is shorter.
        """
        if not self._same_machine:
            raise InvalidObservation(
                "shared memory: expected a client on the server's machine, got one on another; "
                "leave on_same_machine=False"
            )
        descriptor = self._descriptor(name)
        if os.fstat(descriptor).st_size < size:  # checked before memory is allocated
            raise InvalidObservation(
                f"shared memory {name[:40]!r}: shorter than the {size} bytes of its shape"
            )

        data = bytearray(size)
        filled = 0  # the number of bytes that have been read
        while filled < size:
            count = os.preadv(descriptor, [memoryview(data)[filled:]], filled)
            if count == 0:
                raise InvalidObservation(
                    f"shared memory {name[:40]!r}: became shorter while it was read"
                )
            filled += count
        return data

    def close(self) -> None:
        """Close all segments, without removing them."""
        for descriptor in self._open.values():
            os.close(descriptor)
        self._open.clear()

    def _descriptor(self, name: str) -> int:
        """Return the descriptor of a segment, which is opened if necessary."""
        match = _NAME.fullmatch(name)
        if match is None:
            raise InvalidObservation(
                f"shared memory: expected a name like 'psm_01234567', got {name[:40]!r}"
            )

        file_name = match[1]
        if file_name in self._open:
            return self._open[file_name]

        flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK
        try:
            descriptor = os.open(f"{_FOLDER}/{file_name}", flags)
        except OSError as error:
            raise InvalidObservation(
                f"shared memory {name[:40]!r}: cannot be opened ({error.strerror})"
            ) from error
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.close(descriptor)
            raise InvalidObservation(f"shared memory {name[:40]!r}: not a regular file")

        if len(self._open) >= _KEPT:  # A client creates another segment when its images grow.
            oldest = next(iter(self._open))
            os.close(self._open.pop(oldest))
        self._open[file_name] = descriptor
        return descriptor


class GripperArgs(BaseModel, extra="forbid"):
    """The column of a robot's gripper in a row of the policy's actions, and its values."""

    column: int = Field(default=-1, description="index as in Python: -1 is the last column")
    open: float | None = Field(
        default=None,
        description="value for an open gripper; default: the policy's contract, or 1",
    )
    closed: float | None = Field(
        default=None,
        description="value for a closed gripper; default: the policy's contract, or 0",
    )

    @model_validator(mode="after")
    def _two_values(self) -> GripperArgs:
        """Reject equal values."""
        if self.open is not None and self.open == self.closed:
            raise ValueError(
                f"expected two different numbers, got {self.open} as open and as closed; change one"
            )
        return self


class RobotArgs(BaseModel, extra="forbid"):
    """The columns of one robot in a row."""

    start: int | None = Field(default=None, description="first column; default: 0")
    stop: int | None = Field(
        default=None, description="column after the last one; default: the end of the row"
    )
    gripper: GripperArgs | None = Field(
        default=None, description="the column that becomes SingleAct.gripper; default: none"
    )


class VlagentsDialectConfig(KeylessPortConfig):
    """The settings of the RPyC protocol of the package `vlagents`, 0.2 and 0.3.

    A mapping reads cameras/NAME, state/NAME, gripper and info; without one, the client's names stay
    as they are.
    """

    port: int = Field(default=8080, ge=1, le=65535)
    name: str | None = Field(
        default=None,
        description="the name of the model, which clients must name; default: the application's",
    )
    gripper: GripperArgs | None = Field(
        default=None,
        description="for a single robot: the column that becomes SingleAct.gripper; default: none",
    )
    robots: dict[str, RobotArgs] = Field(
        default_factory=dict, description="for several robots: the columns of each"
    )

    @model_validator(mode="after")
    def _one_way(self) -> VlagentsDialectConfig:
        """Reject settings for both one robot and several."""
        if self.gripper is not None and self.robots:
            raise ValueError(
                "expected `gripper` for a single robot, got it with `robots`; set it for each robot"
            )
        return self


class VlagentsDialect(PortDialect):
    """The protocol of the package `vlagents`, with one thread and one session per client."""

    Config = VlagentsDialectConfig
    clients = "vlagents"
    summary = (
        "A session is the connection; an episode begins with `reset` and with each new "
        "instruction. An error is raised at the client as a built-in exception."
    )
    scheme = "rpyc"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        # The names of this project, for clients that need a mapping but whose protocol defines no
        # names.
        "vlagents": {
            "cameras": {"*": "cameras/*"},
            "state": {"*": "state/*"},
            "gripper": {"key": "gripper", "optional": True},
            "instruction": "instruction",
            "info": {"info": "info"},
        }
    }
    config: VlagentsDialectConfig

    def __init__(self, name: str, config: VlagentsDialectConfig, context: GatewayContext) -> None:
        super().__init__(name, config, context)
        self.stated_mapping = config.keys()  # None if clients use the names of this project
        spec = ActionSpec() if context.contract is None else context.contract.action
        # The columns of each robot, or of a single one.
        self.columns: Mapping[str, vlagents.RobotColumns] | vlagents.RobotColumns
        if config.robots:
            self.columns = {name: _columns(robot, spec) for name, robot in config.robots.items()}
        else:
            self.columns = _columns(RobotArgs(gripper=config.gripper), spec)

        self._clients: dict[threading.Thread, VlagentsConnection] = {}
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._acceptor: Acceptor | None = None

    @classmethod
    def lacks(cls, config: DialectConfig, contract: Contract | None) -> list[str]:  # noqa: ARG003 - overrides
        """Return nothing: the instruction is sent next to the observation, and `robots` contains
        the columns of each robot.
        """
        return []

    def serve(self, listener: socket.socket) -> None:
        self._acceptor = Acceptor("vlagents", listener, self._add)

    def alive(self) -> bool:
        return self._acceptor is not None and self._acceptor.alive()

    @property
    def closing(self) -> bool:
        """Whether no further requests are read."""
        return self._closing.is_set()

    def close(self) -> None:
        """Accept no clients, answer the requests that have arrived, and end all sessions."""
        self._closing.set()
        if self._acceptor is not None:
            self._acceptor.close()
        with self._lock:
            clients = dict(self._clients)
        for client in clients.values():
            client.stop_reading()
        deadline = time.monotonic() + _END_S
        for thread, client in clients.items():
            thread.join(max(0.0, deadline - time.monotonic()))
            if thread.is_alive():
                client.end()

    def _add(self, connection: socket.socket) -> None:
        """Serve a connection on a new thread, or close it if there are too many clients."""
        client = VlagentsConnection(self, connection)
        thread = threading.Thread(
            target=self._serve, args=(client,), name="vlagents-client", daemon=True
        )
        with self._lock:
            is_full = len(self._clients) >= self.context.sessions
            if not is_full:
                self._clients[thread] = client
        if is_full:
            logger.warning(
                "vlagents: %d clients are connected, the limit; one was refused",
                self.context.sessions,
            )
            connection.close()
        else:
            thread.start()

    def _serve(self, client: VlagentsConnection) -> None:
        """Serve a client until it disconnects; runs on its own thread."""
        try:
            client.run()
        finally:
            with self._lock:
                del self._clients[threading.current_thread()]


def _columns(robot: RobotArgs, spec: ActionSpec) -> vlagents.RobotColumns:
    """Return the columns of a robot, with the gripper's values of the contract as defaults."""
    gripper = robot.gripper
    if gripper is None:
        return vlagents.RobotColumns(robot.start, robot.stop)
    return vlagents.RobotColumns(
        start=robot.start,
        stop=robot.stop,
        gripper=gripper.column,
        gripper_open=_first(gripper.open, spec.gripper_open, 1.0),
        gripper_closed=_first(gripper.closed, spec.gripper_closed, 0.0),
    )


def _first(*values: float | None) -> float:
    """Return the first value that is not None."""
    return next(value for value in values if value is not None)
