"""JPEG keeps as much as the peers', PNG keeps everything, and broken files are refused by name."""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np
import pytest
import simplejpeg
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pictures import photograph, psnr, rendered
from PIL import Image

from vlagents_ray import images, png
from vlagents_ray.bench.rtt import observation
from vlagents_ray.errors import InvalidObservation, MalformedMessage, MessageTooLarge

PICTURES = {"bench": observation().cameras["camera_0"], "rendered": rendered(), "photograph": photograph()}
pixels = hnp.arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3)))


@pytest.mark.parametrize("name", PICTURES)
def test_a_jpeg_loses_no_more_than_by_vlagents(name: str) -> None:
    image = PICTURES[name]
    theirs = simplejpeg.decode_jpeg(simplejpeg.encode_jpeg(image))  # both ends of vlagents 0.3: all defaults
    assert psnr(image, images.decode(images.encode_jpeg(image))) >= psnr(image, theirs)


@pytest.mark.parametrize("name", PICTURES)
def test_any_reader_reads_our_png(name: str) -> None:
    image = PICTURES[name]
    file = images.encode_png(image)
    with Image.open(io.BytesIO(file)) as opened:
        np.testing.assert_array_equal(np.array(opened), image)
    assert len(file) < 0.8 * image.nbytes


@given(pixels)
def test_png_is_lossless(image: np.ndarray) -> None:
    assert png.size(images.encode_png(image)) == image.shape[:2]
    np.testing.assert_array_equal(images.decode(images.encode_png(image)), image)


@given(pixels)
def test_a_view_is_written_as_it_is_seen(image: np.ndarray) -> None:
    turned = image[::-1, ::-1]
    np.testing.assert_array_equal(images.decode(images.encode_png(turned)), turned)


@pytest.mark.parametrize("mode", ["RGB", "L", "P", "RGBA"])
def test_png_files_of_others_are_read(mode: str) -> None:
    file = io.BytesIO()
    with Image.fromarray(rendered()) as picture:
        picture.convert(mode).save(file, "PNG")
    assert images.decode(file.getvalue()).shape == (224, 224, 3)


@given(st.data())
def test_a_damaged_png_is_refused_or_harmless(data: st.DataObject) -> None:
    file = bytearray(images.encode_png(PICTURES["bench"][:16, :16]))
    for _ in range(data.draw(st.integers(1, 3))):
        file[data.draw(st.integers(8, len(file) - 1))] = data.draw(st.integers(0, 255))
    try:
        images.decode(bytes(file), max_pixels=4096)
    except (MalformedMessage, MessageTooLarge):
        return  # refused by name; anything else fails the test


def test_a_png_that_unpacks_to_more_than_it_declares_is_refused() -> None:
    file = images.encode_png(np.zeros((4, 4, 3), np.uint8))
    data = zlib.compress(bytes(50_000_000))
    chunk = struct.pack(">I", len(data)) + b"IDAT" + data + struct.pack(">I", zlib.crc32(b"IDAT" + data))
    with pytest.raises(MalformedMessage, match="4 rows"):
        images.decode(file[:33] + chunk + file[-12:])


def test_a_png_that_declares_too_much_is_refused() -> None:
    with pytest.raises(MessageTooLarge, match="declares 8x9"):
        images.decode(images.encode_png(np.zeros((8, 9, 3), np.uint8)), max_pixels=71)


@pytest.mark.parametrize("encode", [images.encode_jpeg, images.encode_png])
@pytest.mark.parametrize("shape", [(4, 4), (4, 4, 4), (0, 4, 3)])
def test_what_is_no_image_is_refused(encode: object, shape: tuple[int, ...]) -> None:
    with pytest.raises(InvalidObservation, match="want \\(H, W, 3\\) uint8 RGB"):
        encode(np.zeros(shape, np.uint8))
