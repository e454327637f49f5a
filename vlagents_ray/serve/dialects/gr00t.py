"""GR00T's `PolicyClient`s over ZeroMQ: one ROUTER socket for all clients, and a session and a thread for each."""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import re
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

from pydantic import Field

from vlagents_ray.contract import Contract
from vlagents_ray.errors import MalformedMessage, PolicyUnavailable, VLAgentsError
from vlagents_ray.registry import require
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.config.dialects import MappingSetting, PortConfig
from vlagents_ray.serve.dialects.base import GatewayContext, PortDialect
from vlagents_ray.serve.dialects.gateway_sessions import GatewayClient, GatewayClients, internal_error
from vlagents_ray.wire import gr00t
from vlagents_ray.wire.gr00t import PRESETS, GR00TRequest, Observations
from vlagents_ray.wire.mapping import KeyMapping, matches

logger = logging.getLogger(__name__)

_FOLDER = re.compile(r"^(video|state|language)\.")
WAITING = 4  # maximum number of waiting requests of one client; a REQ socket sends one at a time
# The parts of a message before its payload: ZeroMQ's identity of the connection, and those that a client adds. A REQ
# socket adds an empty part, a DEALER socket whatever its program chooses.
Envelope = tuple[bytes, ...]
_ENVELOPES: tuple[list[bytes], ...] = ([], [b""])  # the parts that a client may add
_MOST_PARTS, _MOST_PART_BYTES = 4, 256  # of an envelope that is answered with an error; others are ignored
_HEARTBEAT_MS = 10_000
_TICK_MS = 500
_END_S = 3.0
_LINGER_MS = 1000  # time for sending the last answers
_STRANGERS = 64  # maximum number of connections without a valid key
_STRANGERS_MS = 50  # period at which their bytes are counted
_STRANGER_S = 30.0  # time within which a connection must send a valid key
_REFUSALS = 64  # messages without a valid key after which a connection is closed
_RECEIVED = struct.Struct("<Q")  # `tcpi_bytes_received` in Linux' `struct tcp_info`
_RECEIVED_AT = 128


class GR00TConnection(GatewayClient):
    """One client's requests, which are processed one after the other on a separate thread."""

    def __init__(self, context: GatewayContext, mapping: KeyMapping, answer: Callable[[Envelope, bytes], None]) -> None:
        """Start the client's thread, which calls `answer` with the envelope of a request and the answer to it."""
        super().__init__(context)
        self._mapping, self._flat = nested_mapping(mapping)  # flat: whether the client's last keys were N1.5's
        self._send = answer
        self._requests: queue.SimpleQueue[tuple[Envelope, bytes] | None] = queue.SimpleQueue()
        self._waiting: list[Envelope] = []  # the envelopes of the requests without an answer
        self._lock = threading.Lock()
        self.thread = threading.Thread(target=self._run, name="gr00t-client", daemon=True)
        self.thread.start()

    def put(self, envelope: Envelope, payload: bytes) -> bool:
        """Queue a request; return False if too many are waiting.

        Raises:
            Overloaded: The requests of all clients leave no memory for it.
        """
        with self._lock:
            if self._unanswered >= WAITING:
                return False
            self._context.admission.hold(len(payload), True, 0)
            self._unanswered += 1
            self._waiting.append(envelope)
        self._requests.put((envelope, payload))
        return True

    def end(self) -> None:
        self._requests.put(None)

    def unanswered(self) -> list[Envelope]:
        """Return the envelopes of the requests without an answer, which then get none from this client's thread."""
        with self._lock:
            waiting, self._waiting = self._waiting, []
        return waiting

    def _run(self) -> None:
        while (request := self._requests.get()) is not None:
            envelope, payload = request
            message = self._answer(payload)
            self._context.admission.release(len(payload))
            with self._lock:
                self._unanswered -= 1
                self._used = time.monotonic()
                is_waiting = envelope in self._waiting
                if is_waiting:
                    self._waiting.remove(envelope)
            if is_waiting:
                self._send(envelope, message)
            time.sleep(self.sessions.throttled_s())
        self.sessions.close()

    def _answer(self, payload: bytes) -> bytes:
        try:
            check = self._context.check
            if isinstance(check, NoKey):
                self.sessions.show(check, None)
            else:
                key = gr00t.read_token(payload, self._context.limits)
                self.sessions.show(check(key), key)
            self.sessions.begin()
            request = gr00t.read_request(payload, self._context.limits)
            return gr00t.pack(self._value(request), packed=request.packed)
        except VLAgentsError as error:
            return gr00t.pack({"error": f"{error.code}: {error}"})
        except Exception:  # noqa: BLE001 - logged, and answered
            return gr00t.pack({"error": internal_error("gr00t")})

    def _value(self, request: GR00TRequest) -> Any:
        if request.endpoint == "ping":
            return {"status": "ok", "message": "Server is running"}
        if request.endpoint == "get_modality_config":
            return gr00t.modality_config(self._modalities(), flat=self._flat)
        if request.endpoint == "reset":
            self.sessions.restart()
            return {}
        return self._act(gr00t.read_observations(request.data))

    def _act(self, asked: Observations) -> Any:
        mapping, contract = self._mapping, self._context.contract
        self._flat = asked.flat
        seen = [mapping.obs(gr00t.newest(one), self._context.limits, contract) for one in asked.each]
        if not self.sessions.begun:
            mapping.warn_of_unread_cameras(gr00t.newest(asked.each[0]), "gr00t")
        acts = self.sessions.act_batch([obs for obs, _ in seen], [text for _, text in seen])
        spec = None if contract is None else contract.action
        info = {"done": [act.done for act in acts]} | {"timing": acts[0].info.get("timing", {})}
        return gr00t.write_actions([mapping.actions(act.action, spec) for act in acts], asked, info)

    def _modalities(self) -> dict[str, tuple[list[str], list[int]]]:
        mapping, contract = self._mapping, self._context.contract
        contract = contract or Contract()
        cameras = [(name, camera.key) for name, camera in mapping.cameras.items()]
        state = [(name, part.key) for name, parts in mapping.state.items() for part in parts]
        chunk = contract.chunk or 1
        return {
            "video": (_theirs(cameras, contract.cameras or {}), [0]),
            "state": (_theirs(state, contract.state or {}), [0]),
            "action": (list(mapping.action) or ["action"], list(range(chunk))),
            "language": ([gr00t.TEXT_KEY], [0]),
        }


def _stopping() -> PolicyUnavailable:
    return PolicyUnavailable("the server is stopping; send the request again to its successor")


def _theirs(entries: Iterable[tuple[str, str]], needed: Iterable[str]) -> list[str]:
    """Return the client's names of the policy's cameras or states; `*` in the mapping keeps the policy's names."""
    found: dict[str, None] = {}
    for ours, key in entries:
        names = needed if "*" in key else [key.rpartition("/")[2]]
        found |= dict.fromkeys(name for name in names if "*" not in key or matches(name, ours))
    return list(found)


def nested_mapping(mapping: KeyMapping) -> tuple[KeyMapping, bool]:
    """Return a mapping with the keys of `gr00t.newest`, and whether it had N1.5's flat keys, such as `video.front`."""

    def folders(key: str) -> str:
        return "|".join(_FOLDER.sub(r"\1/", one) for one in key.split("|"))

    nested = replace(
        mapping,
        cameras={name: replace(one, key=folders(one.key)) for name, one in mapping.cameras.items()},
        state={name: tuple(replace(one, key=folders(one.key)) for one in of) for name, of in mapping.state.items()},
        gripper=mapping.gripper and replace(mapping.gripper, key=folders(mapping.gripper.key)),
        instruction=mapping.instruction and f"language/{gr00t.TEXT_KEY}",
        action={name.removeprefix("action."): one for name, one in mapping.action.items()},
    )
    return nested, nested.cameras != mapping.cameras or nested.state != mapping.state


class GR00TDialectConfig(PortConfig):
    """The settings of GR00T's ZeroMQ protocol, that of its `PolicyServer`."""

    mapping: MappingSetting = "gr00t"
    port: int = Field(default=5555, ge=1, le=65535)


class GR00TDialect(PortDialect):
    """GR00T's protocol; one thread owns the ROUTER socket, and each client has a separate thread."""

    Config = GR00TDialectConfig
    clients = "GR00T"
    summary = (
        "A session is the client, until it is idle; `reset` begins an episode, and a batch of B is B "
        "sessions. `api_token` is the API key. An error is a map with `error`."
    )
    requires = ("zmq", "msgpack")
    presets = PRESETS

    def __init__(self, name: str, config: GR00TDialectConfig, context: GatewayContext) -> None:
        super().__init__(name, config, context)
        self._clients: GatewayClients[bytes, GR00TConnection] = GatewayClients(context)  # by identity
        self._looked = float("-inf")  # time of the last check of all clients, s
        self._answers: queue.SimpleQueue[tuple[Envelope, bytes]] = queue.SimpleQueue()
        self._bell, self._ring = socket.socketpair()
        self._ring.setblocking(False)
        self._stopping = threading.Event()  # whether new requests are refused
        self._closing = threading.Event()  # whether all requests are answered
        self._thread: threading.Thread | None = None
        self._strangers: _Strangers | None = None

    def serve(self, listener: socket.socket) -> None:
        require("zmq"), require("msgpack")
        listener.listen()
        self._thread = threading.Thread(target=self._run, args=(listener,), name="gr00t", daemon=True)
        self._thread.start()

    def alive(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def close(self) -> None:
        self._stopping.set()  # a client of this protocol waits for ever for an answer that does not come
        until = time.monotonic() + _END_S
        for client in self._clients.end_all():
            client.thread.join(max(0.0, until - time.monotonic()))
            for envelope in client.unanswered():
                error = _stopping()
                self.answer(envelope, gr00t.pack({"error": f"{error.code}: {error}"}))
        self._closing.set()
        self._wake()
        if self._thread is not None:
            self._thread.join(_END_S)
        self._bell.close()
        self._ring.close()

    def answer(self, envelope: Envelope, message: bytes) -> None:
        """Send a message to a client, from any thread."""
        self._answers.put((envelope, message))
        self._wake()

    def _wake(self) -> None:
        with contextlib.suppress(OSError):  # the thread is already being woken, or the dialect is closed
            self._ring.send(b".")

    def _run(self, listener: socket.socket) -> None:
        zmq = require("zmq")
        context = zmq.Context(io_threads=1)
        router, authenticator = context.socket(zmq.ROUTER), context.socket(zmq.REP)
        try:
            router.setsockopt(zmq.LINGER, 0)
            router.setsockopt(zmq.MAXMSGSIZE, self.context.limits.body_bytes)
            router.setsockopt(zmq.RCVHWM, WAITING)
            router.setsockopt(zmq.SNDHWM, WAITING)  # drops replies that a client does not read
            router.setsockopt(zmq.HEARTBEAT_IVL, _HEARTBEAT_MS)
            router.setsockopt(zmq.HEARTBEAT_TIMEOUT, 3 * _HEARTBEAT_MS)
            router.setsockopt(zmq.HANDSHAKE_IVL, _HEARTBEAT_MS)
            # With an authenticator ZMQ refuses peers with protocols before 3.0, whose dead connections it would retain.
            authenticator.bind("inproc://zeromq.zap.01")
            router.setsockopt(zmq.ZAP_DOMAIN, b"gr00t")
            router.setsockopt(zmq.USE_FD, listener.fileno())
            host, port = listener.getsockname()[:2]
            router.bind(f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}")
            listener.detach()  # ZMQ owns it now and closes it with the ROUTER socket
            self._strangers = strangers = _Strangers(router, zmq, port, self.context.limits.body_bytes)
            poller = zmq.Poller()
            poller.register(strangers.monitor, zmq.POLLIN)
            poller.register(router, zmq.POLLIN)
            poller.register(authenticator, zmq.POLLIN)
            poller.register(self._bell, zmq.POLLIN)
            while not self._closing.is_set():
                ready = dict(poller.poll(_STRANGERS_MS if strangers else _TICK_MS))
                if strangers.monitor in ready:
                    strangers.note_events()
                strangers.end_overdue()
                if self._bell.fileno() in ready:
                    self._bell.recv(4096)
                    self._send(router, zmq)
                if authenticator in ready:  # it accepts every peer, as API keys are in the messages
                    version, request, *_ = authenticator.recv_multipart()
                    authenticator.send_multipart([version, request, b"200", b"", b"", b""])
                if router in ready:
                    self._receive(router, zmq)
                # End the sessions of idle clients and of clients whose key is no longer valid, twice a second.
                now = time.monotonic()
                if now - self._looked >= _TICK_MS / 1e3:
                    self._looked = now
                    self._clients.forget_quiet()
            self._receive(router, zmq)
            self._send(router, zmq)
        except Exception:
            logger.exception("gr00t: the dialect has failed, and accepts no more clients")
        finally:
            listener.close()
            if self._strangers is not None:
                self._strangers.close()
            router.close(linger=_LINGER_MS)
            authenticator.close()
            context.destroy(linger=0)

    def _send(self, router: Any, zmq: Any) -> None:
        while not self._answers.empty():  # no other thread takes from it
            envelope, message = self._answers.get()
            with contextlib.suppress(zmq.ZMQError):  # the client is gone, or does not read
                router.send_multipart([*envelope, message], zmq.NOBLOCK)

    def _receive(self, router: Any, zmq: Any) -> None:
        for _ in range(64):  # then replies are sent again
            try:
                parts = router.recv_multipart(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                return
            except zmq.ZMQError as error:
                logger.info("gr00t: a message was lost: %s", error)
                return
            *envelope_parts, payload = parts
            descriptor: int = payload.get(zmq.SRCFD)
            sizes = [len(part) for part in envelope_parts]
            if not 0 < len(sizes) <= _MOST_PARTS or sum(sizes) > _MOST_PART_BYTES:
                self._refuse(descriptor)
                continue
            envelope = tuple(part.bytes for part in envelope_parts)
            try:
                self._take(envelope, payload, descriptor)
            except VLAgentsError as error:
                self.answer(envelope, gr00t.pack({"error": f"{error.code}: {error}"}))

    def _take(self, envelope: Envelope, payload: Any, descriptor: int) -> None:
        """Pass a message to its client, which is created once a message of its connection has a valid key."""
        if self._stopping.is_set():
            raise _stopping()
        identity, *added = envelope
        if added not in _ENVELOPES:
            self._refuse(descriptor)
            raise MalformedMessage(
                f"gr00t: got an envelope of {len(added)} parts, want none or an empty one; connect each client "
                f"directly, without a ZeroMQ proxy"
            )
        client = self._clients.get(identity)
        if client is None or (self._strangers is not None and self._strangers.includes(descriptor)):
            self._require_key(payload.buffer, descriptor)
        if client is None:
            client = self._clients.add(identity, lambda: GR00TConnection(self.context, self.mapping, self.answer))
        if not client.put(envelope, payload.bytes):
            raise MalformedMessage("wait for the answer before the next request")

    def _require_key(self, payload: memoryview, descriptor: int) -> None:
        """Raise an error unless a message has a valid key, or needs none; its connection is then no stranger."""
        check = self.context.check
        if not isinstance(check, NoKey):
            try:
                check(gr00t.read_token(payload, self.context.limits))
            except VLAgentsError:
                self._refuse(descriptor)
                raise
        if self._strangers is not None:
            self._strangers.admit(descriptor)

    def _refuse(self, descriptor: int) -> None:
        if self._strangers is not None:
            self._strangers.refuse(descriptor)


class _Strangers:
    """The connections without a valid key so far; limits their number, their duration and their bytes.

    ZeroMQ buffers a message of any peer until it is complete, with one limit for all peers, and the key is in the
    message. ZeroMQ reports the descriptor of each connection; shutting down a duplicate ends the connection.
    """

    def __init__(self, router: Any, zmq: Any, port: int, most_bytes: int) -> None:
        """Monitor connections; `most_bytes` limits the bytes of all these connections together, and of one message."""
        self.monitor = router.get_monitor_socket(zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED)
        self._router, self._zmq = router, zmq
        self._port, self._most_bytes = port, most_bytes
        self._since: dict[int, tuple[socket.socket, float]] = {}  # by the descriptor in ZeroMQ, oldest first
        self._refused: dict[int, int] = {}  # number of refused messages, by descriptor

    def __len__(self) -> int:
        return len(self._since)

    def note_events(self) -> None:
        """Add the connections that ZeroMQ has accepted, and drop those that have ended."""
        parse = require("zmq.utils.monitor").parse_monitor_message
        while self.monitor.poll(0):
            event = parse(self.monitor.recv_multipart())
            self._drop(event["value"])
            if event["event"] == self._zmq.EVENT_ACCEPTED:
                self._add(event["value"])

    def includes(self, descriptor: int) -> bool:
        """Return whether no message of a connection has had a valid key, or a later one had none."""
        return descriptor in self._since

    def admit(self, descriptor: int) -> None:
        """Drop a connection: one of its messages has a valid key."""
        self._drop(descriptor)

    def refuse(self, descriptor: int) -> None:
        """Count a refused message of a connection, and close the connection after too many."""
        if descriptor not in self._since:
            self._add(descriptor)
        self._refused[descriptor] = self._refused.get(descriptor, 0) + 1
        if self._refused[descriptor] >= _REFUSALS and descriptor in self._since:
            self._end(descriptor, f"{_REFUSALS} messages without a valid key")

    def end_overdue(self) -> None:
        """End connections that take too long, and the largest while all are too large."""
        late = time.monotonic() - _STRANGER_S
        sizes = {one: _received(connection) for one, (connection, _) in self._since.items()}
        for descriptor, (_, since) in list(self._since.items()):
            if since < late:
                self._end(descriptor, "no message with a valid key in time")
                del sizes[descriptor]
        while sum(sizes.values()) > self._most_bytes:
            largest = max(sizes, key=sizes.__getitem__)
            self._end(largest, f"{sizes.pop(largest)} bytes without a valid key")

    def close(self) -> None:
        """Drop all connections, which end with the ROUTER socket."""
        for descriptor in list(self._since):
            self._drop(descriptor)
        self._router.disable_monitor()

    def _add(self, descriptor: int) -> None:
        try:
            connection = socket.socket(fileno=os.dup(descriptor))
        except OSError:  # the connection has already ended
            return
        if connection.family not in (socket.AF_INET, socket.AF_INET6) or connection.getsockname()[1] != self._port:
            connection.close()  # it has ended, and its descriptor belongs to another file
            return
        if len(self._since) >= _STRANGERS:
            self._end(next(iter(self._since)), f"{_STRANGERS} connections are without a valid key")
        self._since[descriptor] = connection, time.monotonic()

    def _end(self, descriptor: int, reason: str) -> None:
        logger.info("gr00t: a connection is closed: %s", reason)
        with contextlib.suppress(OSError):  # the client has already closed it
            self._since[descriptor][0].shutdown(socket.SHUT_RDWR)
        self._drop(descriptor)

    def _drop(self, descriptor: int) -> None:
        self._refused.pop(descriptor, None)
        if (known := self._since.pop(descriptor, None)) is not None:
            known[0].close()


def _received(connection: socket.socket) -> int:
    try:
        info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _RECEIVED_AT + _RECEIVED.size)
    except OSError:  # the connection has ended
        return 0
    (size,) = _RECEIVED.unpack_from(info, _RECEIVED_AT)
    return int(size)
