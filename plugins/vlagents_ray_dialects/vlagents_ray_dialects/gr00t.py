"""Serves GR00T's `PolicyClient`s over ZeroMQ's protocol: a session and a thread for each
connection.
"""

from __future__ import annotations

import contextlib
import logging
import re
import socket
import threading
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

from pydantic import Field

from vlagents_ray.contract import Contract
from vlagents_ray.errors import (
    MalformedMessage,
    MessageTooLarge,
    Overloaded,
    PolicyUnavailable,
    VLAgentsError,
)
from vlagents_ray.registry import require
from vlagents_ray.serve.access.api_keys import Caller, NoKey
from vlagents_ray.serve.access.charges import Charge
from vlagents_ray.serve.config.dialects import MappingSetting, PortConfig
from vlagents_ray.serve.dialects.base import GatewayContext, PortDialect
from vlagents_ray.serve.endpoints.connection import ANSWERS_S, wait_delivered
from vlagents_ray.serve.engine.admission import Admission
from vlagents_ray.wire.mapping import KeyMapping, matches
from vlagents_ray_dialects.acceptor import TICK_S, Acceptor
from vlagents_ray_dialects.client_reader import ClientReader, set_keep_alive, share_of, shut_down
from vlagents_ray_dialects.gateway_sessions import GatewayClient, GatewayClients, internal_error
from vlagents_ray_dialects.messages import gr00t, zmtp
from vlagents_ray_dialects.messages.gr00t import PRESETS, GR00TRequest, Observations

logger = logging.getLogger(__name__)

_FOLDER = re.compile(r"^(video|state|language)\.")
# The frames of a message before its payload. A REQ socket adds an empty frame; a program with a
# DEALER socket chooses the frames.
Envelope = tuple[bytes, ...]
_ENVELOPES: tuple[Envelope, ...] = ((), (b"",))  # the envelopes of directly connected clients
# An envelope within these limits, but with other frames, is answered with an error; a larger
# envelope ends the connection.
_MOST_PARTS, _MOST_PART_BYTES = 4, 256
_HANDSHAKE_S = 5.0  # maximum time of the handshake
_MESSAGE_S = 30.0  # maximum time of a message, from its first byte to its last
_SEND_S = 10.0  # maximum time for a client to accept an answer
_END_S = 3.0  # maximum time for the answers to requests when the dialect ends
_LINGER_S = 1.0  # maximum time for rejecting the requests that have arrived when the dialect ends
_STRANGERS = 64  # maximum number of connections without a valid key; one more ends the oldest
_STRANGER_S = 30.0  # the time within which a connection must send a valid key
_REFUSALS = 64  # the number of messages without a valid key after which a connection is closed
# The time for which a connection is not read after a message without a valid key, since reading a
# key takes time.
_REFUSAL_S = 0.1


class GR00TConnection(GatewayClient):
    """One connection of a client, from its first byte to its last; a thread processes its requests
    in order.

    The connection is a stranger until it sends a valid key, or any message if no key is needed;
    then it is one of the dialect's clients. An idle client becomes a stranger again and has no
    session, but its connection stays open: a client that sends a request while its connection is
    being closed would wait for an answer forever.

    Args:
        dialect: The dialect.
        connection: The connection.
    """

    def __init__(self, dialect: GR00TDialect, connection: socket.socket) -> None:
        super().__init__(dialect.context)
        self._dialect = dialect
        self._connection = connection
        # Whether the keys of the client's last observation were flat, as in N1.5.
        self._mapping, self._flat = nested_mapping(dialect.mapping)

        self._is_robot = dialect.config.priority == "robot"
        self._share = share_of(connection)  # the name of the client's share of the bytes in flight
        self._reader = ClientReader(connection, dialect.of_strangers, robot=True)
        # The time at which a stranger is disconnected, s.
        self._valid_until = time.monotonic() + _STRANGER_S
        self._refused = 0  # the number of messages without a valid key

        self._sending = threading.Lock()  # guards sending and the next field
        self._waiting: Envelope | None = None  # the envelope of the request without an answer
        self._is_last_answer_sent = False  # whether the connection ends with the last answer
        self._answered = threading.Condition()
        self.is_client = False  # whether it is one of the dialect's clients
        self.thread = threading.Thread(target=self._run, name="gr00t-client", daemon=True)

    def end(self) -> None:
        """Make the client a stranger until its next message, so that there is room for another."""
        self.is_client = False
        self._valid_until = float("inf")
        self._dialect.add_stranger(self)

    def stop_reading(self) -> None:
        """Process what has arrived, then end the sessions and the connection."""
        shut_down(self._connection, socket.SHUT_RD)

    def cut_off(self, reason: str) -> None:
        """End the connection immediately; may be called on any thread."""
        logger.info("gr00t: a connection is closed: %s", reason)
        shut_down(self._connection)

    def wait_answered(self, until: float) -> None:
        """Wait until no request is unanswered.

        Args:
            until: The time at which this method gives up, s, of `time.monotonic()`.
        """
        timeout_s = max(0.0, until - time.monotonic())
        with self._answered:
            self._answered.wait_for(lambda: not self._unanswered, timeout_s)

    def refuse_waiting(self, error: VLAgentsError) -> None:
        """Answer a request that is still unanswered with an error, and end the connection; called
        on any thread.

        The connection's thread is waiting for the policy and would not read the client's next
        request. Once the connection has ended, ZeroMQ keeps the next request for the server's
        successor.
        """
        if self._unanswered and self._send(_error(error)):
            self.cut_off("the server is stopping")

    def _run(self) -> None:
        """Process the client's requests until the connection ends; runs on its own thread."""
        try:
            self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            set_keep_alive(self._connection)
            self._greet()
            while not self._is_last_answer_sent:
                head = self._receive_head()
                if head is None:
                    break
                self._process(*head)
        except (VLAgentsError, OSError) as error:
            logger.info("gr00t: disconnected a client: %s", error)
        except Exception:
            logger.exception("gr00t: disconnected a client")
        finally:
            self._dialect.remove(self)
            wait_delivered(self._connection, time.monotonic() + ANSWERS_S)
            shut_down(self._connection)
            self._connection.close()
            self.sessions.close()

    # ZeroMQ's protocol

    def _greet(self) -> None:
        """Exchange the greeting and the command READY with the client."""
        deadline = time.monotonic() + _HANDSHAKE_S
        self._connection.settimeout(_HANDSHAKE_S)
        self._connection.sendall(zmtp.GREETING)

        greeting = bytearray()
        # Old peers send less, and then wait for the server.
        for size in (1, 10, zmtp.GREETING_BYTES - 11):
            greeting += self._read(size, _HANDSHAKE_S, deadline)
            zmtp.check_greeting(greeting)

        self._connection.sendall(zmtp.write_ready())
        flags = zmtp.read_flags(self._read(1, _HANDSHAKE_S, deadline)[0])
        name, properties = self._read_command(flags, deadline)
        if name != b"READY":
            raise MalformedMessage(f"zmtp: expected READY, got {name!r}")
        zmtp.check_ready(properties)

    def _read(self, length: int, silent_s: float, deadline: float) -> memoryview:
        """Read bytes; raise `ConnectionResetError` if the client has disconnected."""
        data = self._reader.read(length, silent_s, deadline)
        if data is None:
            raise ConnectionResetError("the client disconnected")
        return data

    def _read_command(self, flags: zmtp.FrameFlags, deadline: float) -> tuple[bytes, bytes]:
        """Read a command whose flags have arrived; return its name and its content."""
        size = zmtp.read_size(self._read(flags.size_bytes, _MESSAGE_S, deadline))
        if not flags.is_command or size > zmtp.COMMAND_BYTES:
            raise MalformedMessage(
                f"zmtp: expected a command of at most {zmtp.COMMAND_BYTES} bytes, got {size}"
            )
        return zmtp.read_command(self._read(size, _MESSAGE_S, deadline))

    def _receive_head(self) -> tuple[Envelope, int, float] | None:
        """Receive a message up to its payload.

        Returns:
            The envelope of the message, the size of its payload in bytes, and the time by which the
            payload must have arrived, s; None if the client has disconnected.
        """
        envelope: list[bytes] = []
        deadline = float("inf")
        while True:
            try:
                first = self._reader.read(zmtp.HEAD_BYTES, TICK_S, deadline)
            except TimeoutError:
                if not envelope:
                    self._check_idle()
                continue
            if first is None:
                return None

            deadline = min(deadline, time.monotonic() + _MESSAGE_S)
            flags = zmtp.read_flags(first[0])
            if flags.is_command:
                self._process_command(*self._read_command(flags, deadline))
                if not envelope:
                    deadline = float("inf")
                continue

            size = zmtp.read_size(self._read(flags.size_bytes, _MESSAGE_S, deadline))
            if not flags.has_more:
                if size > self._context.limits.body_bytes:
                    raise MessageTooLarge(
                        f"gr00t: expected a message of at most {self._context.limits.body_bytes} "
                        f"bytes, got {size}"
                    )
                return tuple(envelope), size, deadline

            if len(envelope) == _MOST_PARTS or sum(map(len, envelope)) + size > _MOST_PART_BYTES:
                raise MalformedMessage(
                    f"gr00t: expected an envelope of at most {_MOST_PARTS} parts and "
                    f"{_MOST_PART_BYTES} bytes"
                )

            envelope.append(bytes(self._read(size, _MESSAGE_S, deadline)))

    def _check_idle(self) -> None:
        """End the sessions of a client that is idle or whose key is no longer valid; raise an error
        if a stranger has sent no valid key in time.
        """
        if not self.is_client:
            self.sessions.close()
            if time.monotonic() >= self._valid_until:
                raise MessageTooLarge(
                    f"gr00t: no message with a valid key within {_STRANGER_S:g} s"
                )
        elif self._dialect.is_gone(self):
            has_valid_key = self.sessions.refusal() is None
            self.sessions.close()
            self._dialect.remove_client(self)
            self.end()
            if not has_valid_key:
                self._valid_until = time.monotonic() + _STRANGER_S

    def _process_command(self, name: bytes, content: bytes) -> None:
        """Answer a PING; ignore other commands, at a bounded rate."""
        self.sessions.account.charge_control_frame()
        if name == b"PING":
            with self._sending:
                self._connection.settimeout(_SEND_S)
                self._connection.sendall(zmtp.write_pong(content))

    def _process(self, envelope: Envelope, size: int, deadline: float) -> None:
        """Receive the payload of a message, and answer it."""
        with self._sending:
            self._waiting = envelope
        with self._answered:
            self._unanswered = 1

        try:
            try:
                payload = self._read(size, _MESSAGE_S, deadline)
            except Overloaded as error:
                answer = _error(error)
            else:
                answer = self._answer(envelope, payload)
        # The client counts as idle before its answer is sent, as it may be replaced afterwards.
        finally:
            with self._answered:
                self._unanswered = 0
                self._used = time.monotonic()
                self._answered.notify_all()
        self._send(answer)
        time.sleep(self.sessions.account.throttled_s())

    def _send(self, answer: bytes) -> bool:
        """Send the answer to the current request, and return True; return False if the request was
        answered before.
        """
        with self._sending:
            envelope, self._waiting = self._waiting, None
            if envelope is None:
                return False
            self._connection.settimeout(_SEND_S)
            data = zmtp.write_message([*envelope, answer])
            if not self._dialect.is_stopping:
                self._connection.sendall(data)
                return True
            # The end of the connection arrives together with the answer, so that ZeroMQ keeps the
            # client's next request for the server's successor. If the connection ended later, a
            # request that was sent in between would be lost, and its client would wait forever.
            self._is_last_answer_sent = True
            self._connection.sendall(data, socket.MSG_MORE)
            self._connection.shutdown(socket.SHUT_WR)
            return True

    # GR00T's messages

    def _answer(self, envelope: Envelope, payload: memoryview) -> bytes:
        """Return the answer to a message, which may be an error."""
        if payload[: len(gr00t.TORCH_FILE)] == gr00t.TORCH_FILE:
            self._count_refusal()
            logger.warning(
                "gr00t: a client sends files of torch.save, as GR00T N1 does; update it to a "
                "GR00T N1.5 whose PolicyClient or RobotInferenceClient sends msgpack"
            )
            return gr00t.TORCH_ERROR
        try:
            if self._dialect.is_stopping:
                raise _stopping()
            if envelope not in _ENVELOPES:
                self._count_refusal()
                raise MalformedMessage(
                    f"gr00t: expected an empty envelope or none, got one of {len(envelope)} "
                    "parts; connect each client directly, without a ZeroMQ proxy"
                )

            self._identify(payload)
            charge = self.sessions.account.charge()
            admission = self._context.admission
            admission.hold(len(payload), self._is_robot, 0, self._share)
            try:
                charge.require()
                request = gr00t.read_request(payload, self._context.limits)
                return gr00t.pack(self._value(request, charge), packed=request.packed)
            finally:
                admission.release(len(payload), self._share)
        except VLAgentsError as error:
            return _error(error)
        except Exception:  # noqa: BLE001 - logged, and answered
            return gr00t.pack({"error": internal_error("gr00t")})

    def _identify(self, payload: memoryview) -> None:
        """Set the caller of the sessions from the key of a message; raise an error if a key is
        needed and the message has no valid key.
        """
        check = self._context.check
        if isinstance(check, NoKey):
            self.sessions.show(check, None)
        else:
            try:
                key = self._dialect.read_key(payload, of_client=self.is_client)
                caller = check(key)
            except VLAgentsError:
                self._count_refusal()
                raise
            self.sessions.show(caller, key)
            if isinstance(caller, Caller):
                self._share = caller.name
                is_robot_port = self._dialect.config.priority == "robot"
                self._is_robot = is_robot_port and caller.priority != "simulation"

        if not self.is_client:
            self._dialect.add_client(self)
        self._reader.set_sender(self._context.admission, self._share, robot=self._is_robot)

    def _count_refusal(self) -> None:
        """Count a message without a valid key; end the connection after too many."""
        self._refused += 1
        if self._refused >= _REFUSALS:
            self.stop_reading()
        else:
            time.sleep(_REFUSAL_S)

    def _value(self, request: GR00TRequest, charge: Charge) -> Any:
        """Return the value of the reply to a request."""
        if request.endpoint == "ping":
            return {"status": "ok", "message": "Server is running"}
        if request.endpoint == "get_modality_config":
            return gr00t.modality_config(self._modalities(), flat=self._flat)
        if request.endpoint == "reset":
            self.sessions.restart()
            return {}
        return self._act(gr00t.read_observations(request.data), charge)

    def _act(self, batch: Observations, charge: Charge) -> Any:
        """Return the reply to a request `get_action`."""
        mapping, contract = self._mapping, self._context.contract
        self._flat = batch.flat

        observations = []
        instructions = []
        for theirs in batch.each:
            single = gr00t.at_its_time_step(theirs)
            obs, instruction = mapping.obs(single, self._context.limits, contract)
            observations.append(obs)
            instructions.append(instruction)

        if not self.sessions.begun:
            mapping.warn_of_unread_cameras(gr00t.at_its_time_step(batch.each[0]), "gr00t")
        acts = self.sessions.act_batch(charge, observations, instructions)

        spec = None if contract is None else contract.action
        info = {"done": [act.done for act in acts], "timing": acts[0].info.get("timing", {})}
        try:
            actions = [mapping.actions(act.action, spec) for act in acts]
            return gr00t.write_actions(actions, batch, info)
        except VLAgentsError:
            self.sessions.restart()  # a repeated message must not be a second act
            raise

    def _modalities(self) -> dict[str, tuple[list[str], list[int]]]:
        """Return the keys and the time steps of each modality, with the client's names."""
        mapping, contract = self._mapping, self._context.contract
        contract = contract or Contract()

        cameras = [(name, camera.key) for name, camera in mapping.cameras.items()]
        state: list[tuple[str, str]] = []
        for name, state_keys in mapping.state.items():
            state += [(name, state_key.key) for state_key in state_keys]

        chunk = contract.chunk or 1
        return {
            "video": (_client_names(cameras, contract.cameras or {}), [0]),
            "state": (_client_names(state, contract.state or {}), [0]),
            "action": (list(mapping.action) or ["action"], list(range(chunk))),
            "language": ([gr00t.TEXT_KEY], [0]),
        }


def _error(error: VLAgentsError) -> bytes:
    """Return the answer with an error."""
    return gr00t.pack({"error": f"{error.code}: {error}"})


def _stopping() -> PolicyUnavailable:
    """Return the error of a request that arrives while the server stops."""
    return PolicyUnavailable("the server is stopping; send the request again to its successor")


def _client_names(entries: Iterable[tuple[str, str]], needed: Iterable[str]) -> list[str]:
    """Return the names that the client uses for the policy's cameras or states.

    Args:
        entries: The names and keys in the mapping; `*` in a key keeps the policy's names.
        needed: The names of the policy.
    """
    client_names: dict[str, None] = {}  # an ordered set
    for pattern, key in entries:
        if "*" not in key:
            client_names[key.rpartition("/")[2]] = None
            continue
        for name in needed:
            if matches(name, pattern):
                client_names[name] = None
    return list(client_names)


def nested_mapping(mapping: KeyMapping) -> tuple[KeyMapping, bool]:
    """Convert the keys of a mapping to the nested keys that `gr00t.at_its_time_step` returns.

    Args:
        mapping: The mapping, whose keys may be flat as in N1.5, such as `video.front`.

    Returns:
        The mapping with nested keys, and whether its keys were flat.
    """

    def folders(key: str) -> str:
        """Return the nested form of a key."""
        return "|".join(_FOLDER.sub(r"\1/", alternative) for alternative in key.split("|"))

    cameras = {}
    for name, camera in mapping.cameras.items():
        cameras[name] = replace(camera, key=folders(camera.key))

    state = {}
    for name, state_keys in mapping.state.items():
        nested_keys = [replace(state_key, key=folders(state_key.key)) for state_key in state_keys]
        state[name] = tuple(nested_keys)

    action = {name.removeprefix("action."): columns for name, columns in mapping.action.items()}
    nested = replace(
        mapping,
        cameras=cameras,
        state=state,
        gripper=mapping.gripper and replace(mapping.gripper, key=folders(mapping.gripper.key)),
        instruction=mapping.instruction and f"language/{gr00t.TEXT_KEY}",
        action=action,
    )
    return nested, nested.cameras != mapping.cameras or nested.state != mapping.state


class GR00TDialectConfig(PortConfig):
    """The settings of GR00T's protocol over ZeroMQ, which its `PolicyServer` also serves."""

    mapping: MappingSetting = "gr00t"
    port: int = Field(default=5555, ge=1, le=65535)


class GR00TDialect(PortDialect):
    """GR00T's protocol, with one thread and one session per connection."""

    Config = GR00TDialectConfig
    clients = "GR00T"
    summary = (
        "A session is the connection, until it is idle; `reset` begins an episode, and a batch of "
        "B is B sessions. `api_token` is the API key. An error is a map with `error`."
    )
    requires = ("msgpack",)
    presets = PRESETS

    def __init__(self, name: str, config: GR00TDialectConfig, context: GatewayContext) -> None:
        super().__init__(name, config, context)
        # Limits the bytes of strangers' incomplete messages. One address may have half of these
        # bytes, which is the size of the largest message.
        self.of_strangers = Admission(2 * context.limits.body_bytes)
        self._clients: GatewayClients[int, GR00TConnection] = GatewayClients(context)  # by `id`
        self._lock = threading.Lock()  # guards the next two fields
        self._connections: set[GR00TConnection] = set()
        # The connections that are not clients, the oldest first.
        self._strangers: dict[GR00TConnection, None] = {}
        self._stopping = threading.Event()  # whether new requests are rejected
        self._key_reader = ThreadPoolExecutor(1, "gr00t-keys")
        self._acceptor: Acceptor | None = None

    @property
    def is_stopping(self) -> bool:
        """Whether requests are rejected, since the server is stopping."""
        return self._stopping.is_set()

    def serve(self, listener: socket.socket) -> None:
        require("msgpack")
        self._acceptor = Acceptor("gr00t", listener, self._add)

    def alive(self) -> bool:
        return self._acceptor is not None and self._acceptor.alive()

    def close(self) -> None:
        """Answer the requests that have arrived, reject later ones, and end all connections.

        A client of this protocol has no timeout, so each request needs an answer. A connection
        therefore ends with the answer to its next request, or after a second without a request.
        """
        self._stopping.set()
        if self._acceptor is not None:
            self._acceptor.close()

        until = time.monotonic() + _END_S
        with self._lock:
            connections = list(self._connections)
        for connection in connections:
            connection.wait_answered(until)
        for connection in connections:
            with contextlib.suppress(OSError):  # the client has disconnected
                connection.refuse_waiting(_stopping())

        until = time.monotonic() + _LINGER_S
        for connection in connections:
            connection.thread.join(max(0.0, until - time.monotonic()))
        for connection in connections:
            connection.stop_reading()

        until = time.monotonic() + _LINGER_S
        for connection in connections:
            connection.thread.join(max(0.0, until - time.monotonic()))
            connection.cut_off("the server is stopping")
        self._key_reader.shutdown(wait=False)

    def read_key(self, payload: memoryview, *, of_client: bool) -> str | None:
        """Return the API key in a message; None if it has none.

        The keys of strangers are all read on the same thread, since the heap of each reading thread
        keeps the memory of the largest message.

        Args:
            payload: The message.
            of_client: Whether the message is from one of the dialect's clients.
        """
        if of_client:
            return gr00t.read_token(payload, self.context.limits)
        return self._key_reader.submit(gr00t.read_token, payload, self.context.limits).result()

    def add_client(self, connection: GR00TConnection) -> None:
        """Register a connection with a valid key as a client.

        Raises:
            PolicyUnavailable: There are too many clients.
        """
        self._clients.add(id(connection), lambda: connection)
        connection.is_client = True
        with self._lock:
            self._strangers.pop(connection, None)

    def is_gone(self, client: GR00TConnection) -> bool:
        """Return whether a client is idle, or its key is no longer valid."""
        return self._clients.is_gone(client)

    def remove_client(self, client: GR00TConnection) -> None:
        """Remove a client, so that another client can be added."""
        self._clients.remove(id(client))

    def remove(self, connection: GR00TConnection) -> None:
        """Remove a connection that ends."""
        self.remove_client(connection)
        with self._lock:
            self._strangers.pop(connection, None)
            self._connections.discard(connection)

    def add_stranger(self, connection: GR00TConnection) -> None:
        """Add an open connection without a valid key; if there are too many, end the oldest."""
        with self._lock:
            if connection not in self._connections:
                return
            oldest = next(iter(self._strangers)) if len(self._strangers) >= _STRANGERS else None
            if oldest is not None:
                del self._strangers[oldest]
            self._strangers[connection] = None
        if oldest is not None:
            oldest.cut_off(f"{_STRANGERS} connections are without a valid key")

    def _add(self, connection: socket.socket) -> None:
        """Serve a new connection."""
        client = GR00TConnection(self, connection)
        with self._lock:
            self._connections.add(client)
        self.add_stranger(client)
        client.thread.start()
