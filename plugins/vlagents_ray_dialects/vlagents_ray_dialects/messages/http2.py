"""The part of HTTP/2 that bounds what a client's frames cost gRPC's library: its preface, and
the heads of frames.
"""

from __future__ import annotations

PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
_HEAD_BYTES = 9
_SIZE_BYTES = 3  # of the payload, at the begin of a head
# The cost of a frame with a larger payload is that of its bytes. Clients send messages in frames of
# 16 KiB.
_SMALL_BYTES = 4096
_TYPE = 3  # index of the type of a frame in its head
_CANCELLATION = 3  # RST_STREAM, the type of a frame that cancels a request
# A robot cancels a request only after a time-out. For 30 bytes, a stranger who begins a request and
# cancels it makes gRPC's server begin and end a call.
_FRAMES_OF_A_CANCELLATION = 8


class FrameCounter:
    """Counts the small frames in the bytes that a client sends after its preface; a cancellation
    counts as `_FRAMES_OF_A_CANCELLATION`.

    Control frames (PING, SETTINGS, WINDOW_UPDATE), begun and cancelled requests, and messages in
    tiny parts are all small frames: they cost their sender a few bytes each, and gRPC's library up
    to a new connection.
    """

    def __init__(self) -> None:
        self._head = b""  # the part of a frame's head that has arrived
        # Number of bytes of the current frame's payload that have not arrived.
        self._payload_left = 0

    def count(self, data: bytes) -> int:
        """Return the number of small frames whose heads end in the next bytes of a client."""
        small_frames = 0
        start = 0
        while start < len(data):
            if self._payload_left:
                skipped = min(self._payload_left, len(data) - start)
                self._payload_left -= skipped
                start += skipped
                continue
            end = start + _HEAD_BYTES - len(self._head)
            self._head += data[start:end]
            start = end
            if len(self._head) == _HEAD_BYTES:
                self._payload_left = int.from_bytes(self._head[:_SIZE_BYTES], "big")
                is_cancellation = self._head[_TYPE] == _CANCELLATION
                self._head = b""
                if is_cancellation:
                    small_frames += _FRAMES_OF_A_CANCELLATION
                elif self._payload_left < _SMALL_BYTES:
                    small_frames += 1
        return small_frames
