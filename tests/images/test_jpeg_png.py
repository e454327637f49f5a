"""JPEG's quality equals that of other systems, PNG is lossless, and broken files are rejected with
their name.
"""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np
import pytest
import simplejpeg
from camera_images import psnr, rendered
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from benchmarks.own_clients import observation
from benchmarks.photographs import photograph
from vlagents_ray.errors import InvalidObservation, MalformedMessage, MessageTooLarge
from vlagents_ray.images import jpeg_png
from vlagents_ray.images.image_file import read_structure

PICTURES = {
    "bench": observation().cameras["camera_0"],
    "rendered": rendered(),
    "photograph": photograph(),
}
pixels = hnp.arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3)))


@pytest.mark.parametrize("name", PICTURES)
def test_a_jpeg_loses_no_more_than_by_vlagents(name: str) -> None:
    image = PICTURES[name]
    # The codec of vlagents 0.3 with all defaults.
    theirs = simplejpeg.decode_jpeg(simplejpeg.encode_jpeg(image))
    assert psnr(image, jpeg_png.decode(jpeg_png.encode_jpeg(image))) >= psnr(image, theirs)


@pytest.mark.parametrize("name", PICTURES)
def test_any_reader_reads_our_png(name: str) -> None:
    image = PICTURES[name]
    file = jpeg_png.encode_png(image)
    with Image.open(io.BytesIO(file)) as opened:
        np.testing.assert_array_equal(np.array(opened), image)
    assert len(file) < 0.8 * image.nbytes


@given(pixels)
def test_png_is_lossless(image: np.ndarray) -> None:
    file = jpeg_png.encode_png(image)
    structure = read_structure(file, image[:, :, 0].size)
    assert (structure.height, structure.width) == image.shape[:2]
    np.testing.assert_array_equal(jpeg_png.decode(file), image)
    turned = image[::-1, ::-1]  # a view is written in its own orientation
    np.testing.assert_array_equal(jpeg_png.decode(jpeg_png.encode_png(turned)), turned)


@pytest.mark.parametrize("mode", ["RGB", "L", "P", "RGBA"])
def test_png_files_of_others_are_read(mode: str) -> None:
    file = io.BytesIO()
    with Image.fromarray(rendered()) as picture:
        picture.convert(mode).save(file, "PNG")
    assert jpeg_png.decode(file.getvalue()).shape == (224, 224, 3)


@given(st.data())
def test_a_damaged_png_is_refused_or_harmless(data: st.DataObject) -> None:
    file = bytearray(jpeg_png.encode_png(PICTURES["bench"][:16, :16]))
    for _ in range(data.draw(st.integers(1, 3))):
        file[data.draw(st.integers(8, len(file) - 1))] = data.draw(st.integers(0, 255))
    try:
        jpeg_png.decode(bytes(file), max_pixels=4096)
    except (MalformedMessage, MessageTooLarge):
        return  # rejected with a named error; any other error fails the test


def test_a_png_that_declares_too_much_or_unpacks_to_more_than_that_is_refused() -> None:
    file = jpeg_png.encode_png(np.zeros((4, 4, 3), np.uint8))
    data = zlib.compress(bytes(50_000_000))
    chunk = (
        struct.pack(">I", len(data))
        + b"IDAT"
        + data
        + struct.pack(">I", zlib.crc32(b"IDAT" + data))
    )
    with pytest.raises(MessageTooLarge, match="bytes of data for 4x4"):
        jpeg_png.decode(file[:33] + chunk + file[-12:])
    data = zlib.compress(bytes(4 * 13 + 1))
    chunk = (
        struct.pack(">I", len(data))
        + b"IDAT"
        + data
        + struct.pack(">I", zlib.crc32(b"IDAT" + data))
    )
    with pytest.raises(MalformedMessage, match="4 rows"):
        jpeg_png.decode(file[:33] + chunk + file[-12:])
    with pytest.raises(MessageTooLarge, match="got 8x9 declared"):
        jpeg_png.decode(jpeg_png.encode_png(np.zeros((8, 9, 3), np.uint8)), max_pixels=71)


@pytest.mark.parametrize("encode", [jpeg_png.encode_jpeg, jpeg_png.encode_png])
@pytest.mark.parametrize("shape", [(4, 4), (4, 4, 4), (0, 4, 3)])
def test_what_is_no_image_is_refused(encode: object, shape: tuple[int, ...]) -> None:
    with pytest.raises(InvalidObservation, match="expected \\(H, W, 3\\) uint8 RGB"):
        encode(np.zeros(shape, np.uint8))


def test_exif_orientation_turns_nothing() -> None:
    """As documented, a camera's driver that only sets the orientation must rotate the pixels
    itself.
    """
    picture = rendered()[:100]
    plain, marked = io.BytesIO(), io.BytesIO()
    exif = Image.Exif()
    exif[0x0112] = 6  # rotated by 90 degrees
    Image.fromarray(picture).save(plain, "JPEG")
    Image.fromarray(picture).save(marked, "JPEG", exif=exif)
    np.testing.assert_array_equal(
        jpeg_png.decode(marked.getvalue()), jpeg_png.decode(plain.getvalue())
    )
