"""A replica's own port for WebSockets: no proxy between the robot and the policy's thread.

The metadata tells a client the port and a path that nobody can guess, so that whoever may not read the one
cannot use the other; where there are keys, a client shows its own once more. Messages are those of `WS /v1/stream`
on the server's port, which stays for clients that do not reach this one. As with local clients the policy's own
thread reads the sockets (see `vlagents_ray.serve.local`), and decodes what they bring.
"""

from __future__ import annotations

import contextlib
import logging
import secrets
import select
import socket
import threading

from websockets.frames import Frame, Opcode
from websockets.http11 import Request as Handshake
from websockets.protocol import State
from websockets.server import ServerProtocol

from vlagents_ray.errors import ConfigError, MalformedMessage, PolicyUnavailable, UnknownApp, VLAgentsError
from vlagents_ray.serve.auth import Caller, token_of
from vlagents_ray.serve.calls import Sender
from vlagents_ray.serve.engine import Engine
from vlagents_ray.serve.local import Admit
from vlagents_ray.serve.origin import require_own_page
from vlagents_ray.serve.porter import Porter
from vlagents_ray.serve.stats import Visit
from vlagents_ray.wire.frames import decode_requests, encode_replies
from vlagents_ray.wire.messages import STREAM_BYTES, STREAM_PATH, Limits, Reply, Request, StreamAddress
from vlagents_ray.wire.probe import answer, is_probe, probed_frame

logger = logging.getLogger(__name__)

_BACKLOG = 128
_READ_BYTES = 256 * 1024
_SLOW_S = 10.0  # for a client to take a reply that its connection does not hold
_STRANGERS = 64  # connections that have not said yet what they want
_UNANSWERED = 256  # messages of one client, at most: what more it sends waits in its connection
_UNSUPPORTED_DATA, _TRY_AGAIN_LATER = 1003, 1013  # close codes

# A peer that vanished is noticed by the kernel: after 20 s of silence it asks every 5 s, three times.
_KEEPALIVE = (("TCP_KEEPIDLE", 20), ("TCP_KEEPINTVL", 5), ("TCP_KEEPCNT", 3), ("TCP_USER_TIMEOUT", 35_000))


class StreamDoor:
    """Listens from `open` on; everything else happens where the batch queue hears."""

    def __init__(
        self,
        engine: Engine,
        limits: Limits,
        host: str,
        ports: tuple[int, int] | None = None,
        admit: Admit | None = None,
    ) -> None:
        """At a port between `ports`, both included; None: any. `ConfigError` if all are taken.

        `admit`, where there are keys, says whose a client's is, or raises that it is none.
        """
        self._admit = admit
        self.engine = engine
        self.limits = limits
        self.path = STREAM_PATH + secrets.token_urlsafe(24)
        self._clients: set[StreamClient] = set()
        self._strangers: dict[StreamClient, None] = {}  # in the order they came
        self._listener = _listen(host, ports)
        self._porter = Porter(self._listener, self._welcome)
        self.address = StreamAddress(self._listener.getsockname()[1], self.path)

    def open(self) -> None:
        """Let clients in; before the engine starts."""
        self.engine.queue.watch(self._listener, self._porter.accept)

    def close(self) -> None:
        """Hang up; after the engine has ended."""
        self._listener.close()
        self._porter.close()
        for client in list(self._clients):
            client.release()

    def admit(self, client: StreamClient, request: Handshake) -> Caller | None:
        """The client knows the path. Whose key it shows, where that is asked; `Unauthorized`, `Forbidden`."""
        caller = None
        headers = {name.lower(): value for name, value in request.headers.raw_items()}
        if self._admit is None:
            require_own_page(headers)
        else:
            caller = self._admit(token_of(headers))
        self._strangers.pop(client, None)
        return caller

    def gone(self, client: StreamClient) -> None:
        """Its connection is closed."""
        self._strangers.pop(client, None)
        self._clients.discard(client)

    def full(self) -> VLAgentsError | None:
        """Why nobody else is let in, if that is so."""
        held, limit = len(self._clients) - len(self._strangers), self.engine.sessions.limit
        if held <= limit:
            return None
        return PolicyUnavailable(f"this replica has {held - 1} streams, its limit of sessions")

    def _welcome(self, connection: socket.socket) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _KEEPALIVE:
            if hasattr(socket, name):
                connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        if len(self._strangers) >= _STRANGERS:
            next(iter(self._strangers)).hang_up()
        client = StreamClient(connection, self)
        self._clients.add(client)
        self._strangers[client] = None
        self.engine.queue.watch(connection, client.ready)


class StreamClient:
    """One connection, with which its sessions end."""

    def __init__(self, connection: socket.socket, door: StreamDoor) -> None:
        self._connection = connection
        self._door = door
        self._protocol = ServerProtocol(max_size=STREAM_BYTES)
        self._sender = Sender(door.engine, "websocket")
        self._sending = threading.Lock()  # of the protocol and of what it sends: replies come from other threads
        self._unsent = bytearray()
        self._slow = False  # a thread sends what the connection does not hold
        self._ended = False
        self._heard = True  # does the batch queue hear it?
        self._paused = False  # not to be heard until some of its messages are answered
        self._unanswered = 0
        self._unanswered_bytes = 0  # with their images decoded

    def ready(self) -> None:
        """Bytes, or the end of the connection, are there."""
        try:
            self._listen()
        except Exception:
            logger.exception("stream client: hung up on it")
            self.hang_up()

    def _listen(self) -> None:
        try:
            data = self._connection.recv(_READ_BYTES)
        except BlockingIOError:
            return
        except OSError as error:
            logger.info("stream client: %s", error)
            data = b""
        with self._sending:
            if data:
                self._protocol.receive_data(data)
            else:
                self._protocol.receive_eof()
            events = self._protocol.events_received()
            self._flush()
        for event in events:
            if isinstance(event, Handshake):
                self._shake_hands(event)
            elif isinstance(event, Frame) and event.opcode in (Opcode.BINARY, Opcode.TEXT, Opcode.CONT):
                self._hear(event)
        if not data or self._protocol.state in (State.CLOSING, State.CLOSED):
            self.hang_up()
            return
        with self._sending:
            self._paused = self._has_much()
        if self._paused:
            self._unhear()

    def hang_up(self) -> None:
        """Forget the client; where the batch queue hears."""
        if not self._ended:
            self._unhear()
            self.release()

    def _unhear(self) -> None:
        if self._heard:
            self._heard = False
            self._door.engine.queue.unwatch(self._connection)

    def _hear_again(self) -> None:
        if not self._ended and not self._heard:
            self._heard = True
            self._door.engine.queue.watch(self._connection, self.ready)

    def _has_much(self) -> bool:
        """In the queue, of which it has not been told the answers. With the lock held."""
        return self._unanswered >= _UNANSWERED or self._unanswered_bytes > self._door.limits.body_bytes

    def release(self) -> None:
        """Close the connection and end its sessions."""
        self._sender.release()
        with self._sending:
            self._ended = True  # its descriptor's number may soon be another's
            self._connection.close()
        self._door.gone(self)

    def _shake_hands(self, request: Handshake) -> None:
        known = secrets.compare_digest(request.path.encode(), self._door.path.encode())
        refused: VLAgentsError | None = None if known else UnknownApp("no such path")
        if known:
            try:
                self._sender = Sender(self._door.engine, "websocket", caller=self._door.admit(self, request))
            except VLAgentsError as error:
                refused = error
        full = self._door.full() if refused is None else None
        with self._sending:
            response = (
                self._protocol.accept(request)
                if refused is None
                else self._protocol.reject(refused.status, f"{refused}\n")
            )
            self._protocol.send_response(response)
            if full is not None and self._protocol.state is State.OPEN:
                self._protocol.send_binary(encode_replies([Reply(error=full)]))
                self._protocol.send_close(_TRY_AGAIN_LATER)
            self._flush()

    def _hear(self, frame: Frame) -> None:
        visit = Visit(self._door.engine.stats, "websocket")
        if frame.opcode is Opcode.CONT or not frame.fin:
            with self._sending:
                self._protocol.fail(_UNSUPPORTED_DATA, "messages in fragments; send each in one frame")
                self._flush()
            return
        message = bytes(frame.data)
        try:
            if frame.opcode is Opcode.TEXT:
                raise MalformedMessage("stream: got a text message, want a binary frame")
            if is_probe(message):
                self._send(self._probed(message))
                return
            requests = decode_requests(message, self._door.limits)
            visit.decoded(requests)
            size = len(message) + sum(map(_image_bytes, requests))
            with self._sending:
                self._unanswered += 1
                self._unanswered_bytes += size
            self._sender.send(requests, lambda replies: self._answer(visit, replies, size))
        except VLAgentsError as error:
            self._send(visit.frame([Reply(error=error)]))

    def _probed(self, message: bytes) -> bytes:
        if (frame := probed_frame(message)) is not None:
            for request in decode_requests(frame, self._door.limits):
                if isinstance(request, Reply) and request.error is not None:
                    raise request.error
        return answer(message)

    def _answer(self, visit: Visit, replies: list[Reply], size: int) -> None:
        with self._sending:
            self._unanswered -= 1
            self._unanswered_bytes -= size
            again = self._paused and not self._has_much()
            if again:
                self._paused = False
        if again:
            self._door.engine.queue.later(self._hear_again)
        self._send(visit.frame(replies))

    def _send(self, message: bytes) -> None:
        with self._sending:
            if not self._ended and self._protocol.state is State.OPEN:
                self._protocol.send_binary(message)
                self._flush()

    def _flush(self) -> None:
        """Send what the protocol has to say. With the lock held."""
        if self._ended:
            return
        self._unsent += b"".join(self._protocol.data_to_send())
        if not self._slow:
            self._push()
            if self._unsent:
                self._slow = True
                threading.Thread(target=self._push_slowly, name="stream-slow", daemon=True).start()
        elif len(self._unsent) > STREAM_BYTES:
            self._cut_off()

    def _push(self) -> None:
        try:
            sent = self._connection.send(self._unsent) if self._unsent else 0
        except BlockingIOError:
            return
        except OSError as error:  # gone: hearing of the end is up to `ready`
            logger.info("stream client: %s", error)
            sent = len(self._unsent)
        del self._unsent[:sent]

    def _push_slowly(self) -> None:
        poller = select.poll()
        poller.register(self._connection, select.POLLOUT)
        while True:
            moving = poller.poll(_SLOW_S * 1e3)
            with self._sending:
                if self._ended:
                    return
                if not moving:
                    self._cut_off()
                self._push()
                if not self._unsent:
                    self._slow = False
                    return

    def _cut_off(self) -> None:
        logger.warning("stream client: takes no replies; cut off")
        self._unsent.clear()
        with contextlib.suppress(OSError):  # gone by itself
            self._connection.shutdown(socket.SHUT_RDWR)


def _image_bytes(request: Request | Reply) -> int:
    if isinstance(request, Reply):
        return 0
    seen = request.history if request.obs is None else [request.obs, *request.history]
    return sum(image.nbytes for obs in seen for image in obs.cameras.values())


def _listen(host: str, ports: tuple[int, int] | None) -> socket.socket:
    first, last = ports or (0, 0)
    for port in range(first, last + 1):
        listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((host, port))
            listener.listen(_BACKLOG)
            listener.setblocking(False)
        except OSError as error:
            listener.close()
            refusal = error
        else:
            return listener
    raise ConfigError(f"stream: cannot listen at {host}, ports {first} to {last} ({refusal}); choose other ones")
