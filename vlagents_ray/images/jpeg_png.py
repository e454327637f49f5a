"""JPEG and PNG files of (H, W, 3) uint8 RGB images.

The structure of a file is checked first, see `vlagents_ray.images.image_file`: an image that
declares more pixels than the caller allows is rejected before memory is allocated for it.

PNG files are written with only numpy and zlib: all rows have the filter "Up" (the difference to the
row above), and zlib uses its run-length strategy. Searching for better filters or longer matches
takes several times as long, and saves only a few per cent on camera images with noise. Such files
are also decoded with numpy and zlib alone; other PNG files need Pillow.
"""

from __future__ import annotations

import base64
import io
import struct
import warnings
import zlib

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
    ImageFile,
    is_own_png,
    read_structure,
)

MAX_PIXELS = 4096 * 4096  # default limit for one image
_UP = 2


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
    rows[:, 0] = _UP
    rows[:1, 1:] = pixels[:1]
    np.subtract(pixels[1:], pixels[:-1], out=rows[1:, 1:])
    deflate = zlib.compressobj(1, zlib.DEFLATED, 15, 9, zlib.Z_RLE)
    data = deflate.compress(rows.data) + deflate.flush()
    header = PNG_HEADER.pack(width, height, *RGB8)
    return b"".join(
        (PNG_MAGIC, _chunk(b"IHDR", header), _chunk(b"IDAT", data), _chunk(b"IEND", b""))
    )


def decode(data: bytes | memoryview, max_pixels: int = MAX_PIXELS) -> np.ndarray:
    """Decode a JPEG or PNG file to (H, W, 3) uint8 RGB; its EXIF orientation is ignored.

    Raises:
        MalformedMessage: The data are not a complete image.
        MessageTooLarge: The image declares more than `max_pixels`, or its file has too many parts
            or bytes.
    """
    return decode_file(read_structure(data, max_pixels))


def decode_file(file: ImageFile) -> np.ndarray:
    """Decode a file whose structure has been checked, as `decode` does; raises
    `MalformedMessage`.
    """
    if not file.is_jpeg:
        image = _decode_own_png(file) if is_own_png(file.data, file.chunks) else None
        return _decode_png(file) if image is None else image

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
    """Decode any PNG file with Pillow.

    Only the chunks that the pixels need are passed to Pillow. It would read all other chunks in
    Python, and raises its own kinds of errors for some invalid ones.
    """
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        from vlagents_ray.registry import pip_install

        raise MissingDependency(f"PNG images need Pillow; {pip_install('serve')}") from error
    data = b"".join([PNG_MAGIC, *(file.data[start:end] for _, start, end in file.chunks)])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=("PNG",)) as picture:
                # Keep the upper 8 of 16 bits, as Pillow does for colours. For greys, Pillow would
                # clip the values.
                if picture.mode.startswith("I"):  # "I;16", or "I" before Pillow 11
                    grey = (np.asarray(picture) >> 8).astype(np.uint8)
                    return np.repeat(grey[:, :, None], 3, axis=2)
                return np.array(picture if picture.mode == "RGB" else picture.convert("RGB"))
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise MessageTooLarge(f"image: {error}") from error
    except (OSError, ValueError, SyntaxError) as error:
        raise MalformedMessage(f"image: broken PNG ({error})") from error


def _decode_own_png(file: ImageFile) -> np.ndarray | None:
    """Decode a file in the form that `encode_png` writes, with only the memory that its size needs.

    Return None if rows have other filters.
    """
    height, width = file.height, file.width
    _, start, end = file.chunks[1]
    stride = 1 + width * 3
    inflate = zlib.decompressobj()
    try:
        raw = inflate.decompress(memoryview(file.data)[start + 8 : end - 4], height * stride + 1)
    except zlib.error as error:
        raise MalformedMessage(f"image: broken PNG ({error})") from error
    # Zlib checks the checksum at the end of the data.
    if len(raw) != height * stride or not inflate.eof:
        raise MalformedMessage(
            f"image: broken PNG (its data are not {height} rows of {width} pixels)"
        )
    rows = np.frombuffer(raw, np.uint8).reshape(height, stride)
    if (rows[:, 0] != _UP).any():
        return None
    return np.add.accumulate(rows[:, 1:], axis=0, dtype=np.uint8).reshape(height, width, 3)


def _chunk(kind: bytes, data: bytes) -> bytes:
    """Return a chunk of a PNG file."""
    checksum = zlib.crc32(data, zlib.crc32(kind))
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", checksum)


def data_url(kind: str, data: bytes) -> str:
    """Return a URL with `data` of the media type `kind`."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def _check(image: np.ndarray) -> None:
    """Raise `InvalidObservation` unless an image can be encoded."""
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise InvalidObservation(
            f"image: expected (H, W, 3) uint8 RGB, got {image.shape} {image.dtype}"
        )
