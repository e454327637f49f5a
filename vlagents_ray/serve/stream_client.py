"""One WebSocket at a replica's own port, from its handshake to its end: see `vlagents_ray.serve.stream`."""

from __future__ import annotations

import contextlib
import logging
import select
import socket
import threading
from typing import TYPE_CHECKING

from websockets.frames import Frame, Opcode
from websockets.http11 import Request as Handshake
from websockets.protocol import State
from websockets.server import ServerProtocol

from vlagents_ray.errors import MalformedMessage, VLAgentsError
from vlagents_ray.serve.calls import Sender
from vlagents_ray.serve.stats import Visit
from vlagents_ray.wire.frames import decode_requests, encode_replies
from vlagents_ray.wire.messages import STREAM_BYTES, Reply, Request
from vlagents_ray.wire.probe import answer, is_probe, probed_frame

if TYPE_CHECKING:
    from vlagents_ray.serve.stream import StreamDoor

logger = logging.getLogger(__name__)

_READ_BYTES = 256 * 1024
_SLOW_S = 10.0  # for a client to take a reply that its connection does not hold
_UNANSWERED = 256  # messages of one client, at most: what more it sends waits in its connection
_UNSUPPORTED_DATA, _TRY_AGAIN_LATER = 1003, 1013  # close codes


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
        full = None
        try:
            self._sender = Sender(self._door.engine, "websocket", caller=self._door.admit(self, request))
            full = self._door.full()
            response = self._protocol.accept(request)
        except VLAgentsError as refused:
            response = self._protocol.reject(refused.status, f"{refused}\n")
        with self._sending:
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
        frame = probed_frame(message)
        return answer(message, () if frame is None else decode_requests(frame, self._door.limits))

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
