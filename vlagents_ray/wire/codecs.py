"""How cameras are written into a frame: raw pixels, PNG or JPEG; several of them at once where that is faster."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vlagents_ray import images
from vlagents_ray.errors import InvalidInput
from vlagents_ray.wire import parallel

NAMES = ("raw", "lossless", "jpeg")
SUBSAMPLINGS = ("444", "422", "440", "420")


@dataclass(frozen=True, slots=True)
class ImageCodec:
    """How cameras are written: "raw" pixels, "lossless" (PNG) or "jpeg". Lossy coding is the caller's choice.

    Only JPEG has settings. Quality 85 without subsampling is the default because no other setting that
    keeps as many decibels is faster: with halved colour ("422", "420") the same PSNR takes quality 92
    to 99, more bytes and, all in all, as long; across saturated edges it is never reached.
    """

    name: str = "jpeg"
    quality: int = 85  # 1 to 100
    subsampling: str = "444"  # of colour: "444" none, "422" and "440" by half, "420" by four

    def __post_init__(self) -> None:
        if self.name not in NAMES:
            raise InvalidInput(f"codec: got {self.name!r}, want one of {list(NAMES)}")
        if not 1 <= self.quality <= 100:
            raise InvalidInput(f"quality: got {self.quality!r}, want 1 to 100")
        if self.subsampling not in SUBSAMPLINGS:
            raise InvalidInput(f"subsampling: got {self.subsampling!r}, want one of {list(SUBSAMPLINGS)}")

    @property
    def exact(self) -> bool:
        """Does every pixel arrive as it was?"""
        return self.name != "jpeg"

    def file(self, image: np.ndarray) -> bytes:
        """The JPEG or PNG file of an (H, W, 3) uint8 RGB image; a raw codec writes none."""
        if self.name == "jpeg":
            return images.encode_jpeg(image, self.quality, self.subsampling)
        return images.encode_png(image)


RAW = ImageCodec("raw")
LOSSLESS = ImageCodec("lossless")
JPEG = ImageCodec("jpeg")


def encode_files(cameras: Sequence[np.ndarray], codec: ImageCodec) -> list[bytes]:
    """The JPEG or PNG files of (H, W, 3) uint8 RGB images, in their order."""
    kind = codec.name if codec.name != "jpeg" else codec
    return parallel.run(codec.file, cameras, (kind, parallel.scale(sum(image.size for image in cameras))))


def decode_files(files: Sequence[bytes | memoryview], max_pixels: int) -> list[np.ndarray]:
    """The (H, W, 3) uint8 RGB images in JPEG or PNG files; errors as of `images.decode`."""

    def decode(file: bytes | memoryview) -> np.ndarray:
        return images.decode(file, max_pixels)

    return parallel.run(decode, files, ("decode", parallel.scale(sum(map(len, files)))))
