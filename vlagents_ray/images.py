"""(H, W, 3) uint8 RGB <-> JPEG, PNG.

A decoder looks at the header first: an image that declares more pixels than the caller allows is
refused before any memory is taken for it.
"""

from __future__ import annotations

import io
import warnings

import numpy as np
import simplejpeg

from vlagents_ray import png
from vlagents_ray.errors import InvalidObservation, MalformedMessage, MessageTooLarge, MissingDependency

MAX_PIXELS = 4096 * 4096  # of one image, unless the caller says otherwise
JPEG_MAGIC = b"\xff\xd8\xff"


def encode_jpeg(image: np.ndarray, quality: int = 85, subsampling: str = "444") -> bytes:
    """JPEG of an (H, W, 3) uint8 RGB image. `subsampling` is "444", "422", "420" or "440"."""
    _check(image)
    pixels = np.ascontiguousarray(image)
    data: bytes = simplejpeg.encode_jpeg(pixels, quality=quality, colorspace="RGB", colorsubsampling=subsampling)
    return data


def encode_png(image: np.ndarray) -> bytes:
    """PNG of an (H, W, 3) uint8 RGB image: every pixel comes back as it was."""
    _check(image)
    return png.encode(image)


def decode(data: bytes | memoryview, max_pixels: int = MAX_PIXELS) -> np.ndarray:
    """The (H, W, 3) uint8 RGB image in a JPEG or PNG file.

    Raises `MalformedMessage` for anything that is not a whole image, `MessageTooLarge` for one
    that declares more than `max_pixels`.
    """
    head = bytes(data[:8])
    if head.startswith(JPEG_MAGIC):
        return _decode_jpeg(data, max_pixels)
    if head == png.MAGIC:
        return _decode_png(data, max_pixels)
    raise MalformedMessage(f"image: got {len(data)} bytes starting {head[:4]!r}, want a JPEG or PNG file")


def _decode_jpeg(data: bytes | memoryview, max_pixels: int) -> np.ndarray:
    try:
        height, width, _, _ = simplejpeg.decode_jpeg_header(data)
    except ValueError as error:
        raise MalformedMessage(f"image: not a readable JPEG ({error})") from error
    _limit(height, width, max_pixels)
    try:  # strict (its default) refuses truncated data, which libjpeg would fill with grey
        # The library's defaults, "fast" transform and upsampling, save a twentieth of the time and cost up to 1.3 dB.
        image: np.ndarray = simplejpeg.decode_jpeg(data, colorspace="RGB", fastdct=False, fastupsample=False)
    except ValueError as error:
        raise MalformedMessage(f"image: broken JPEG ({error})") from error
    return image


def _decode_png(data: bytes | memoryview, max_pixels: int) -> np.ndarray:
    if (size := png.size(data)) is not None:  # as our own clients write it
        _limit(*size, max_pixels)
        try:
            image = png.decode(data, *size)
        except ValueError as error:
            raise MalformedMessage(f"image: broken PNG ({error})") from error
        if image is not None:
            return image
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        raise MissingDependency("PNG images need Pillow; pip install 'vlagents-ray[serve]'") from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=("PNG",)) as file:
                _limit(file.height, file.width, max_pixels)
                return np.array(file.convert("RGB"))
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise MessageTooLarge(f"image: {error}") from error
    except (OSError, ValueError, SyntaxError) as error:
        if isinstance(error, MessageTooLarge):
            raise
        raise MalformedMessage(f"image: broken PNG ({error})") from error


def _check(image: np.ndarray) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise InvalidObservation(f"image: got {image.shape} {image.dtype}, want (H, W, 3) uint8 RGB")


def _limit(height: int, width: int, max_pixels: int) -> None:
    if height * width > max_pixels:
        raise MessageTooLarge(f"image: declares {height}x{width} pixels, the limit is {max_pixels}; send it smaller")
