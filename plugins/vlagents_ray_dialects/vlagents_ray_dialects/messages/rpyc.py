"""The part of RPyC's protocol for a service with text arguments and results; based on rpyc 6.0.

RPyC allows a peer to access attributes of the server's objects, to call these objects, and to pass
objects that the server calls back. This reader supports none of that: it identifies the root and
its methods by number, and accepts only values without references. A peer can therefore only call
the methods that the server offers.

A frame consists of a header (length, compressed?), a message and a newline. A message consists of
its type and one value, encoded in "brine": `(sequence number, content)`.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from vlagents_ray.errors import MalformedMessage, MessageTooLarge, shown

HEADER = struct.Struct("!LB")  # size of the message in bytes, and whether it is compressed
END = b"\n"
ROOT = 0  # the number of the root; the numbers of its methods follow
# A peer's reference to the root: its class, and the numbers of class and object.
_ROOT_NAME = ("vlagents_ray.Policy", 1, 1)
_METHOD_CLASS = "builtins.method"  # peers do not inspect an object of this class
_METHODS_AT_MOST = 64
_COMPRESS_OVER = 3000  # minimum size of a message that is compressed, bytes, as in RPyC
_REQUEST, _REPLY, _EXCEPTION = 1, 2, 3  # types of messages
# Labels of boxed values. A local reference refers to an object of the receiver.
VALUE, TUPLE, LOCAL, REMOTE = 1, 2, 3, 4


class Handler(IntEnum):
    """The operations that a peer may request; all other operations of RPyC would access objects."""

    PING = 1
    CLOSE = 2
    GETROOT = 3
    GETATTR = 4
    CALL = 7
    CALLATTR = 8
    DEL = 15
    INSPECT = 16


@dataclass(frozen=True, slots=True)
class Reference:
    """A peer's reference to the root, or to one of its methods."""

    number: int


@dataclass(frozen=True, slots=True)
class RpycCall:
    """A request of a peer."""

    sequence: int
    handler: Handler
    args: tuple[Any, ...]


def read_header(header: bytes | bytearray, limit: int) -> tuple[int, bool]:
    """Read the header of a frame.

    Args:
        header: The header.
        limit: Largest size of a message, bytes.

    Returns:
        The number of bytes that follow, including the newline, and whether the message is
        compressed.

    Raises:
        MalformedMessage: The header is invalid.
        MessageTooLarge: The message is longer than the limit.
    """
    length, compressed = HEADER.unpack(header)
    if length > limit:
        raise MessageTooLarge(f"rpyc: expected a message of at most {limit} bytes, got {length}")
    if compressed > 1 or length == 0:
        raise MalformedMessage("rpyc: not a frame")
    return length + len(END), bool(compressed)


def read_call(body: bytes | bytearray, compressed: bool, limit: int) -> RpycCall | None:
    """Read a request.

    Args:
        body: The body of a frame, after the header.
        compressed: Whether the message is compressed.
        limit: Largest size of the message after decompression, bytes.

    Returns:
        The request; None if the message needs no reply.

    Raises:
        MalformedMessage: The message is not a request.
        Rejected: The request is not offered.
        MessageTooLarge: The message is longer than the limit.
    """
    message = _message(body, compressed, limit)
    message_type = message[0]
    # The server sends no requests, so it expects no replies.
    if message_type in (_REPLY, _EXCEPTION):
        return None
    if message_type != _REQUEST:
        raise MalformedMessage(f"rpyc: expected a request, got a message of kind {message_type}")

    content = read_brine(message[1:])
    if not (isinstance(content, tuple) and len(content) == 2 and _is_int(content[0])):
        raise MalformedMessage(f"rpyc: expected (sequence number, request), got {shown(content)}")
    sequence, request = content
    if not (isinstance(request, tuple) and len(request) == 2 and _is_int(request[0])):
        raise MalformedMessage(f"rpyc: expected (handler, arguments), got {shown(request)}")

    try:
        handler = Handler(request[0])
    except ValueError:
        raise Refused(sequence, f"rpyc: handler {request[0]} is not offered here") from None
    try:
        args = _unbox(request[1])
    except MalformedMessage as error:
        raise Refused(sequence, str(error)) from error
    if not isinstance(args, tuple):
        raise Refused(sequence, f"rpyc: expected a tuple of arguments, got {shown(args)}")
    return RpycCall(sequence, handler, args)


class Refused(MalformedMessage):
    """A request that can be decoded but is not offered; its sender receives the error as the
    reply.
    """

    def __init__(self, sequence: int, text: str) -> None:
        super().__init__(text)
        self.sequence = sequence


def reply(sequence: int, value: Any) -> bytes:
    """Return the frame of a reply.

    Args:
        sequence: The sequence number of the request.
        value: None, a bool, int, float, text, bytes, or a tuple of these.
    """
    return _frame(_REPLY, (sequence, (VALUE, value)))


def reference_reply(sequence: int, number: int) -> bytes:
    """Return the frame of a reply with a reference to the root, or to one of its methods."""
    name = _ROOT_NAME if number == ROOT else (_METHOD_CLASS, 2, number)
    return _frame(_REPLY, (sequence, (REMOTE, name)))


def exception(sequence: int, class_name: str, text: str) -> bytes:
    """Return the frame that raises a built-in exception at the peer, without a traceback.

    Args:
        sequence: The sequence number of the request.
        class_name: The name of the exception's class.
        text: The message of the exception.
    """
    return _frame(_EXCEPTION, (sequence, (("builtins", class_name), (text,), (), "")))


def request(sequence: int, handler: Handler, boxed_args: tuple[int, Any]) -> bytes:
    """Return the frame of a request to a server.

    Args:
        sequence: The sequence number of the request.
        handler: The operation.
        boxed_args: The arguments in boxes: a label, and a value or boxes.
    """
    return _frame(_REQUEST, (sequence, (int(handler), boxed_args)))


def read_reply(
    body: bytes | bytearray, compressed: bool, limit: int
) -> tuple[int, bool, Any] | None:
    """Read a reply.

    Args:
        body: The body of a frame, after the header.
        compressed: Whether the message is compressed.
        limit: Largest size of the message after decompression, bytes.

    Returns:
        The sequence number of the request, whether the reply is a result (otherwise it is an
        exception), and its content; None if the message is a request.
    """
    message = _message(body, compressed, limit)
    # A server is offered no methods, so its requests are not answered.
    if message[0] not in (_REPLY, _EXCEPTION):
        return None
    content = read_brine(message[1:])
    if not (isinstance(content, tuple) and len(content) == 2 and _is_int(content[0])):
        raise MalformedMessage(f"rpyc: expected (sequence number, reply), got {shown(content)}")
    return content[0], message[0] == _REPLY, content[1]


def _message(body: bytes | bytearray, compressed: bool, limit: int) -> memoryview:
    """Return the message in a frame's body, which has at least one byte."""
    message = memoryview(body)[: -len(END)]
    if compressed:
        machine = zlib.decompressobj()
        try:
            message = memoryview(machine.decompress(message, limit + 1))
        except zlib.error as error:
            raise MalformedMessage(f"rpyc: not compressed as its header says ({error})") from error
        if len(message) > limit:
            raise MessageTooLarge(f"rpyc: a message of more than {limit} bytes")
        if not machine.eof:
            raise MalformedMessage("rpyc: a compressed message without an end")
    if len(message) == 0:
        raise MalformedMessage("rpyc: an empty message")
    return message


def _frame(message_type: int, content: tuple[Any, ...]) -> bytes:
    """Return the frame of a message."""
    message = bytes([message_type]) + write_brine(content)
    compressed = len(message) > _COMPRESS_OVER
    if compressed:
        message = zlib.compress(message, 1)
    return HEADER.pack(len(message), compressed) + message + END


def _unbox(boxed: Any) -> Any:
    """Return the value in a box, or the reference."""
    if not (isinstance(boxed, tuple) and len(boxed) == 2):
        raise MalformedMessage(f"rpyc: expected (label, value), got {shown(boxed)}")
    label, value = boxed
    if label == VALUE:
        return value
    if label == TUPLE and isinstance(value, tuple):
        return tuple(_unbox(item) for item in value)
    if label == LOCAL and isinstance(value, tuple) and len(value) == 3:
        if value == _ROOT_NAME:
            return Reference(ROOT)
        number = value[2]
        is_method = value[:2] == (_METHOD_CLASS, 2)
        if is_method and _is_int(number) and 0 < number < _METHODS_AT_MOST:
            return Reference(number)
    raise MalformedMessage("rpyc: objects are not accepted here; send values")


def _is_int(value: object) -> bool:
    """Return whether a value is a whole number, and no bool."""
    return isinstance(value, int) and not isinstance(value, bool)


# Brine, RPyC's encoding of values: None, bool, int, float, text, bytes, and tuples of these; based
# on rpyc 6.0. The other types of brine (slices, sets, complex numbers, …) are rejected, since no
# client needs them here.

_DEPTH = 16  # largest number of levels of nesting
_ITEMS = 1024  # largest number of values in a message
_DIGITS = 20  # maximum number of characters of an integer, including its sign
_F8, _U4 = struct.Struct("!d"), struct.Struct("!L")


def read_brine(data: memoryview) -> Any:
    """Decode a value in brine.

    Args:
        data: The encoded value, and nothing else.

    Raises:
        MalformedMessage: The data are not exactly one value in brine.
        MessageTooLarge: The value is nested too deeply, or has too many values.
    """
    return _BrineReader(data).all()


def write_brine(value: Any) -> bytes:
    """Encode a value in brine, the inverse of `read_brine`.

    Raises:
        TypeError: The type of the value is not supported.
    """
    if value is None or isinstance(value, bool):
        return {None: b"\x00", True: b"\x03", False: b"\x04"}[value]
    if isinstance(value, int):
        if -0x30 <= value < 0xA0:
            return bytes([value + 0x50])
        digits = str(value).encode()
        return b"\x16" + bytes([len(digits)]) + digits
    if isinstance(value, float):
        return b"\x18" + _F8.pack(value)
    if isinstance(value, str):
        return b"\x08" + write_brine(value.encode())
    if isinstance(value, bytes):
        return b"\x0f" + _U4.pack(len(value)) + value if value else b"\x01"
    if isinstance(value, tuple):
        if not value:
            return b"\x02"
        return b"\x15" + _U4.pack(len(value)) + b"".join(map(write_brine, value))
    raise TypeError(f"brine: cannot send {type(value).__name__}")


class _BrineReader:
    """Decodes a value in brine."""

    def __init__(self, data: memoryview) -> None:
        self._data = data
        self._offset = 0  # offset of the next byte
        self._items = 0  # the number of values that have been read

    def all(self) -> Any:
        """Return the value, which must be the only one."""
        value = self._value(0)
        if self._offset != len(self._data):
            raise MalformedMessage("brine: more than one value in a message")
        return value

    def _take(self, count: int) -> memoryview:
        """Return the next bytes."""
        end = self._offset + count
        if end > len(self._data):
            raise MalformedMessage("brine: a message that ends too early")
        data = self._data[self._offset : end]
        self._offset = end
        return data

    def _value(self, depth: int) -> Any:
        """Return the next value, at this level of nesting."""
        self._items += 1
        if self._items > _ITEMS or depth > _DEPTH:
            raise MessageTooLarge(
                f"brine: more than {_ITEMS} values or {_DEPTH} levels in a message"
            )

        tag = self._take(1)[0]
        if 0x20 <= tag < 0xF0:
            return tag - 0x50
        if tag in _SINGLE:
            return _SINGLE[tag]
        if tag == 0x18:
            return _F8.unpack(self._take(8))[0]
        if tag == 0x08:
            return self._text(depth)
        if tag in _BYTES:
            return bytes(self._take(self._length(_BYTES[tag])))
        if tag in _TUPLES:
            return self._tuple(self._length(_TUPLES[tag]), depth)
        if tag in _INTS:
            return self._integer(self._length(_INTS[tag]))
        raise MalformedMessage(
            f"brine: expected text, numbers or tuples, got a value of kind {tag:#04x}"
        )

    def _text(self, depth: int) -> str:
        """Return a text, which is encoded as bytes."""
        data = self._value(depth + 1)
        if not isinstance(data, bytes):
            raise MalformedMessage("brine: text that is none")
        try:
            return data.decode()
        except UnicodeDecodeError as error:
            raise MalformedMessage(f"brine: not UTF-8 ({error.reason})") from error

    def _tuple(self, length: int, depth: int) -> tuple[Any, ...]:
        """Return a tuple of this many values."""
        if length > _ITEMS:
            raise MessageTooLarge(
                f"brine: expected a tuple of at most {_ITEMS} values, got {length}"
            )
        return tuple(self._value(depth + 1) for _ in range(length))

    def _integer(self, length: int) -> int:
        """Return an integer, which is encoded as decimal digits."""
        digits = bytes(self._take(length))
        if not digits.removeprefix(b"-").isdigit() or length > _DIGITS:
            raise MalformedMessage("brine: not a number")
        return int(digits)

    def _length(self, length: int) -> int:
        """Return a length in one of the tables below, or the length in the next bytes."""
        return length if length > 0 else int.from_bytes(self._take(-length), "big")


_SINGLE: dict[int, Any] = {0x00: None, 0x01: b"", 0x02: (), 0x03: True, 0x04: False}
# Lengths by tag; with -1 and -4, the next one or four bytes contain the length.
_BYTES = {0x0A: 1, 0x0B: 2, 0x0C: 3, 0x0D: 4, 0x0E: -1, 0x0F: -4}
_TUPLES = {0x10: 1, 0x11: 2, 0x12: 3, 0x13: 4, 0x14: -1, 0x15: -4}
_INTS = {0x16: -1, 0x17: -4}
