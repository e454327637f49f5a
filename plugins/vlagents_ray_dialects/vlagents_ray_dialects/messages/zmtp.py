"""The part of ZMTP 3, the protocol of ZeroMQ over TCP, that a ROUTER needs for REQ and DEALER
sockets.

A peer sends a greeting of 64 bytes, the command READY, and then messages. A message consists of
frames, each with a head and a body; every frame except the last one announces another frame.
ZeroMQ's own library buffers a message until it is complete, however many frames it has, and an
empty frame costs its sender 2 bytes and its reader 64. Here the reader checks each head before the
body arrives.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from vlagents_ray.errors import MalformedMessage

GREETING_BYTES = 64
HEAD_BYTES = 1  # the size of a frame's flags, bytes; the frame's size follows them
COMMAND_BYTES = 512  # maximum size of a command
_SIGNATURE = b"\xff" + bytes(8) + b"\x7f"
_MECHANISM = b"NULL".ljust(20, b"\0")  # no encryption and no password
_MAJOR_VERSION = 3
_MORE, _LONG, _COMMAND = 1, 2, 4  # flags of a frame
_SHORT_SIZE, _LONG_SIZE = struct.Struct(">B"), struct.Struct(">Q")
_VALUE_SIZE = struct.Struct(">I")  # the number of bytes of the size of a property's value in READY
# The number of bytes of a PING's time to live; the context that the answer repeats follows it.
_TTL_BYTES = 2
_SOCKET_TYPES = (b"REQ", b"DEALER")  # the types of sockets that may connect
GREETING = _SIGNATURE + bytes([_MAJOR_VERSION, 0]) + _MECHANISM + bytes(32)


@dataclass(frozen=True, slots=True)
class FrameFlags:
    """The first byte of a frame."""

    has_more: bool  # whether another frame of the same message follows
    is_long: bool  # whether the size has eight bytes in place of one
    is_command: bool

    @property
    def size_bytes(self) -> int:
        """The number of bytes of the frame's size."""
        return _LONG_SIZE.size if self.is_long else _SHORT_SIZE.size


def check_greeting(greeting: bytes | bytearray) -> None:
    """Raise `MalformedMessage` unless a peer's greeting is of ZMTP 3 without encryption.

    Args:
        greeting: The bytes received so far, at most 64.
    """
    signature, version, mechanism = greeting[:10], greeting[10:11], greeting[12:32]
    is_zmtp = signature[:1] == _SIGNATURE[:1] and signature[9:10] in (b"", _SIGNATURE[9:])
    if not is_zmtp or (version and version[0] < _MAJOR_VERSION):
        raise MalformedMessage(
            "zmtp: expected a greeting of ZMTP 3, got another greeting; use libzmq 4 or newer"
        )
    if len(mechanism) == len(_MECHANISM) and mechanism != _MECHANISM:
        raise MalformedMessage(
            "zmtp: expected the mechanism NULL, got another mechanism; use a socket without "
            "encryption"
        )


def read_flags(first: int) -> FrameFlags:
    """Return the flags in the first byte of a frame.

    Raises:
        MalformedMessage: The flags are invalid.
    """
    flags = FrameFlags(bool(first & _MORE), bool(first & _LONG), bool(first & _COMMAND))
    if first > (_MORE | _LONG | _COMMAND) or (flags.is_command and flags.has_more):
        raise MalformedMessage(f"zmtp: expected the flags of a frame, got {first}")
    return flags


def read_size(data: bytes | memoryview) -> int:
    """Return the size in the one or eight bytes after a frame's flags, bytes."""
    form = _SHORT_SIZE if len(data) == _SHORT_SIZE.size else _LONG_SIZE
    size: int = form.unpack(data)[0]
    return size


def read_command(body: bytes | memoryview) -> tuple[bytes, bytes]:
    """Return the name and the content of a command.

    Args:
        body: The body of the command's frame.

    Raises:
        MalformedMessage: The command has no name.
    """
    length = body[0] if body else 0
    name = bytes(body[1 : 1 + length])
    if not 0 < length == len(name):
        raise MalformedMessage("zmtp: expected the name of a command, got none")
    return name, bytes(body[1 + length :])


def check_ready(properties: bytes) -> None:
    """Raise `MalformedMessage` unless the type of a peer's socket may connect.

    Args:
        properties: The content of the command READY.
    """
    values: dict[bytes, bytes] = {}
    unread = properties
    while unread:
        name_end = 1 + unread[0]
        value_start = name_end + _VALUE_SIZE.size
        if len(unread) < value_start:
            raise MalformedMessage("zmtp: expected a property of READY, got a part of one")
        (size,) = _VALUE_SIZE.unpack(unread[name_end:value_start])
        value_end = value_start + size
        if len(unread) < value_end:
            raise MalformedMessage(
                "zmtp: expected the value of a property of READY, got a part of it"
            )
        values[unread[1:name_end].lower()] = unread[value_start:value_end]
        unread = unread[value_end:]

    socket_type = values.get(b"socket-type")
    if socket_type not in _SOCKET_TYPES:
        raise MalformedMessage(
            f"zmtp: expected a REQ or DEALER socket, got {socket_type!r}; use one of these"
        )


def write_ready() -> bytes:
    """Return the frame of the command READY of a ROUTER."""
    properties = b""
    for name, value in ((b"Socket-Type", b"ROUTER"), (b"Identity", b"")):
        properties += bytes([len(name)]) + name + _VALUE_SIZE.pack(len(value)) + value
    return _command(b"READY", properties)


def write_pong(ping: bytes) -> bytes:
    """Return the frame that answers a PING.

    Args:
        ping: The content of the PING.
    """
    return _command(b"PONG", ping[_TTL_BYTES:])


def write_message(bodies: Sequence[bytes]) -> bytes:
    """Return the frames of a message.

    Args:
        bodies: The bodies of the frames, at least one.
    """
    *first_bodies, last_body = bodies
    frames = [_frame(body, _MORE) for body in first_bodies]
    return b"".join([*frames, _frame(last_body, 0)])


def _command(name: bytes, content: bytes) -> bytes:
    """Return the frame of a command."""
    return _frame(bytes([len(name)]) + name + content, _COMMAND)


def _frame(body: bytes, flags: int) -> bytes:
    """Return a frame with these flags; the flag for a long size is added if necessary."""
    if len(body) < 256:
        return bytes([flags]) + _SHORT_SIZE.pack(len(body)) + body
    return bytes([flags | _LONG]) + _LONG_SIZE.pack(len(body)) + body
