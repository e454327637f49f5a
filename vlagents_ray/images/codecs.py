"""Image codecs for the cameras of a message: raw pixels, PNG or JPEG.

Several threads are used if that is faster.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from vlagents_ray.errors import InvalidInput
from vlagents_ray.images import jpeg_png
from vlagents_ray.images.image_file import ImageFile, read_structure
from vlagents_ray.images.thread_map import MOST_THREADS, thread_map

if TYPE_CHECKING:
    from vlagents_ray.protocol.messages import Budget

T = TypeVar("T")

NAMES = ("raw", "lossless", "jpeg")
SUBSAMPLINGS = ("444", "422", "440", "420")

# Encoding times on one core, s per byte of pixels. Measured: JPEG 1 to 2 ns, PNG 6 to 12 ns.
_JPEG_S, _PNG_S = 1.7e-9, 7e-9


@dataclass(frozen=True, slots=True)
class ImageCodec:
    """The encoding of camera images in a message: "raw" pixels, "lossless" (PNG) or "jpeg".

    Only JPEG loses information, and only JPEG has settings. The default, quality 85 without
    subsampling, is the fastest setting of its signal-to-noise ratio: with subsampled colour ("422",
    "420") the same ratio needs quality 92 to 99, more bytes and as much time, and is never reached
    at saturated edges.

    Raises:
        InvalidInput: A setting has an unknown value.
    """

    name: str = "jpeg"
    quality: int = 85  # 1 to 100
    # Colour samples: "444" keeps all, "422" and "440" keep half, "420" keeps a quarter.
    subsampling: str = "444"

    def __post_init__(self) -> None:
        if self.name not in NAMES:
            raise InvalidInput(f"codec: expected one of {list(NAMES)}, got {self.name!r}")
        if not 1 <= self.quality <= 100:
            raise InvalidInput(f"quality: expected a number from 1 to 100, got {self.quality!r}")
        if self.subsampling not in SUBSAMPLINGS:
            raise InvalidInput(
                f"subsampling: expected one of {list(SUBSAMPLINGS)}, got {self.subsampling!r}"
            )

    def file(self, image: np.ndarray) -> bytes:
        """Encode an image, (H, W, 3) uint8 RGB, as a JPEG or PNG file; a raw codec has no files."""
        if self.name == "jpeg":
            return jpeg_png.encode_jpeg(image, self.quality, self.subsampling)
        return jpeg_png.encode_png(image)


RAW = ImageCodec("raw")
LOSSLESS = ImageCodec("lossless")
JPEG = ImageCodec("jpeg")


def encode_files(cameras: Sequence[np.ndarray], codec: ImageCodec) -> list[bytes]:
    """Encode (H, W, 3) uint8 RGB images as JPEG or PNG files, in their order."""
    work_s = (_JPEG_S if codec.name == "jpeg" else _PNG_S) * sum(image.size for image in cameras)
    return thread_map(codec.file, cameras, work_s)


def _decode_missing(
    files: Sequence[ImageFile],
    images: list[Any],
    missing: Sequence[int],
    budget: Budget,
    attributed: Callable[[Callable[[ImageFile], np.ndarray], ImageFile, int], np.ndarray],
) -> None:
    """Decode the files whose images are `missing`, and store these in `images`."""
    spent_s: dict[int, float] = {}  # CPU time by the index of the file

    def decode(index: int) -> np.ndarray:
        begun = time.thread_time()
        try:
            return attributed(jpeg_png.decode_file, files[index], index)
        finally:
            spent_s[index] = time.thread_time() - begun

    seconds = sum(files[index].decoding_s for index in missing)
    threads = 1 if budget.serial else MOST_THREADS
    scratch_bytes = sum(sorted(files[index].scratch_bytes for index in missing)[-threads:])
    is_bounded = all(files[index].is_jpeg for index in missing)
    with budget.decoding(seconds, scratch_bytes, is_bounded=is_bounded):
        try:
            decoded = (
                [decode(index) for index in missing]
                if budget.serial
                else thread_map(decode, missing, seconds)
            )
        finally:
            budget.spend(sum(spent_s.values()))
    for index, image in zip(missing, decoded, strict=True):
        images[index] = image


def decode_files(
    files: Sequence[bytes | memoryview], budget: Budget, names: Sequence[str] = ()
) -> list[np.ndarray]:
    """Decode JPEG or PNG files to (H, W, 3) uint8 RGB images, after reserving memory and time for
    all of them.

    `names` may contain the cameras' names, in the order of the files, for error messages.

    Raises:
        MalformedMessage: A file cannot be decoded.
        MessageTooLarge: The images, or the time to decode them, exceed the limits.
    """

    def attributed(convert: Callable[[Any], T], item: Any, index: int) -> T:
        """Return `convert(item)`.

        Its errors contain the name of the camera of the file at `index`.
        """
        try:
            return convert(item)
        except InvalidInput as error:
            if index >= len(names):
                raise
            message = str(error).removeprefix("image: ")
            raise type(error)(f"camera {names[index][:40]!r}: {message}") from error.__cause__

    budget.examine(sum(map(len, files)))
    begun = time.thread_time()
    read = partial(read_structure, max_pixels=budget.limits.pixels)
    checked = [attributed(read, file, index) for index, file in enumerate(files)]
    budget.spend(time.thread_time() - begun)
    budget.hold(sum(file.image_bytes for file in checked))

    images: list[Any] = [budget.image_of(file.data) for file in checked]
    missing = [index for index, image in enumerate(images) if image is None]
    _decode_missing(checked, images, missing, budget, attributed)
    for index in missing:
        budget.keep_image(checked[index].data, images[index])
    if budget.files is not None:
        budget.files.update(
            (id(image), (image, file)) for image, file in zip(images, files, strict=True)
        )
    return images
