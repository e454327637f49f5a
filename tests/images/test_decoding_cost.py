"""No file costs much more than its structure predicts, which a search for such files shows."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import hostile_images
import numpy as np
import pytest
import simplejpeg
from camera_images import rendered
from hostile_images import JPEG_CHOICES, PNG_CHOICES, JpegRecipe, PngRecipe
from PIL import Image, ImageFile

from vlagents_ray.errors import MalformedMessage, MessageTooLarge, UnsupportedImage
from vlagents_ray.images import jpeg_png
from vlagents_ray.images.codecs import decode_files
from vlagents_ray.images.image_file import read_structure
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Budget

PIXELS = hostile_images.PIXELS
FACTOR = 3.0  # allowed CPU time relative to the estimate; without the checks it was up to 38
FILES = 150  # files of each search; 1,500 JPEG files find 1.8 times the estimate
ROUNDS = 6
SLACK = 6 * 2**20  # bytes of buffers in the libraries and the interpreter
CAMERA = np.kron(
    np.random.default_rng(0).integers(0, 256, (128, 128, 3), np.uint8), np.ones((8, 8, 1), np.uint8)
)
NOISE = np.random.default_rng(1).integers(0, 256, (512, 256, 3), np.uint8)
FIRST = {"PNG": (PngRecipe(), PNG_CHOICES), "JPEG": (JpegRecipe(), JPEG_CHOICES)}


def saved(image: np.ndarray, kind: str, **options: object) -> bytes:
    file = io.BytesIO()
    # Pillow's encoder needs room for a whole progressive file.
    ImageFile.MAXBLOCK = max(ImageFile.MAXBLOCK, 2**22)
    Image.fromarray(image).save(file, kind, **options)
    return file.getvalue()


HONEST = {
    "JPEG": lambda: jpeg_png.encode_jpeg(CAMERA),
    "JPEG of noise": lambda: jpeg_png.encode_jpeg(NOISE, 100),
    "PNG": lambda: jpeg_png.encode_png(CAMERA),
    "PNG of noise": lambda: jpeg_png.encode_png(NOISE),
    "PNG of others": lambda: saved(CAMERA, "PNG"),
}


@pytest.fixture(scope="module")
def speed() -> float:
    """Return the factor by which this machine is currently slower than the estimates; at least
    1.
    """
    ratios = []
    for make in HONEST.values():
        cpu_s, estimate_s, accepted = hostile_images.cpu_and_estimate_s(make(), ROUNDS)
        assert accepted
        ratios.append(cpu_s / estimate_s)
    return max(1.0, *ratios)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("least_pixels", [1, 2**12], ids=["any", "large"])
@pytest.mark.parametrize("kind", FIRST)
def test_no_file_takes_much_longer_than_its_estimate(
    speed: float,
    kind: str,
    least_pixels: int,
    seed: int,
    record_property: Callable[[str, object], None],
) -> None:
    """A server decides by the estimate where it decodes a file, and whether it decodes it at all.
    A file that is rejected takes no longer than a few of its bytes.
    """
    first, choices = FIRST[kind]
    found = hostile_images.search(first, choices, FILES, seed, least_pixels)
    accepted = [file for file in found if file.accepted]
    rejected = [file for file in found if not file.accepted]
    assert len(accepted) >= FILES / 10  # otherwise the search has seen nothing
    worst = []
    for group in (accepted, rejected):
        candidates = sorted(group, key=lambda file: -file.ratio)[:5]
        again = [hostile_images.played(file.recipe, ROUNDS) for file in candidates]
        worst.append(max(again, key=lambda file: file.ratio))
    record_property("worst", [str(file) for file in worst])
    print(f"SEARCH {kind}, {least_pixels}: {len(found)} files, worst {worst[0]}; {worst[1]}")
    assert max(file.ratio for file in worst) < FACTOR * speed, "\n".join(map(str, worst))


@pytest.mark.parametrize("recipe", [PngRecipe(), JpegRecipe(), *hostile_images.WORST.values()])
def test_the_files_from_which_the_search_begins_are_accepted(
    recipe: PngRecipe | JpegRecipe,
) -> None:
    structure = read_structure(recipe.file(), PIXELS)
    assert (structure.height, structure.width) == (recipe.height, recipe.width)


@pytest.mark.slow
@pytest.mark.parametrize("filters", [(0,), (1,), (2,), (3,), (4,), (0, 1, 2, 3, 4)])
@pytest.mark.parametrize("colour", [0, 2, 3, 4, 6])
@pytest.mark.parametrize("blocks", ["zlib", "fixed", "dynamic"])
def test_pngs_of_all_filters_colours_and_blocks_have_the_pixels_that_pillow_reads(
    filters: tuple[int, ...], colour: int, blocks: str
) -> None:
    recipe = PngRecipe(24, 31, colour=colour, filters=filters, blocks=blocks, noise=True)
    file = dataclasses.replace(recipe, idat_bytes=700).file()
    with Image.open(io.BytesIO(file)) as picture:
        expected = np.array(picture.convert("RGB"))
    np.testing.assert_array_equal(jpeg_png.decode(file), expected)


def peak_bytes() -> int:
    [line] = [
        line
        for line in Path("/proc/self/status").read_text().splitlines()
        if line.startswith("VmHWM")
    ]
    return int(line.split()[1]) * 1024


LARGE = {
    **HONEST,
    "PNG of filters": PngRecipe(1024, 1024, filters=(1, 2, 3, 4), colour=6).file,
    "PNG of one column": PngRecipe(2**20, 1, filters=(4,)).file,
    "PNG of one row": PngRecipe(1, 2**20).file,
    "PNG with a palette": PngRecipe(1024, 1024, colour=3).file,
    "JPEG of one row": JpegRecipe(1, 65_500, sampling=(0x41, 0x11, 0x11)).file,
    "JPEG of four components": JpegRecipe(1024, 1024, sampling=(0x11,) * 4).file,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LARGE)
def test_decoding_takes_no_more_memory_than_it_reserves(name: str) -> None:
    file = LARGE[name]()
    structure = read_structure(file, PIXELS)
    try:
        # This resets the peak to the current memory.
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pytest.skip("this system does not let a process reset its peak")
    before = peak_bytes()
    image = jpeg_png.decode_file(structure)
    reserved = structure.image_bytes + structure.scratch_bytes
    assert peak_bytes() - before < reserved + 3 * len(file) + SLACK
    assert image.shape == (structure.height, structure.width, 3)


JPEG_REFUSALS = [
    (
        {"process": 0xC2},
        UnsupportedImage,
        "got progressive coding; encode it with progressive=False",
    ),
    ({"process": 0xC1}, UnsupportedImage, "got extended coding"),
    ({"process": 0xC9}, UnsupportedImage, "got arithmetic coding"),
    ({"process": 0xCA}, UnsupportedImage, "got arithmetic coding"),
    ({"process": 0xC3}, UnsupportedImage, "got SOF3 coding"),
    ({"precision": 12}, UnsupportedImage, "8 bits, got 12 bits"),
    ({"headers": 2}, UnsupportedImage, "one header, got two"),
    ({"scans": 2}, UnsupportedImage, "one scan of all components"),
    ({"sampling": (0x11,) * 3, "interleaved": False}, UnsupportedImage, "a scan of 1 of 3"),
    ({"segments": 1, "are_behind": True}, UnsupportedImage, "then marker 0xfe"),
    ({"segments": 70}, MessageTooLarge, "at most 64 segments"),
    ({"height": 0}, MalformedMessage, "at least 1x1"),
    ({"width": 0}, MalformedMessage, "at least 1x1"),
    ({"trailing": 100_000}, MessageTooLarge, "without metadata"),
]
PNG_REFUSALS = [
    ({"depth": 16}, UnsupportedImage, "8 bits without interlacing, got 16 bits; convert it to 8"),
    ({"depth": 1, "colour": 0}, UnsupportedImage, "got 1 bits"),
    ({"interlace": 1}, UnsupportedImage, "got 8 bits with interlacing"),
    ({"chunks": 100}, MessageTooLarge, "too many chunks"),
    ({"chunks": 1, "chunk_name": b"IDAT"}, MalformedMessage, "broken PNG"),
    ({"chunks": 2, "chunk_name": b"PLTE"}, MalformedMessage, "not in one piece"),
    ({"height": 0}, MalformedMessage, "at least 1x1"),
    ({"width": 0}, MalformedMessage, "at least 1x1"),
    ({"filler": "stored", "filler_share": 1.5}, MessageTooLarge, "bytes of data for 64x64 pixels"),
    (
        {"height": 256, "width": 256, "filler": "dynamic", "filler_share": 0.9},
        MessageTooLarge,
        "several times as long",
    ),
]


@pytest.mark.parametrize(
    ("recipe", "error", "message"),
    [
        *((JpegRecipe(**choices), error, message) for choices, error, message in JPEG_REFUSALS),
        *((PngRecipe(**choices), error, message) for choices, error, message in PNG_REFUSALS),
    ],
)
def test_a_refusal_names_what_is_wrong_and_the_cure(
    recipe: PngRecipe | JpegRecipe, error: type[MalformedMessage], message: str
) -> None:
    with pytest.raises(error, match=message) as refused:
        jpeg_png.decode(recipe.file(), PIXELS)
    if error is UnsupportedImage:
        assert (refused.value.status, refused.value.code) == (415, "unsupported_image")


def test_a_client_that_rewrites_its_memory_meanwhile_changes_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Over shared memory, a file may change between the check of its structure and its decoding."""
    memory = bytearray(jpeg_png.encode_jpeg(rendered()))
    original = jpeg_png.decode_file

    def rewritten(file: jpeg_png.ImageFile) -> np.ndarray:
        memory[:] = bytes(len(memory))
        return original(file)

    monkeypatch.setattr(jpeg_png, "decode_file", rewritten)
    [image] = decode_files([memoryview(memory)], Budget(DEFAULT_LIMITS))
    assert image.shape == rendered().shape
    assert not any(memory)


@pytest.mark.parametrize("sampling", ["444", "422", "440", "420", "411", "Gray"])
def test_jpegs_of_simplejpeg_are_decoded(sampling: str) -> None:
    """vlagents' clients and cameras' drivers use it."""
    file = simplejpeg.encode_jpeg(rendered(), colorsubsampling=sampling)
    assert jpeg_png.decode(file).shape == (224, 224, 3)


@pytest.mark.parametrize("kind", [".jpg", ".png"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_files_of_opencv_are_decoded(kind: str, channels: int) -> None:
    """GR00T's, XPolicyLab's and LeRobot's clients use it."""
    cv2 = pytest.importorskip("cv2")
    image = np.dstack([rendered(), rendered()])[:, :, :channels]
    options = [cv2.IMWRITE_JPEG_RST_INTERVAL, 4, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    for chosen in ([], options if kind == ".jpg" else [cv2.IMWRITE_PNG_COMPRESSION, 9]):
        file = cv2.imencode(kind, image, chosen)[1].tobytes()
        assert jpeg_png.decode(file).shape == (224, 224, 3)


@pytest.mark.parametrize(("codec", "form"), [("mjpeg", "yuvj420p"), ("png", "rgb24")])
def test_files_of_ffmpeg_are_decoded(codec: str, form: str) -> None:
    av = pytest.importorskip("av")
    encoder = av.CodecContext.create(codec, "w")
    encoder.width = encoder.height = 224
    encoder.pix_fmt, encoder.time_base = form, Fraction(1, 30)
    frame = av.VideoFrame.from_ndarray(rendered(), format="rgb24").reformat(format=form)
    packets = [*encoder.encode(frame), *encoder.encode(None)]
    assert jpeg_png.decode(b"".join(map(bytes, packets))).shape == (224, 224, 3)


@pytest.mark.parametrize("mode", ["L", "LA", "P", "RGB", "RGBA"])
@pytest.mark.parametrize(
    "options", [{}, {"optimize": True}, {"dpi": (72, 72)}, {"compress_level": 0}]
)
def test_pngs_keep_their_pixels_without_their_other_chunks(
    mode: str, options: dict[str, object]
) -> None:
    picture = Image.fromarray(rendered()).convert(mode)
    file = io.BytesIO()
    picture.save(file, "PNG", **options)
    np.testing.assert_array_equal(
        jpeg_png.decode(file.getvalue()), np.array(picture.convert("RGB"))
    )


@pytest.mark.parametrize("transparent", [0, b"\0\x80\xff"])
def test_a_palette_with_transparency_keeps_its_colours(transparent: int | bytes) -> None:
    picture = Image.fromarray(rendered()).convert("P")
    file = io.BytesIO()
    picture.save(file, "PNG", transparency=transparent)
    np.testing.assert_array_equal(
        jpeg_png.decode(file.getvalue()), np.array(picture.convert("RGB"))
    )


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"optimize": True},
        {"quality": 100, "subsampling": 0},
        {"restart_marker_rows": 1},
    ],
)
@pytest.mark.parametrize("grey", [False, True])
def test_jpegs_of_other_encoders_are_decoded(options: dict[str, object], grey: bool) -> None:
    image = rendered()[:, :, 0] if grey else rendered()
    exif = Image.Exif()
    exif[0x010E] = "a description"
    file = saved(image, "JPEG", exif=exif, icc_profile=bytes(3000), comment="a comment", **options)
    assert jpeg_png.decode(file).shape == (224, 224, 3)
