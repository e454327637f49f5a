"""The structure of a JPEG or PNG file, which is checked before any part of the file is decoded.

The image size in the header of a file does not bound the cost of decoding: a progressive JPEG may
have any number of scans, of 12 bytes each, and a PNG any number of chunks. The check therefore
reads the structure, and estimates the cost from the work of the decoder: samples with their
padding, scans, rows and bytes.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

import numpy as np

from vlagents_ray.errors import MalformedMessage, MessageTooLarge

JPEG_MAGIC = b"\xff\xd8\xff"
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
# Format of the PNG header: width, height, depth, colour type, compression, filter, interlace.
PNG_HEADER = struct.Struct(">2I5B")
# Header fields after the size, for an RGB image of 8 bits without interlacing.
RGB8 = (8, 2, 0, 0, 0)

# Limits of the structure. Typical encoders write about ten scans, and chunks of at least 4 KiB.
_MOST_SCANS = 100
# The largest number of segments of a JPEG before its first scan, or of chunks of a PNG. One more is
# allowed for each KiB of the file.
_MOST_SEGMENTS = 256
_MOST_METADATA = 64 * 1024  # bytes that a file may have in addition to twice the size of its pixels

# Estimated times on one core. No known kind of file takes more than three times as long.
_FILE_S = 20e-6
_SAMPLE_S = 1.7e-9  # per sample of a JPEG
_SCAN_S = 0.1e-9  # per sample of a JPEG and scan after the first
_BASELINE_BYTE_S, _PROGRESSIVE_BYTE_S = 5e-9, 20e-9  # per byte of a JPEG
# Times per byte of the unpacked rows, for files of `encode_png` and for files that Pillow decodes.
_OWN_PNG_S, _PNG_S = 7e-9, 12e-9
_PILLOW_S = 70e-6  # per PNG file that Pillow decodes
_PILLOW_ROW_S = 0.1e-6  # per row that Pillow decodes
# The memory that Pillow needs in addition to the result, bytes per pixel: the image in 32 bits, and
# copies of it.
_PILLOW_PIXEL_BYTES = 16

_SOF = {0xC0: "baseline", 0xC1: "extended", 0xC2: "progressive"}
# Markers of lossless, hierarchical or arithmetic coding.
_OTHER_SOF = {*range(0xC3, 0xD0)} - {0xC4, 0xC8, 0xCC}
_SOS, _EOI = 0xDA, 0xD9
_FILL = re.compile(b"\xff+")  # fill bytes, any number of which may precede a marker
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # PNG colour type -> number of channels
_CRITICAL = (b"IHDR", b"PLTE", b"IDAT", b"IEND")


@dataclass(frozen=True, slots=True)
class ImageFile:
    """A file whose structure has been checked, with the cost of decoding it."""

    data: bytes  # a copy, since the sender may still write into shared memory
    height: int
    width: int
    decoding_s: float  # estimated time on one core, s
    scratch_bytes: int  # memory that decoding needs in addition to the image, bytes
    # The name, start and end of each critical chunk of a PNG.
    chunks: tuple[tuple[bytes, int, int], ...] = ()

    @property
    def is_jpeg(self) -> bool:
        return not self.chunks

    @property
    def image_bytes(self) -> int:
        """The size of the decoded image, (H, W, 3) uint8, in bytes."""
        return 3 * self.height * self.width


def read_structure(data: bytes | memoryview, max_pixels: int) -> ImageFile:
    """Check the structure of a JPEG or PNG file, and estimate the cost of decoding it.

    Raises:
        MalformedMessage: The data are not a JPEG or PNG file, or are a variant that no camera
            writes.
        MessageTooLarge: The image declares more than `max_pixels`, or the file has too many scans,
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
    frame = None
    at = 2
    for _ in range(_MOST_SEGMENTS + len(file) // 1024):
        marker, start, end = _jpeg_segment(file, at)
        if marker in _OTHER_SOF:
            raise MalformedMessage(
                "image: expected a JPEG with baseline or progressive Huffman coding, got the "
                f"process SOF{marker - 0xC0}; encode it again"
            )
        if marker in _SOF:
            if frame is not None:
                raise MalformedMessage("image: broken JPEG (it has two headers)")
            frame = marker, file[start:end]
        if marker == _SOS:
            break
        at = end
    else:
        raise MessageTooLarge(
            "image: a JPEG with too many segments before its first scan; encode it again"
        )
    if frame is None:
        raise MalformedMessage("image: broken JPEG (its first scan precedes its header)")

    kind, header = frame
    height, width, components, unit_height, unit_width = _jpeg_frame(header)
    _check_size(len(file), height, width, 3, max_pixels)
    scans = _count_scans(file)
    if scans > _MOST_SCANS:
        raise MessageTooLarge(
            f"image: expected a JPEG of at most {_MOST_SCANS} scans, got {scans}; encode it again"
        )

    # The decoder pads an image to whole units of up to 32 x 32 pixels.
    padded_pixels = -(-height // unit_height) * unit_height * -(-width // unit_width) * unit_width
    samples = components * padded_pixels
    is_buffered = (
        kind == 0xC2 or scans > 1 or (components > 1 and end - start != 4 + 2 * components)
    )
    byte_s = _PROGRESSIVE_BYTE_S if is_buffered else _BASELINE_BYTE_S
    seconds = _FILE_S + samples * (_SAMPLE_S + (scans - 1) * _SCAN_S) + len(file) * byte_s
    coefficients = 2 * samples if is_buffered else 0  # coefficients of 16 bits, for the whole image
    return ImageFile(file, height, width, seconds, coefficients)


def _count_scans(file: bytes) -> int:
    """Return the number of markers of a scan, including bytes of metadata that look like one."""
    # `bytes.count` of two bytes takes 2 (15 kB) to 8 times (75 kB) as long.
    codes = np.frombuffer(file, np.uint8)
    return int(np.count_nonzero((codes[:-1] == 0xFF) & (codes[1:] == _SOS)))


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
    if precision != 8 or components > 4 or not 0 < unit_width <= 32 or not 0 < unit_height <= 32:
        raise MalformedMessage("image: expected a JPEG of 8 bits with a valid header, got another")
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

    width, height, depth, colour, *_ = PNG_HEADER.unpack_from(file, 16)
    if colour not in _CHANNELS or depth > 16:
        raise MalformedMessage(f"image: broken PNG (colour type {colour} of {depth} bits)")
    bits = _CHANNELS[colour] * depth
    rows_bytes = height * (1 + -(-width * bits // 8))
    _check_size(len(file), height, width, max(3, bits // 8), max_pixels)

    if is_own_png(file, chunks):
        seconds, scratch = _FILE_S + rows_bytes * _OWN_PNG_S, 2 * rows_bytes
    else:
        seconds = _PILLOW_S + rows_bytes * _PNG_S + height * _PILLOW_ROW_S
        scratch = _PILLOW_PIXEL_BYTES * height * (width + 1)
    return ImageFile(
        file, height, width, seconds + len(file) * _BASELINE_BYTE_S, scratch, tuple(chunks)
    )


def _png_chunks(file: bytes) -> list[tuple[bytes, int, int]]:
    """Return the name, the start and the end of each critical chunk, until the final chunk."""
    critical = []
    at = len(PNG_MAGIC)
    for _ in range(_MOST_SEGMENTS + len(file) // 1024):
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


def is_own_png(
    file: bytes, chunks: list[tuple[bytes, int, int]] | tuple[tuple[bytes, int, int], ...]
) -> bool:
    """Return whether a PNG has exactly the chunks that `encode_png` writes."""
    header_end, data_start = chunks[0][2], chunks[1][1]
    is_whole = len(chunks) == 3 and header_end == data_start and chunks[2][2] == len(file)
    return (
        is_whole and chunks[1][2] == chunks[2][1] and PNG_HEADER.unpack_from(file, 16)[2:] == RGB8
    )


def _check_size(
    file_bytes: int, height: int, width: int, pixel_bytes: int, max_pixels: int
) -> None:
    if not height or not width:
        raise MalformedMessage(
            f"image: expected at least 1x1 pixels, got a header with {height}x{width}"
        )
    if height * width > max_pixels:
        raise MessageTooLarge(
            f"image: expected at most {max_pixels} pixels, got {height}x{width} declared; send a "
            "smaller one, or raise `limits.pixels`"
        )
    max_bytes = 2 * pixel_bytes * height * width + _MOST_METADATA
    if file_bytes > max_bytes:
        raise MessageTooLarge(
            f"image: expected a file of at most {max_bytes} bytes for {height}x{width} pixels, "
            f"got {file_bytes}; encode it again without metadata"
        )
