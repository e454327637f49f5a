"""The frames of one WebSocket of uvicorn, between its socket and uvicorn's own protocol.

The limits of a key and of the replica's memory apply to whole messages. Below them, uvicorn buffers
up to 16 MiB of a message, inflates compressed ones, and parses and answers control frames; and
Serve takes each complete message from uvicorn at once, whether or not the application reads it.
`IncomingFrames` therefore passes bytes on to uvicorn only

- as long as few messages wait for the application,
- as long as the client's key is within its rate, as its messages would only wait to be refused,
- if the memory in flight has room for the messages that wait, and for the one that arrives, and
- if control frames and small fragments are rare.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from starlette.types import Receive
from websockets.frames import Close, Frame, Opcode

from vlagents_ray.errors import VLAgentsError
from vlagents_ray.protocol.websocket_frames import (
    CONTROL_FRAMES,
    CONTROL_FRAMES_PER_S,
    HEAD_BYTES,
    frame_size,
)
from vlagents_ray.serve.access.api_keys import Caller, Identity
from vlagents_ray.serve.engine.admission import Admission, ArrivingBytes
from vlagents_ray.serve.token_bucket import TokenBucket

logger = logging.getLogger(__name__)

SCOPE_KEY = "vlagents_ray.incoming_frames"  # key of the `IncomingFrames` in the ASGI scope
_WAITING_MESSAGES = 16  # maximum number of messages that the application has not read
_FRAGMENT_BYTES = 16 * 1024  # size below which a fragment of a message counts like a control frame
_EXTENSIONS = "Sec-WebSocket-Extensions"
_CONTROL_OPCODES = 0x08  # the bit of all opcodes of control frames
_POLICY_VIOLATION, _TRY_AGAIN_LATER = 1008, 1013  # WebSocket close codes


class IncomingFrames(asyncio.Protocol):
    """Passes the bytes of one connection on to uvicorn's protocol, see the module.

    All methods run on the event loop of the connection, except those that say otherwise.
    """

    def __init__(
        self, protocol: Any, transport: asyncio.Transport, discard_rest: Callable[[], None]
    ) -> None:
        """Take the place of uvicorn's `protocol` at its `transport`; nothing is read until `open`.

        Args:
            discard_rest: Discards bytes that still arrive when the connection is closed, so that
                the client reads the close code.
        """
        self._protocol = protocol
        self._transport = transport
        self._discard_rest = discard_rest
        self._loop = asyncio.get_running_loop()

        self._unparsed = b""  # received bytes that were not passed on: at most those of one read
        self._frame_left = 0  # bytes of the current frame that were not passed on
        self._is_data = False  # whether the current frame belongs to a message
        self._is_last = False  # whether the current frame is the last one of its message
        self._has_message = False  # whether a complete message has arrived
        self._partial_bytes = 0  # size of the received part of a message
        # Sizes of the messages that the application has not read.
        self._waiting: deque[int] = deque()
        self._control_frames = TokenBucket(CONTROL_FRAMES_PER_S, time.monotonic(), CONTROL_FRAMES)
        # Time since which a part of a message or frame waits for its rest, s.
        self._arriving_since: float | None = None
        self._ended = False

        self._caller: Caller | None = None
        # Ends a pause for the rate of the key; None while there is no such pause.
        self._end_of_throttling: asyncio.TimerHandle | None = None
        self._memory: ArrivingBytes | None = None

        transport.pause_reading()
        transport.set_protocol(self)

    @classmethod
    def attach(cls, receive: Receive, discard_rest: Callable[[], None]) -> IncomingFrames | None:
        """Return the frames of the WebSocket with this `receive`, without compression; None if
        uvicorn is not below.

        ASGI exposes no connection; uvicorn's bound method `receive` has its protocol.
        """
        protocol: Any = getattr(receive, "__self__", None)
        transport = getattr(protocol, "transport", None)
        if transport is None or transport.is_closing():
            return None
        protocol.conn.extensions = []
        if _EXTENSIONS in protocol.response.headers:
            del protocol.response.headers[_EXTENSIONS]
        return cls(protocol, transport, discard_rest)

    def __reduce__(self) -> tuple[type[None], tuple[()]]:
        """Pickle as None: Serve's own proxy sends the scope to another process."""
        return type(None), ()

    # The middleware that identifies the caller calls these methods, on any thread.

    def supervise(self, caller: Identity, admission: Admission | None) -> None:
        """Count messages for the key of `caller`, and their bytes as in flight; call this before
        `open`.
        """
        is_robot = True
        key = None
        if isinstance(caller, Caller):
            self._caller = caller
            is_robot = caller.priority != "simulation"
            key = caller.name
        if admission is not None:
            self._memory = ArrivingBytes(admission, key, is_robot, self._give_up)

    def taken(self) -> None:
        """Record that the application has read a message."""
        with contextlib.suppress(RuntimeError):  # the event loop is closed
            self._loop.call_soon_threadsafe(self._note_taken)

    async def end(self, code: int, reason: str) -> None:
        """End a connection with a part of a message, behind which uvicorn would not find the
        client's close frame.
        """

        async def end() -> None:
            self._discard_rest()
            self._end(code, reason)

        await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(end(), self._loop))

    @property
    def arriving_s(self) -> float:
        """Time since which a part of a message waits for its rest, s; 0 if there is none."""
        since = self._arriving_since
        return 0.0 if since is None else time.monotonic() - since

    # The server's own middleware and the transport call these methods.

    def open(self) -> None:
        """Begin to read, once the WebSocket is accepted."""
        if not self._transport.is_closing():
            self._transport.resume_reading()

    def data_received(self, data: bytes) -> None:
        """Pass bytes on as far as the limits allow it."""
        if not self._ended:
            self._unparsed = self._unparsed + data if self._unparsed else data
            self._pass_on()

    def eof_received(self) -> None:
        """Pass the end of the client's bytes on."""
        self._protocol.eof_received()

    def pause_writing(self) -> None:
        """Pass on that the client does not read."""
        self._protocol.pause_writing()

    def resume_writing(self) -> None:
        """Pass on that the client reads again."""
        self._protocol.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        """Free the memory of a connection that has ended.

        A part of a message counts as a message of its key, and so does a connection without any
        message.
        """
        if self._partial_bytes or not self._has_message:
            self._charge()
        self._end_reading()
        self._protocol.connection_lost(exc)

    def _note_taken(self) -> None:
        if self._waiting:
            self._waiting.popleft()
        if not self._ended:
            self._pass_on()

    def _is_paused(self) -> bool:
        """Return whether the server must not read now."""
        return self._end_of_throttling is not None or len(self._waiting) >= _WAITING_MESSAGES

    def _throttle(self) -> None:
        """Pause the connection if the client's key is over its rate, until it no longer is."""
        if self._caller is None or self._is_paused():
            return
        wait_s = self._caller.throttled_s()
        if wait_s > 0:
            self._end_of_throttling = self._loop.call_later(wait_s, self._unthrottle)

    def _unthrottle(self) -> None:
        self._end_of_throttling = None
        if not self._ended:
            self._pass_on()

    def _pass_on(self) -> None:
        """Pass received bytes on to uvicorn, frame by frame, until there are none or a limit is
        reached.
        """
        while self._unparsed and not self._ended:
            self._throttle()
            if self._is_paused():
                break
            if not self._frame_left and not self._begin_frame():
                break

            data = self._unparsed[: self._frame_left]
            self._unparsed = self._unparsed[self._frame_left :]
            self._frame_left -= len(data)
            if self._is_data:
                self._partial_bytes += len(data)
                if not self._frame_left and self._is_last:
                    self._waiting.append(self._partial_bytes)
                    self._partial_bytes = 0
                    self._has_message = True

            if self._hold_memory():
                self._protocol.data_received(data)
            # After an invalid frame, uvicorn closes the connection.
            if self._protocol.conn.parser_exc is not None:
                self._charge()
                self._end_reading()
        self._update()

    def _begin_frame(self) -> bool:
        """Read the head of a frame; return False if it is incomplete, or not allowed."""
        head = self._unparsed[:HEAD_BYTES]
        size = frame_size(head)
        if size is None:
            return False

        opcode = head[0] & 0x0F
        self._is_last = bool(head[0] & 0x80)
        self._is_data = not opcode & _CONTROL_OPCODES

        is_fragment = opcode == Opcode.CONT or not self._is_last
        is_small_fragment = is_fragment and size < _FRAGMENT_BYTES
        is_limited = is_small_fragment or not self._is_data
        if is_limited and self._control_frames.take(time.monotonic()) > 0:
            self._charge()
            self._end(
                _POLICY_VIOLATION,
                f"more than {CONTROL_FRAMES} control frames or small fragments at once",
            )
            return False
        self._frame_left = size
        return True

    def _hold_memory(self) -> bool:
        """Count the bytes that wait as in flight; return False if there is no room for them, and
        end the connection.
        """
        if self._memory is None:
            return True
        try:
            self._memory.resize(self._partial_bytes + sum(self._waiting))
        except VLAgentsError as error:
            self._discard_rest()
            self._end(_TRY_AGAIN_LATER, str(error))
            return False
        return True

    def _update(self) -> None:
        """Read from the socket only if the next bytes can be passed on, and record since when a
        part of a message waits for its rest.
        """
        if self._ended or self._transport.is_closing():
            return
        if self._memory is not None:
            self._memory.resize(self._partial_bytes + sum(self._waiting))

        self._throttle()
        is_paused = self._is_paused()
        if is_paused:
            self._transport.pause_reading()
        elif not self._protocol.read_paused:
            # If uvicorn has paused reading, it resumes when its own queue is empty.
            self._transport.resume_reading()

        is_arriving = bool(self._partial_bytes or self._frame_left or self._unparsed)
        if is_paused or not is_arriving:
            self._arriving_since = None
        elif self._arriving_since is None:
            self._arriving_since = time.monotonic()

    def _charge(self) -> None:
        """Charge a message to the key, as for a message that the application refuses."""
        if self._caller is not None:
            with contextlib.suppress(VLAgentsError):
                self._caller.admit()

    def _give_up(self) -> None:
        """End the connection since a whole message needs the memory; called on any thread."""
        with contextlib.suppress(RuntimeError):  # the event loop is closed
            self._loop.call_soon_threadsafe(
                self._end, _TRY_AGAIN_LATER, "a complete message needs the memory"
            )

    def _end(self, code: int, reason: str) -> None:
        if self._ended or self._transport.is_closing():
            return
        logger.info("a WebSocket is closed: %s", reason)
        self._end_reading()
        close = Frame(Opcode.CLOSE, Close(code, reason[:120]).serialize())
        self._transport.write(close.serialize(mask=False))
        self._transport.close()

    def _end_reading(self) -> None:
        self._ended = True
        if self._end_of_throttling is not None:
            self._end_of_throttling.cancel()
        self._unparsed = b""
        self._partial_bytes = 0
        self._arriving_since = None
        self._waiting.clear()
        if self._memory is not None:
            self._memory.release()
