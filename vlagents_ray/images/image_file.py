"""The structure of a JPEG or PNG file, which is checked before any part of the file is decoded.

The image size in the header of a file does not bound the cost of decoding: a progressive JPEG may
have any number of scans, each of which visits all pixels, and a PNG any number of chunks. Only the
forms that cameras and their encoders write are therefore accepted, whose cost follows from their
pixels and bytes:

- JPEG: baseline (Huffman coding, 8 bits) with one header and one scan.
- PNG: 8 bits per channel without interlacing, with at most as much data as its rows need.
"""

from __future__ import annotations

import re
import struct
import zlib
from dataclasses import dataclass

from vlagents_ray.errors import MalformedMessage, MessageTooLarge, UnsupportedImage

JPEG_MAGIC = b"\xff\xd8\xff"
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
# Format of the PNG header: width, height, depth, colour type, compression, filter, interlace.
PNG_HEADER = struct.Struct(">2I5B")
# Header fields after the size, for an RGB image of 8 bits without interlacing.
RGB8 = (8, 2, 0, 0, 0)
UP = 2  # the filter of all rows that `encode_png` writes

# The largest number of segments before the scan of a JPEG. Encoders write about ten, and the
# programs that edit photographs some more.
_MOST_SEGMENTS = 64
# The largest number of chunks of a PNG, to which one is added for each 4 KiB of the file. Encoders
# write their data in chunks of at least 8 KiB.
_MOST_CHUNKS = 64
_MOST_METADATA = 64 * 1024  # bytes that a file may have in addition to its pixels

# Estimated times on one core. The search in `tests/images/test_decoding_cost.py` finds no file that
# takes three times as long.
_FILE_S = 20e-6
_PART_S = 1e-6  # per segment or chunk
_SAMPLE_S = 1.7e-9  # per sample of a JPEG
_JPEG_BYTE_S = 5e-9  # per byte of a JPEG
# Per PNG file: Pillow takes 70 us, and a slice of the smallest data up to 1 ms.
_PNG_FILE_S = 500e-6
_PNG_ROW_S = 0.1e-6  # per row
_PNG_S = 12e-9  # per byte of the unpacked rows
_PNG_BYTE_S = 5e-9  # per byte of the file
# Bytes of a PNG's data that are unpacked to find the filter of its first row.
_PEEKED_BYTES = 512
# The memory that Pillow needs in addition to the result, bytes per pixel: the image in 32 bits, and
# copies of the unpacked rows.
_PILLOW_PIXEL_BYTES = 16

_BASELINE, _SOS, _EOI = 0xC0, 0xDA, 0xD9
_SOF = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # markers of the headers of all processes
_PROCESSES = {0xC1: "extended", 0xC2: "progressive", 0xC9: "arithmetic", 0xCA: "arithmetic"}
_FILL = re.compile(b"\xff+")  # fill bytes, any number of which may precede a marker
# The first marker after the data of a scan: neither a byte 0xFF of the data nor a restart.
_END_OF_SCAN = re.compile(b"\xff[^\x00\xff\xd0-\xd7]")
_RGB = 2  # PNG colour type
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # PNG colour type -> number of channels
_CRITICAL = (b"IHDR", b"PLTE", b"IDAT", b"IEND")

_ENCODE_BASELINE = (
    "encode it with progressive=False (Pillow) or IMWRITE_JPEG_PROGRESSIVE 0 (OpenCV); simplejpeg "
    "and the JPEG of cameras are baseline"
)
_ENCODE_8_BITS = (
    'convert it to 8 bits first, with image.convert("RGB") (Pillow) or astype(np.uint8) (OpenCV), '
    "and encode it without interlacing"
)


@dataclass(frozen=True, slots=True)
class ImageFile:
    """A file whose structure has been checked, with the cost of decoding it."""

    data: bytes  # a copy, since the sender may still write into shared memory
    height: int
    width: int
    decoding_s: float  # estimated time on one core, s
    scratch_bytes: int = 0  # memory that decoding needs in addition to the image, bytes
    channels: int = 3  # channels of the rows of a PNG
    # The name, start and end of each critical chunk of a PNG; empty for a JPEG.
    chunks: tuple[tuple[bytes, int, int], ...] = ()

    @property
    def is_jpeg(self) -> bool:
        return not self.chunks

    @property
    def image_bytes(self) -> int:
        """The size of the decoded image, (H, W, 3) uint8, in bytes."""
        return 3 * self.height * self.width

    @property
    def row_bytes(self) -> int:
        """The size of an unpacked row of a PNG with the byte of its filter, in bytes."""
        return 1 + self.channels * self.width


def read_structure(data: bytes | memoryview, max_pixels: int) -> ImageFile:
    """Check the structure of a JPEG or PNG file, and estimate the cost of decoding it.

    Raises:
        MalformedMessage: The data are not a JPEG or PNG file.
        UnsupportedImage: The file has a form whose cost does not follow from its pixels.
        MessageTooLarge: The image declares more than `max_pixels`, or the file has too many
            segments or bytes.
    """
    file = bytes(data)
    if file.startswith(JPEG_MAGIC):
        return _read_jpeg(file, max_pixels)
    if file.startswith(PNG_MAGIC):
        return _read_png(file, max_pixels)
    raise MalformedMessage(
        f"image: expected a JPEG or PNG file, got {len(file)} bytes starting {file[:4]!r}"
    )


def _read_jpeg(file: bytes, max_pixels: int) -> ImageFile:
    header = None
    at = 2
    segments = 0
    while segments < _MOST_SEGMENTS:
        segments += 1
        marker, start, end = _jpeg_segment(file, at)
        if marker in _SOF:
            if marker != _BASELINE:
                process = _PROCESSES.get(marker, f"SOF{marker - _BASELINE}")
                raise UnsupportedImage(
                    f"image: expected a baseline JPEG, got {process} coding; {_ENCODE_BASELINE}"
                )
            if header is not None:
                raise UnsupportedImage("image: expected a JPEG with one header, got two")
            header = file[start:end]
        if marker == _SOS:
            break
        at = end
    else:
        raise MessageTooLarge(
            f"image: expected a JPEG of at most {_MOST_SEGMENTS} segments, got more; encode it "
            "again without metadata"
        )
    if header is None:
        raise MalformedMessage("image: broken JPEG (its first scan precedes its header)")

    height, width, components, unit_height, unit_width = _jpeg_frame(header)
    _check_size(len(file), height, width, 6 * height * width, max_pixels)
    _check_only_scan(file, start, end, components)

    # The decoder pads an image to whole units of up to 32 x 32 pixels.
    padded_pixels = -(-height // unit_height) * unit_height * -(-width // unit_width) * unit_width
    seconds = _FILE_S + segments * _PART_S
    seconds += components * padded_pixels * _SAMPLE_S + len(file) * _JPEG_BYTE_S
    return ImageFile(file, height, width, seconds)


def _check_only_scan(file: bytes, start: int, end: int, components: int) -> None:
    """Raise an error unless the scan whose header is at `start` has all components, and the image
    ends after it.
    """
    scan_components = file[start] if end > start else 0
    following = _END_OF_SCAN.search(file, end)
    if following is None:
        raise MalformedMessage("image: broken JPEG (it ends within its scan)")
    marker = following.group()[1]
    if scan_components != components or marker != _EOI:
        got = f"a scan of {scan_components} of {components} components, then marker {marker:#x}"
        raise UnsupportedImage(
            f"image: expected a baseline JPEG with one scan of all components, got {got}; "
            f"{_ENCODE_BASELINE}"
        )


def _jpeg_segment(file: bytes, at: int) -> tuple[int, int, int]:
    """Return the marker at an offset, and the start and end of its data."""
    fill = _FILL.match(file, at)
    if fill is None:
        raise MalformedMessage(f"image: broken JPEG (no marker at byte {at})")
    at = fill.end()
    marker = file[at] if at < len(file) else _EOI
    size = int.from_bytes(file[at + 1 : at + 3], "big")
    start, end = at + 3, at + 1 + size
    if marker in (0x00, 0x01, _EOI) or 0xD0 <= marker <= 0xD8 or size < 2 or end > len(file):
        raise MalformedMessage(f"image: broken JPEG (marker {marker:#x} at byte {at})")
    return marker, start, end


def _jpeg_frame(header: bytes) -> tuple[int, int, int, int, int]:
    """Return the height and width of the image, the number of components, and the height and width
    of a unit, pixels.
    """
    if len(header) < 9 or len(header) != 6 + 3 * header[5]:
        raise MalformedMessage("image: broken JPEG (its header has another length)")
    precision, height, width, components = struct.unpack_from(">BHHB", header)
    sampling = header[7::3]
    unit_width, unit_height = (
        max(8 * (each >> 4) for each in sampling),
        max(8 * (each & 15) for each in sampling),
    )
    if precision != 8:
        raise UnsupportedImage(f"image: expected a JPEG of 8 bits, got {precision} bits")
    if components > 4 or not 0 < unit_width <= 32 or not 0 < unit_height <= 32:
        raise MalformedMessage("image: broken JPEG (its header has invalid components)")
    return height, width, components, unit_height, unit_width


def _read_png(file: bytes, max_pixels: int) -> ImageFile:
    chunks = _png_chunks(file)
    names = [name for name, _, _ in chunks]
    first, last = (names.index(b"IDAT"), len(names) - 1) if b"IDAT" in names else (0, 0)
    if (
        names[:1] != [b"IHDR"]
        or names.count(b"IHDR") > 1
        or chunks[0][2] - chunks[0][1] != 12 + PNG_HEADER.size
    ):
        raise MalformedMessage("image: broken PNG (it does not begin with its only header)")
    if (
        names[last:] != [b"IEND"]
        or names.count(b"PLTE") > 1
        or names[first:last] != [b"IDAT"] * (last - first)
    ):
        raise MalformedMessage(
            "image: broken PNG (its data are missing, incomplete or not in one piece)"
        )

    width, height, depth, colour, _, _, interlace = PNG_HEADER.unpack_from(file, 16)
    if colour not in _CHANNELS:
        raise MalformedMessage(f"image: broken PNG (colour type {colour} of {depth} bits)")
    if depth != 8 or interlace:
        kind = f"{depth} bits" + (" with interlacing" if interlace else "")
        raise UnsupportedImage(
            f"image: expected a PNG of 8 bits without interlacing, got {kind}; {_ENCODE_8_BITS}"
        )
    channels = _CHANNELS[colour]
    rows_bytes = height * (1 + width * channels)
    # The data of the most wasteful encoder, which codes each byte in 9 bits (`stb_image_write`).
    packed_bytes = rows_bytes + rows_bytes // 8 + 1024
    _check_size(len(file), height, width, packed_bytes, max_pixels)
    data_bytes = sum(end - start - 12 for _, start, end in chunks[first:last])
    if data_bytes > packed_bytes:
        raise MessageTooLarge(
            f"image: expected a PNG with at most {packed_bytes} bytes of data for {height}x{width} "
            f"pixels, got {data_bytes}; encode it again"
        )

    seconds = _PNG_FILE_S + rows_bytes * _PNG_S + height * _PNG_ROW_S + len(file) * _PNG_BYTE_S
    start = chunks[first][1] + 8
    if colour == _RGB and _first_filter(memoryview(file)[start : start + _PEEKED_BYTES]) == UP:
        scratch = 2 * rows_bytes
    else:
        scratch = _PILLOW_PIXEL_BYTES * height * (width + 1)
    return ImageFile(file, height, width, seconds, scratch, channels, tuple(chunks))


def _png_chunks(file: bytes) -> list[tuple[bytes, int, int]]:
    """Return the name, the start and the end of each critical chunk, until the final chunk."""
    critical = []
    at = len(PNG_MAGIC)
    for _ in range(_MOST_CHUNKS + len(file) // 4096):
        name = file[at + 4 : at + 8]
        end = at + 12 + int.from_bytes(file[at : at + 4], "big")
        if len(name) < 4 or end > len(file):
            raise MalformedMessage(f"image: broken PNG (a chunk at byte {at} is incomplete)")
        if name in _CRITICAL:
            critical.append((name, at, end))
        if name == b"IEND":
            return critical
        at = end
    raise MessageTooLarge("image: a PNG with too many chunks; encode it again")


def _first_filter(data: memoryview) -> int:
    """Return the filter of the first row, given the beginning of a PNG's data; -1 if it is
    unknown.
    """
    try:
        return (zlib.decompressobj().decompress(data, 1) or b"\xff")[0]
    except zlib.error:
        return -1


def _check_size(
    file_bytes: int, height: int, width: int, packed_bytes: int, max_pixels: int
) -> None:
    """Raise an error if an image is empty or has too many pixels, or if its file has more than
    `packed_bytes` and the bytes of metadata.
    """
    if not height or not width:
        raise MalformedMessage(
            f"image: expected at least 1x1 pixels, got a header with {height}x{width}"
        )
    if height * width > max_pixels:
        raise MessageTooLarge(
            f"image: expected at most {max_pixels} pixels, got {height}x{width} declared; send a "
            "smaller one, or raise `limits.pixels`"
        )
    max_bytes = packed_bytes + _MOST_METADATA
    if file_bytes > max_bytes:
        raise MessageTooLarge(
            f"image: expected a file of at most {max_bytes} bytes for {height}x{width} pixels, "
            f"got {file_bytes}; encode it again without metadata"
        )
