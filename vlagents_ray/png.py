"""(H, W, 3) uint8 RGB -> PNG, and back for files written here, with numpy and zlib alone.

One filter for all rows, "Up" (the difference to the row above), and zlib's run-length strategy: no
search for a better filter or longer matches, which take several times as long and gain a few
per cent on cameras that have any noise. Any PNG reader reads it.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np

MAGIC = b"\x89PNG\r\n\x1a\n"
_HEADER = struct.Struct(">2I5B")  # width, height, depth, colour type, compression, filter, interlace
_RGB8 = (8, 2, 0, 0, 0)
_DATA_AT = len(MAGIC) + 12 + _HEADER.size  # where the chunk after the header begins
_UP = 2


def encode(image: np.ndarray) -> bytes:
    """A PNG file of an (H, W, 3) uint8 RGB image."""
    height, width, _ = image.shape
    pixels = np.ascontiguousarray(image).reshape(height, width * 3)
    rows = np.empty((height, 1 + width * 3), np.uint8)
    rows[:, 0] = _UP
    rows[:1, 1:] = pixels[:1]
    np.subtract(pixels[1:], pixels[:-1], out=rows[1:, 1:])
    deflate = zlib.compressobj(1, zlib.DEFLATED, 15, 9, zlib.Z_RLE)
    data = deflate.compress(rows.data) + deflate.flush()
    return b"".join(
        (MAGIC, _chunk(b"IHDR", _HEADER.pack(width, height, *_RGB8)), _chunk(b"IDAT", data), _chunk(b"IEND", b""))
    )


def size(data: bytes | memoryview) -> tuple[int, int] | None:
    """(height, width) of a file laid out as `encode` does: 8-bit RGB, all its data in one chunk; else None."""
    view = memoryview(data)
    if len(view) < _DATA_AT + 24 or (_name(view, 8), _name(view, _DATA_AT)) != (b"IHDR", b"IDAT"):
        return None
    width, height, *form = _HEADER.unpack_from(view, 16)
    end = _DATA_AT + 12 + int.from_bytes(view[_DATA_AT : _DATA_AT + 4], "big")
    if tuple(form) != _RGB8 or end + 12 != len(view) or _name(view, end) != b"IEND":
        return None
    return height, width


def decode(data: bytes | memoryview, height: int, width: int) -> np.ndarray | None:
    """The image in a file of which `size` said that it is laid out as `encode` does.

    None if its rows have other filters than "Up"; ValueError if the data are broken. Takes no more
    memory than the image that the header declares, whatever the data would unpack to.
    """
    stride = 1 + width * 3
    inflate = zlib.decompressobj()
    try:
        raw = inflate.decompress(memoryview(data)[_DATA_AT + 8 : -16], height * stride + 1)
    except zlib.error as error:
        raise ValueError(str(error)) from error
    if len(raw) != height * stride or not inflate.eof:  # at its end, zlib has compared the checksum
        raise ValueError(f"its data are not {height} rows of {width} pixels")
    rows = np.frombuffer(raw, np.uint8).reshape(height, stride)
    if (rows[:, 0] != _UP).any():
        return None
    return np.add.accumulate(rows[:, 1:], axis=0, dtype=np.uint8).reshape(height, width, 3)


def _name(view: memoryview, at: int) -> bytes:
    """Of the chunk that begins there."""
    return bytes(view[at + 4 : at + 8])


def _chunk(kind: bytes, data: bytes) -> bytes:
    checksum = zlib.crc32(data, zlib.crc32(kind))
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", checksum)
