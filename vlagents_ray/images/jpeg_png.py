"""JPEG and PNG files of (H, W, 3) uint8 RGB images.

A decoder reads the header first: an image that declares more pixels than the caller allows is refused before memory is
allocated for it.

PNG files are written with only numpy and zlib: all rows have the filter "Up" (the difference to the row above), and
zlib uses its run-length strategy. A search for better filters or longer matches takes several times as long and saves a
few per cent on camera images with noise. Files of this form are read in the same way; others need Pillow.
"""

from __future__ import annotations

import base64
import io
import struct
import warnings
import zlib

import numpy as np
import simplejpeg

from vlagents_ray.errors import InvalidObservation, MalformedMessage, MessageTooLarge, MissingDependency

MAX_PIXELS = 4096 * 4096  # default limit of one image
JPEG_MAGIC = b"\xff\xd8\xff"
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_PNG_HEADER = struct.Struct(">2I5B")  # width, height, depth, colour type, compression, filter, interlace
_RGB8 = (8, 2, 0, 0, 0)
_DATA_AT = len(_PNG_MAGIC) + 12 + _PNG_HEADER.size  # start of the chunk after the header
_UP = 2


def encode_jpeg(image: np.ndarray, quality: int = 85, subsampling: str = "444") -> bytes:
    """Encode an (H, W, 3) uint8 RGB image as JPEG, with subsampling "444", "422", "420" or "440"."""
    _check(image)
    pixels = np.ascontiguousarray(image)
    data: bytes = simplejpeg.encode_jpeg(pixels, quality=quality, colorspace="RGB", colorsubsampling=subsampling)
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
    header = _PNG_HEADER.pack(width, height, *_RGB8)
    return b"".join((_PNG_MAGIC, _chunk(b"IHDR", header), _chunk(b"IDAT", data), _chunk(b"IEND", b"")))


def size(data: bytes | memoryview, max_pixels: int = MAX_PIXELS) -> tuple[int, int]:
    """Return the (height, width) in the header of a JPEG or PNG file; raises the errors of `decode`."""
    head, view = bytes(data[:8]), memoryview(data)
    if head.startswith(JPEG_MAGIC):
        try:
            height, width, _, _ = simplejpeg.decode_jpeg_header(data)
        except ValueError as error:
            raise MalformedMessage(f"image: not a readable JPEG ({error})") from error
    elif head == _PNG_MAGIC:
        if len(view) < _DATA_AT or _chunk_name(view, 8) != b"IHDR":
            raise MalformedMessage("image: broken PNG (it does not begin with its header)")
        width, height, *_ = _PNG_HEADER.unpack_from(view, 16)
    else:
        raise MalformedMessage(f"image: got {len(data)} bytes starting {head[:4]!r}, want a JPEG or PNG file")
    if height * width > max_pixels:
        raise MessageTooLarge(
            f"image: declares {height}x{width} pixels, the limit is {max_pixels}; send a smaller one, or raise "
            f"`limits.pixels`"
        )
    return height, width


def decode(data: bytes | memoryview, max_pixels: int = MAX_PIXELS) -> np.ndarray:
    """Decode a JPEG or PNG file to (H, W, 3) uint8 RGB; its EXIF orientation is ignored.

    Raises:
        MalformedMessage: The data are not a complete image.
        MessageTooLarge: The image declares more than `max_pixels`.
    """
    declared = size(data, max_pixels)
    if bytes(data[:3]) != JPEG_MAGIC:
        own = _decode_own_png(memoryview(data), *declared)
        return _decode_png(data, declared) if own is None else own
    try:  # strict, the default, refuses truncated data, which libjpeg would fill with grey
        # The library's defaults, "fast" transform and upsampling, save a twentieth of the time and cost up to 1.3 dB.
        image: np.ndarray = simplejpeg.decode_jpeg(data, colorspace="RGB", fastdct=False, fastupsample=False)
    except ValueError as error:
        raise MalformedMessage(f"image: broken JPEG ({error})") from error
    return image


def _decode_png(data: bytes | memoryview, declared: tuple[int, int]) -> np.ndarray:
    """Decode any PNG file of the declared height and width, with Pillow."""
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        raise MissingDependency("PNG images need Pillow; pip install 'vlagents-ray[serve]'") from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=("PNG",)) as file:
                if (file.height, file.width) != declared:  # Pillow uses the last of several headers
                    raise MalformedMessage("image: broken PNG (it has two headers)")
                # The upper 8 of 16 bits, as Pillow does for colours; it would clip greys.
                if file.mode.startswith("I"):  # "I;16", or "I" before Pillow 11
                    grey = (np.asarray(file) >> 8).astype(np.uint8)
                    return np.repeat(grey[:, :, None], 3, axis=2)
                return np.array(file.convert("RGB"))
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise MessageTooLarge(f"image: {error}") from error
    except (OSError, ValueError, SyntaxError) as error:
        if isinstance(error, MalformedMessage):
            raise
        raise MalformedMessage(f"image: broken PNG ({error})") from error


def _decode_own_png(view: memoryview, height: int, width: int) -> np.ndarray | None:
    """Decode a file of the form of `encode_png`, with no more memory than its size needs; None for any other file."""
    if len(view) < _DATA_AT + 24 or _chunk_name(view, _DATA_AT) != b"IDAT":
        return None
    _, _, *form = _PNG_HEADER.unpack_from(view, 16)
    end = _DATA_AT + 12 + int.from_bytes(view[_DATA_AT : _DATA_AT + 4], "big")
    if tuple(form) != _RGB8 or end + 12 != len(view) or _chunk_name(view, end) != b"IEND":
        return None
    stride = 1 + width * 3
    inflate = zlib.decompressobj()
    try:
        raw = inflate.decompress(view[_DATA_AT + 8 : -16], height * stride + 1)
    except zlib.error as error:
        raise MalformedMessage(f"image: broken PNG ({error})") from error
    if len(raw) != height * stride or not inflate.eof:  # zlib compares the checksum at the end
        raise MalformedMessage(f"image: broken PNG (its data are not {height} rows of {width} pixels)")
    rows = np.frombuffer(raw, np.uint8).reshape(height, stride)
    if (rows[:, 0] != _UP).any():
        return None
    return np.add.accumulate(rows[:, 1:], axis=0, dtype=np.uint8).reshape(height, width, 3)


def _chunk_name(view: memoryview, at: int) -> bytes:
    return bytes(view[at + 4 : at + 8])


def _chunk(kind: bytes, data: bytes) -> bytes:
    checksum = zlib.crc32(data, zlib.crc32(kind))
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", checksum)


def data_url(kind: str, data: bytes) -> str:
    """Return a URL with `data` of the media type `kind`."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def _check(image: np.ndarray) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise InvalidObservation(f"image: got {image.shape} {image.dtype}, want (H, W, 3) uint8 RGB")
