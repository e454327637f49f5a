"""JPEG and PNG files of (H, W, 3) uint8 RGB images.

The structure of a file is checked first, see `vlagents_ray.images.image_file`: an image that
declares more pixels than the caller allows is rejected before memory is allocated for it.

PNG files are written with only numpy and zlib: all rows have the filter "Up" (the difference to the
row above), and zlib uses its run-length strategy. Searching for better filters or longer matches
takes several times as long, and saves only a few per cent on camera images with noise. Such files
are also decoded with numpy and zlib alone; the rows of other PNG files need Pillow.
"""

from __future__ import annotations

import base64
import io
import struct
import time
import warnings
import zlib
from collections.abc import Iterator

import numpy as np
import simplejpeg

from vlagents_ray.errors import (
    InvalidObservation,
    MalformedMessage,
    MessageTooLarge,
    MissingDependency,
)
from vlagents_ray.images.image_file import (
    PNG_HEADER,
    PNG_MAGIC,
    RGB8,
    UP,
    ImageFile,
    read_structure,
)

MAX_PIXELS = 4096 * 4096  # default limit for one image
# A PNG is unpacked in at most this number of slices, of at least this size in bytes. Each slice
# waits for Python's global lock.
_SLICES, _SLICE_BYTES = 32, 4096
# Maximum CPU time of unpacking a PNG, as a multiple of the estimated time of decoding it. Data of
# encoders take at most a third of the estimate, so this leaves room for machines that are six times
# slower. The last slice may take half of the estimate in addition.
_INFLATE_FACTOR = 2.0


def encode_jpeg(image: np.ndarray, quality: int = 85, subsampling: str = "444") -> bytes:
    """Encode an (H, W, 3) uint8 RGB image as JPEG, with subsampling "444", "422", "420" or
    "440".
    """
    _check(image)
    pixels = np.ascontiguousarray(image)
    data: bytes = simplejpeg.encode_jpeg(
        pixels, quality=quality, colorspace="RGB", colorsubsampling=subsampling
    )
    return data


def encode_png(image: np.ndarray) -> bytes:
    """Encode an (H, W, 3) uint8 RGB image as PNG, without loss."""
    _check(image)
    height, width, _ = image.shape
    pixels = np.ascontiguousarray(image).reshape(height, width * 3)
    rows = np.empty((height, 1 + width * 3), np.uint8)
    rows[:, 0] = UP
    rows[:1, 1:] = pixels[:1]
    np.subtract(pixels[1:], pixels[:-1], out=rows[1:, 1:])
    deflate = zlib.compressobj(1, zlib.DEFLATED, 15, 9, zlib.Z_RLE)
    data = deflate.compress(rows.data) + deflate.flush()
    header = PNG_HEADER.pack(width, height, *RGB8)
    return b"".join(
        [
            PNG_MAGIC,
            *_chunk_parts(b"IHDR", header),
            *_chunk_parts(b"IDAT", data),
            *_chunk_parts(b"IEND", b""),
        ]
    )


def decode(data: bytes | memoryview, max_pixels: int = MAX_PIXELS) -> np.ndarray:
    """Decode a JPEG or PNG file to (H, W, 3) uint8 RGB; its EXIF orientation is ignored.

    Raises:
        MalformedMessage: The data are not a complete image.
        UnsupportedImage: The file is neither a baseline JPEG nor a PNG of 8 bits without
            interlacing.
        MessageTooLarge: The image declares more than `max_pixels`, or its file has too many parts
            or bytes, or takes too long to unpack.
    """
    return decode_file(read_structure(data, max_pixels))


def decode_file(file: ImageFile) -> np.ndarray:
    """Decode a file whose structure has been checked, as `decode` does; raises
    `MalformedMessage` and `MessageTooLarge`.
    """
    if not file.is_jpeg:
        return _decode_png(file)

    # The default is the strict mode, which rejects truncated data. Otherwise, libjpeg would fill
    # the missing part with grey.
    try:
        # The library's default "fast" transform and upsampling would save a twentieth of the time,
        # but reduce the quality by up to 1.3 dB.
        picture: np.ndarray = simplejpeg.decode_jpeg(
            file.data, colorspace="RGB", fastdct=False, fastupsample=False
        )
    except ValueError as error:
        raise MalformedMessage(f"image: broken JPEG ({error})") from error
    return picture


def _decode_png(file: ImageFile) -> np.ndarray:
    """Decode a PNG file: with numpy if it is RGB and all its rows have the filter of `encode_png`,
    otherwise with Pillow.
    """
    height, width = file.height, file.width
    data = _inflate(file)
    rows = np.frombuffer(data, np.uint8).reshape(height, file.row_bytes)
    if file.channels == 3 and not (rows[:, 0] != UP).any():
        return np.add.accumulate(rows[:, 1:], axis=0, dtype=np.uint8).reshape(height, width, 3)
    stored = zlib.compress(data, 0)
    del rows, data  # so that at most two copies exist
    return _decode_with_pillow(file, stored)


def _inflate(file: ImageFile) -> bytes:
    """Return the unpacked rows of a PNG file, each with the byte of its filter.

    The data may consist of descriptions of Huffman tables that decode to almost nothing, so that
    their size does not bound the time. They are therefore unpacked in slices, as long as the time
    is in proportion to the estimate.
    """
    size = file.height * file.row_bytes
    end_s = time.thread_time() + _INFLATE_FACTOR * file.decoding_s
    inflate = zlib.decompressobj()
    rows: list[bytes] = []
    missing = size
    try:
        for part in _slices(file):
            if rows and time.thread_time() > end_s:
                raise MessageTooLarge(
                    "image: unpacking this PNG takes several times as long as its pixels need; "
                    "encode it again, or send JPEG"
                )
            rows.append(inflate.decompress(part, missing + 1))
            missing -= len(rows[-1])
            if missing < 0 or inflate.eof:
                break
    except zlib.error as error:
        raise MalformedMessage(f"image: broken PNG ({error})") from error
    # Zlib checks the checksum at the end of the data.
    if missing or not inflate.eof:
        raise MalformedMessage(
            f"image: broken PNG (its data are not {file.height} rows of {file.width} pixels)"
        )
    return b"".join(rows)


def _slices(file: ImageFile) -> Iterator[memoryview]:
    """Yield the compressed data of a PNG file in slices."""
    slice_bytes = max(_SLICE_BYTES, len(file.data) // _SLICES)
    data = memoryview(file.data)
    for name, start, end in file.chunks:
        if name == b"IDAT":
            # The first 8 bytes of a chunk are its size and name, and the last 4 its checksum.
            for at in range(start + 8, end - 4, slice_bytes):
                yield data[at : min(at + slice_bytes, end - 4)]


def _decode_with_pillow(file: ImageFile, stored: bytes) -> np.ndarray:
    """Decode a PNG with Pillow, whose rows are `stored` in the format of zlib without compression.

    Pillow receives a file with only the chunks that the pixels need. It would read all other chunks
    in Python, and raises its own kinds of errors for some invalid ones.
    """
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        from vlagents_ray.registry import pip_install

        raise MissingDependency(f"PNG images need Pillow; {pip_install('serve')}") from error
    head = [file.data[start:end] for name, start, end in file.chunks if name in (b"IHDR", b"PLTE")]
    data = b"".join([PNG_MAGIC, *head, *_chunk_parts(b"IDAT", stored), *_chunk_parts(b"IEND", b"")])
    del stored
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=("PNG",)) as picture:
                return np.array(picture if picture.mode == "RGB" else picture.convert("RGB"))
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise MessageTooLarge(f"image: {error}") from error
    except (OSError, ValueError, SyntaxError) as error:
        raise MalformedMessage(f"image: broken PNG ({error})") from error


def _chunk_parts(kind: bytes, data: bytes) -> tuple[bytes, bytes, bytes, bytes]:
    """Return the parts of a chunk of a PNG file."""
    checksum = zlib.crc32(data, zlib.crc32(kind))
    return struct.pack(">I", len(data)), kind, data, struct.pack(">I", checksum)


def data_url(kind: str, data: bytes) -> str:
    """Return a URL with `data` of the media type `kind`."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def _check(image: np.ndarray) -> None:
    """Raise `InvalidObservation` unless an image can be encoded."""
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise InvalidObservation(
            f"image: expected (H, W, 3) uint8 RGB, got {image.shape} {image.dtype}"
        )
