"""The part of HTTP/2 that bounds what a client's frames cost gRPC's library: its preface, and
the heads of frames.
"""

from __future__ import annotations

PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
_HEAD_BYTES = 9
# The number of bytes at the beginning of a frame's head that contain the size of the payload.
_SIZE_BYTES = 3
_TYPE = 3  # index of the type of a frame in its head
_DATA, _CANCELLATION = 0, 3  # DATA, and RST_STREAM, which cancels a request: types of frames
# DATA frames with a larger payload are not counted, since the limits of bytes cover them. Clients
# send messages in frames of 16 KiB.
_SMALL_BYTES = 4096
# gRPC parses the payload of any other frame, such as the entries of SETTINGS and the fields of
# HEADERS, in entries of a few bytes: that many bytes cost as much as a small frame.
_BYTES_OF_A_FRAME = 64
# A robot cancels a request only after a timeout. Beginning and cancelling a request costs its
# sender 30 bytes, and costs gRPC's server the beginning and the end of a call.
_FRAMES_OF_A_CANCELLATION = 8


class FrameCounter:
    """Counts the small frames in the bytes that a client sends after its preface.

    A cancellation counts as `_FRAMES_OF_A_CANCELLATION`. A frame without data counts once for each
    `_BYTES_OF_A_FRAME` of its payload, and at least once. Control frames (PING, SETTINGS,
    WINDOW_UPDATE), begun and cancelled requests, and messages in tiny pieces are all small frames.
    A small frame costs its sender a few bytes, but costs gRPC's library as much as a new
    connection.
    """

    def __init__(self) -> None:
        self._head = b""  # the part of a frame's head that has arrived
        self._missing_bytes = 0  # the bytes of the current frame's payload that have not arrived

    def count(self, data: bytes) -> int:
        """Return the number of small frames whose heads are completed by the next bytes of a
        client.
        """
        small_frames = 0
        start = 0
        while start < len(data):
            if self._missing_bytes:
                skipped = min(self._missing_bytes, len(data) - start)
                self._missing_bytes -= skipped
                start += skipped
                continue

            end = start + _HEAD_BYTES - len(self._head)
            self._head += data[start:end]
            start = end
            if len(self._head) == _HEAD_BYTES:
                self._missing_bytes = int.from_bytes(self._head[:_SIZE_BYTES], "big")
                small_frames += _cost_of_frame(self._head[_TYPE], self._missing_bytes)
                self._head = b""
        return small_frames


def _cost_of_frame(kind: int, size: int) -> int:
    """Return the number of small frames that cost as much as a frame with a payload of `size`
    bytes.
    """
    if kind == _DATA:
        return int(size < _SMALL_BYTES)
    least = _FRAMES_OF_A_CANCELLATION if kind == _CANCELLATION else 1
    return max(least, size // _BYTES_OF_A_FRAME)
