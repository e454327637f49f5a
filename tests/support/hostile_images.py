"""JPEG and PNG files that are valid or nearly valid, and take much time or memory relative to their
size.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable

BLOCKS = 1024 * 1024 // 64  # number of 8 x 8 blocks in a megapixel
_GREY = (0x11,)


def segment(marker: int, data: bytes) -> bytes:
    return bytes((0xFF, marker)) + struct.pack(">H", len(data) + 2) + data


def _bits(text: str) -> bytes:
    text += "1" * (-len(text) % 8)
    return int(text, 2).to_bytes(len(text) // 8, "big").replace(b"\xff", b"\xff\0")


# One quantisation table and one Huffman table: code "0" is a DC difference of 0, "0" also a run of
# 16384 to 32767 blocks without AC coefficients, and "10" the end of a block.
TABLES = (
    segment(0xDB, b"\0" + b"\1" * 64)
    + segment(0xC4, b"\x00" + bytes([1] + [0] * 15) + b"\0")
    + segment(0xC4, b"\x10" + bytes([1, 1] + [0] * 14) + b"\xe0\0")
)


def frame(marker: int, height: int, width: int, sampling: tuple[int, ...] = _GREY) -> bytes:
    components = b"".join(bytes((index + 1, factors, 0)) for index, factors in enumerate(sampling))
    return segment(marker, struct.pack(">BHHB", 8, height, width, len(sampling)) + components)


def scan(first: int, last: int, data: bytes, components: int = 1) -> bytes:
    names = b"".join(bytes((index + 1, 0)) for index in range(components))
    return segment(0xDA, bytes((components,)) + names + bytes((first, last, 0))) + data


def jpeg(*parts: bytes, height: int = 1024, width: int = 1024, marker: int = 0xC2) -> bytes:
    """Return a JPEG with grey pixels, all zero, and with further segments or scans after the first
    scan.
    """
    data = _bits("0" * (BLOCKS if marker == 0xC2 else 0) or "010" * BLOCKS)
    first = scan(0, 0 if marker == 0xC2 else 63, data)
    return (
        b"\xff\xd8" + TABLES + frame(marker, height, width) + first + b"".join(parts) + b"\xff\xd9"
    )


EMPTY_SCAN = scan(1, 63, _bits("0" + format(BLOCKS - 2**14, "014b")))


def _before_scan(part: bytes) -> bytes:
    return b"\xff\xd8" + part + jpeg()[2:]


def _restarts(interval: int, extra: bytes) -> bytes:
    """Return a baseline JPEG of a megapixel with a restart marker after each `interval` blocks."""
    pieces = []
    for number in range(BLOCKS // interval):
        pieces.append(_bits("010" * interval) + bytes((0xFF, 0xD0 | number % 8)) + extra)
    head = (
        b"\xff\xd8" + TABLES + segment(0xDD, struct.pack(">H", interval)) + frame(0xC0, 1024, 1024)
    )
    return head + scan(0, 63, b"".join(pieces)[: -2 - len(extra)]) + b"\xff\xd9"


def _padded(height: int, width: int, sampling: tuple[int, ...]) -> bytes:
    units = -(-height // 32) * -(-width // 32)
    blocks = sum((factors >> 4) * (factors & 15) for factors in sampling)
    data = _bits("010" * blocks * units)
    head = b"\xff\xd8" + TABLES + frame(0xC0, height, width, sampling)
    return head + scan(0, 63, data, len(sampling)) + b"\xff\xd9"


JPEGS: dict[str, Callable[[int], bytes]] = {
    "scans": lambda size: jpeg(EMPTY_SCAN * (size // len(EMPTY_SCAN))),
    "scans within the limit": lambda _: jpeg(EMPTY_SCAN * 98),
    "scans without data": lambda size: jpeg(scan(1, 63, b"") * (size // 10)),
    "arithmetic coding": lambda _: jpeg(scan(1, 63, b"") * 50, marker=0xC2).replace(
        b"\xff\xc2", b"\xff\xca"
    ),
    "comments first": lambda size: _before_scan(segment(0xFE, b"") * (size // 4)),
    "comments behind a scan": lambda size: jpeg(segment(0xFE, b"") * (size // 4)),
    "tables": lambda size: _before_scan(TABLES * (size // len(TABLES))),
    "tables behind a scan": lambda size: jpeg(TABLES * (size // len(TABLES))),
    "profiles": lambda size: _before_scan(
        segment(0xE2, b"ICC_PROFILE\0\1\1" + bytes(60_000)) * (size // 60_000)
    ),
    "fill bytes": lambda size: _before_scan(b"\xff" * size),
    "restart markers": lambda _: _restarts(1, b""),
    "restart markers, twice": lambda _: _restarts(1, b"\xff\xd0" * 20),
    "stuffed bytes": lambda size: jpeg(b"\xff\0" * (size // 2)),
    "bytes behind the end": lambda size: jpeg() + bytes(size),
    "padding": lambda _: _padded(65_500, 1, (0x44, 0x11, 0x11)),
    "padding of all": lambda _: _padded(1, 65_500, (0x41, 0x41, 0x41)),
    "no rows": lambda _: jpeg(height=0),
    "no columns": lambda _: jpeg(width=0),
    "two headers": lambda _: _before_scan(TABLES + frame(0xC2, 8, 8)),
}


def chunk(name: bytes, data: bytes) -> bytes:
    return (
        struct.pack(">I", len(data))
        + name
        + data
        + struct.pack(">I", zlib.crc32(data, zlib.crc32(name)))
    )


def png(
    *before: bytes,
    height: int = 8,
    width: int = 8,
    rows: bytes | None = None,
    form: tuple[int, ...] = (8, 2, 0, 0, 0),
    data: bytes = b"",
    after: bytes = b"",
) -> bytes:
    """Return a PNG file with further chunks before and after its data."""
    unpacked = bytes(height * (1 + 3 * width)) if rows is None else rows
    header = chunk(b"IHDR", struct.pack(">2I5B", width, height, *form))
    pixels = data or chunk(b"IDAT", zlib.compress(unpacked, 9))
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(before) + pixels + after + chunk(b"IEND", b"")


def _deflated(size: int) -> bytes:
    return zlib.compress(bytes(size), 9)


def _filtered(filters: bytes, height: int, stride: int) -> bytes:
    return b"".join(filters[row % len(filters)].to_bytes() + bytes(stride) for row in range(height))


PNGS: dict[str, Callable[[int], bytes]] = {
    "empty chunks": lambda size: png(chunk(b"abCd", b"") * (size // 12)),
    "empty chunks behind the data": lambda size: png(after=chunk(b"abCd", b"") * (size // 12)),
    "empty data": lambda size: png(chunk(b"IDAT", b"") * (size // 12)),
    "palettes": lambda size: png(chunk(b"PLTE", bytes(3)) * (size // 15)),
    "profiles": lambda size: png(chunk(b"iCCP", b"a\0\0" + _deflated(2**20 - 1)) * (size // 1100)),
    "packed text": lambda size: png(
        chunk(b"zTXt", b"k\0\0" + _deflated(2**20 - 1)) * (size // 1100)
    ),
    "text": lambda size: png(*(chunk(b"tEXt", b"k%d\0v" % n) for n in range(size // 20))),
    "animation": lambda size: png(
        chunk(b"acTL", struct.pack(">2I", size // 38, 0)) + chunk(b"fcTL", bytes(26))
    ),
    "short chunk behind the data": lambda _: png(after=chunk(b"gAMA", b"")),
    "no columns": lambda size: png(
        width=0, height=100 * size, data=chunk(b"IDAT", _deflated(100 * size))
    ),
    "no rows": lambda size: png(
        width=100 * size, height=0, data=chunk(b"IDAT", _deflated(100 * size))
    ),
    "more data than pixels": lambda size: png(data=chunk(b"IDAT", _deflated(100 * size))),
    "one column": lambda _: png(height=2**20, width=1),
    "one column, another filter": lambda _: png(
        height=2**20, width=1, rows=_filtered(b"\2\4", 2**20, 3)
    ),
    "one row": lambda _: png(height=1, width=2**20),
    "filters": lambda _: png(height=1024, width=1024, rows=_filtered(b"\4", 1024, 3072)),
    "filters of 16 bits": lambda _: png(
        height=1024, width=1024, form=(16, 6, 0, 0, 0), rows=_filtered(b"\1\2\3\4", 1024, 8192)
    ),
    "interlaced": lambda _: png(
        height=1024, width=1024, form=(8, 2, 0, 0, 1), rows=bytes(3 * 2**20 + 4096)
    ),
    "interlaced column": lambda _: png(
        height=2**20, width=1, form=(8, 2, 0, 0, 1), rows=bytes(4 * 2**20)
    ),
    "one bit": lambda _: png(height=1024, width=1024, form=(1, 0, 0, 0, 0), rows=bytes(1024 * 129)),
    "the form of ours, another filter": lambda _: png(
        height=1024, width=1024, rows=_filtered(b"\2\2\2\4", 1024, 3072)
    ),
}

FILES = {f"JPEG: {name}": make for name, make in JPEGS.items()} | {
    f"PNG: {name}": make for name, make in PNGS.items()
}
