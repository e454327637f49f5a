"""Reads and writes WebSocket frames (RFC 6455, 5.2) with fewer copies and calls than the library
`websockets`.
"""

from __future__ import annotations

from collections.abc import Generator

from websockets import frames
from websockets.frames import Frame, Opcode
from websockets.protocol import OPEN, SERVER, Protocol
from websockets.streams import StreamReader

# Parts of a frame up to this size are copied, since a view of them may outlive the contents of the
# buffer.
_SMALL_BYTES = 1024
_BINARY = 0x80 | Opcode.BINARY  # first byte of a message in one frame
# Maximum size of a frame's head: two bytes, eight bytes of the size, and a mask of four bytes.
HEAD_BYTES = 14
# A connection may send one control frame each second, or 16 at once. For keep-alive, one frame in
# 20 s is usual.
CONTROL_FRAMES_PER_S, CONTROL_FRAMES = 1.0, 16


def frame_head(size: int, mask: bytes = b"") -> bytes:
    """Return the head of the frame of a binary message of `size` bytes. A client's frame has a mask
    of four bytes.
    """
    bit = 0x80 if mask else 0
    if size < 126:
        return bytes((_BINARY, bit | size)) + mask
    if size < 2**16:
        return bytes((_BINARY, bit | 126)) + size.to_bytes(2, "big") + mask
    return bytes((_BINARY, bit | 127)) + size.to_bytes(8, "big") + mask


def frame_size(head: bytes) -> int | None:
    """Return the size of a frame with its head, bytes; None if `head` is incomplete."""
    if len(head) < 2:
        return None
    mask_bytes = 4 if head[1] & 0x80 else 0
    size = head[1] & 0x7F
    size_bytes = {126: 2, 127: 8}.get(size, 0)
    head_bytes = 2 + size_bytes + mask_bytes
    if len(head) < head_bytes:
        return None
    if size_bytes:
        size = int.from_bytes(head[2 : 2 + size_bytes], "big")
    return head_bytes + size


class ReceiveBuffer(StreamReader):
    """The bytes of WebSocket frames that one connection has received, until they are parsed.

    A message that arrives as a whole is parsed in the memory into which it was read, and only
    copied when its mask is removed. The reader of `websockets` copies each message three times.
    """

    buffer: bytes | bytearray | memoryview  # type: ignore[assignment]

    def __init__(self, limit: int) -> None:
        """Create an empty buffer for messages of at most `limit` bytes."""
        super().__init__()
        self._limit = limit
        self._start = 0  # start of the unparsed bytes in `buffer`
        self._between_frames = False  # whether the next byte begins a frame
        # Whether any frame was only a part of a message. If so, the library's parser reads all
        # later frames.
        self._fragments = False

    @property
    def size(self) -> int:
        """Number of unparsed bytes. On threads other than the thread of `parse`, only the
        comparison with 0 is reliable.
        """
        return len(self.buffer) - self._start

    def attach(self, protocol: Protocol) -> None:
        """Become the reader of a protocol that has parsed all bytes received so far."""
        protocol.reader = self
        protocol.parser = Protocol.parse(protocol)  # the old parser reads from the old reader
        next(protocol.parser)
        self._protocol = protocol

    def parse(self, data: bytes | memoryview) -> None:
        """Parse bytes in memory that will be reused, and copy the incomplete last frame."""
        if self._between_frames and not self._fragments:
            message = self._message(data)
            if message is not None:
                self._protocol.events.append(Frame(Opcode.BINARY, message))
                return

        self._protocol.receive_data(data)  # type: ignore[arg-type]
        self._fragments |= any(
            isinstance(event, Frame) and not event.fin for event in self._protocol.events
        )
        if isinstance(self.buffer, bytearray):
            del self.buffer[: self._start]
        else:
            self.buffer = bytearray(self.buffer[self._start :])
        self._start = 0

    def _message(self, data: bytes | memoryview) -> bytes | None:
        """Return the message if `data` is one binary frame; None if it must be parsed step by
        step.
        """
        masked = self._protocol.side is SERVER  # only a client's frames have a mask
        if (
            self._protocol.state is not OPEN
            or len(data) < 2
            or data[0] != _BINARY
            or (data[1] > 127) is not masked
        ):
            return None
        at, size = 2, data[1] & 127
        if size > 125:
            at = 4 if size == 126 else 10
            size = int.from_bytes(data[2:at], "big")
        begin = at + 4 * masked
        if len(data) != begin + size or size > self._limit:
            return None
        mask = bytes(data[at:begin])
        return frames.apply_mask(data[begin:], mask) if any(mask) else bytes(data[begin:])  # type: ignore[attr-defined, no-any-return, unused-ignore]

    def feed_data(self, data: bytes | bytearray) -> None:
        """Add bytes, as the protocol's parser requires; raise `EOFError` after `feed_eof`."""
        if self.eof:
            raise EOFError("stream ended")
        if self.size:
            self.buffer += data  # type: ignore[operator]
        else:
            self.buffer, self._start = data, 0

    def read_exact(self, n: int) -> Generator[None, None, bytearray]:
        """Return the next `n` bytes once they have arrived. Many bytes that were just received are
        returned as a view.
        """
        while self.size < n:
            if self.eof:
                raise EOFError(f"stream ends after {self.size} bytes, expected {n} bytes")
            yield
        begin, self._start = self._start, self._start + n
        data = self.buffer[begin : self._start]
        return data if n > _SMALL_BYTES else bytearray(data)  # type: ignore[return-value]

    def at_eof(self) -> Generator[None, None, bool]:
        """Return whether the connection has ended, once that is known. It has not ended while there
        are unparsed bytes.
        """
        while not self.size:
            if self.eof:
                return True
            self._between_frames = True
            yield
            self._between_frames = False
        return False

    def discard(self) -> None:
        """Drop the unparsed bytes."""
        self.buffer, self._start = bytearray(), 0
