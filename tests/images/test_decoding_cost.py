"""No file costs much more than a normal one with as many pixels and bytes, nor more than its
structure predicts.
"""

from __future__ import annotations

import contextlib
import io
import time
from pathlib import Path

import hostile_images
import numpy as np
import pytest
from camera_images import rendered
from hostile_images import FILES
from PIL import Image, ImageFile

from vlagents_ray.errors import MalformedMessage, MessageTooLarge
from vlagents_ray.images import jpeg_png
from vlagents_ray.images.codecs import decode_files
from vlagents_ray.images.image_file import read_structure
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Budget

SIZE = 400_000  # bytes of a hostile file whose size can be chosen
PIXELS = 2**20
FACTOR = 4.0  # allowed slowdown relative to normal files; without a bound it was 20 to 400
ROUNDS = 3
SLACK = 6 * 2**20  # bytes of buffers in the libraries and the interpreter

CAMERA = np.kron(
    np.random.default_rng(0).integers(0, 256, (128, 128, 3), np.uint8), np.ones((8, 8, 1), np.uint8)
)
# As many bytes as in a hostile file.
NOISE = np.random.default_rng(1).integers(0, 256, (512, 256, 3), np.uint8)


def decode_or_refuse(file: bytes) -> None:
    with contextlib.suppress(MalformedMessage, MessageTooLarge):
        jpeg_png.decode(file, PIXELS)


def cpu_s(file: bytes) -> float:
    """Return the shortest CPU time of this thread in which a file is decoded or rejected."""
    times = []
    for _ in range(ROUNDS):
        begun = time.thread_time()
        decode_or_refuse(file)
        times.append(time.thread_time() - begun)
    return min(times)


def saved(image: np.ndarray, kind: str, **options: object) -> bytes:
    file = io.BytesIO()
    # Pillow's encoder needs room for a whole progressive file.
    ImageFile.MAXBLOCK = max(ImageFile.MAXBLOCK, 2**22)
    Image.fromarray(image).save(file, kind, **options)
    return file.getvalue()


@pytest.fixture(scope="module")
def honest() -> dict[str, tuple[bytes, float]]:
    """Return camera files with a megapixel or with as many bytes as the hostile ones, and the CPU
    time of each in s.
    """
    files = {
        "JPEG": jpeg_png.encode_jpeg(CAMERA),
        "JPEG of noise": jpeg_png.encode_jpeg(NOISE, 100),
        "progressive JPEG": saved(CAMERA, "JPEG", progressive=True),
        "PNG": jpeg_png.encode_png(CAMERA),
        "PNG of noise": jpeg_png.encode_png(NOISE),
        "PNG of others": saved(CAMERA, "PNG"),
    }
    return {name: (file, cpu_s(file)) for name, file in files.items()}


@pytest.fixture(scope="module")
def speed(honest: dict[str, tuple[bytes, float]]) -> float:
    """Return the factor by which this machine is currently slower than the estimates."""
    return max(
        seconds / read_structure(file, PIXELS).decoding_s for file, seconds in honest.values()
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_a_hostile_file_takes_no_longer_than_honest_ones(
    name: str, honest: dict[str, tuple[bytes, float]]
) -> None:
    kind = name.partition(":")[0]
    of_kind = [seconds for label, (_, seconds) in honest.items() if kind in label]
    assert cpu_s(FILES[name](SIZE)) < FACTOR * sum(of_kind)


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_decoding_takes_no_longer_than_its_estimate(name: str, speed: float) -> None:
    """With this estimate, a server decides where it decodes a file, and whether it decodes it at
    all.
    """
    file = FILES[name](SIZE)
    try:
        structure = read_structure(file, PIXELS)
    except (MalformedMessage, MessageTooLarge):
        return  # rejected before anything is decoded
    assert cpu_s(file) < FACTOR * max(1.0, speed) * structure.decoding_s


def peak_bytes() -> int:
    [line] = [
        line
        for line in Path("/proc/self/status").read_text().splitlines()
        if line.startswith("VmHWM")
    ]
    return int(line.split()[1]) * 1024


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [*FILES, "honest JPEG", "honest PNG", "honest PNG of others", "honest progressive JPEG"]
)
def test_decoding_takes_no_more_memory_than_it_reserves(
    name: str, honest: dict[str, tuple[bytes, float]]
) -> None:
    file = (
        honest[name.removeprefix("honest ")][0] if name.startswith("honest") else FILES[name](SIZE)
    )
    try:
        structure = read_structure(file, PIXELS)
        reserved = structure.image_bytes + structure.scratch_bytes
    except (MalformedMessage, MessageTooLarge):
        reserved = 0
    try:
        # This resets the peak to the current memory.
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pytest.skip("this system does not let a process reset its peak")
    before = peak_bytes()
    decode_or_refuse(file)
    assert peak_bytes() - before < reserved + 3 * len(file) + SLACK


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_what_is_decoded_has_the_size_of_its_header(name: str) -> None:
    file = FILES[name](20_000)
    try:
        structure = read_structure(file, PIXELS)
        image = jpeg_png.decode_file(structure)
    except (MalformedMessage, MessageTooLarge):
        return
    assert image.shape == (structure.height, structure.width, 3)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("JPEG: scans", "expected a JPEG of at most"),
        ("JPEG: arithmetic coding", "process SOF10"),
        ("JPEG: comments first", "too many segments"),
        ("JPEG: no rows", "at least 1x1"),
        ("PNG: empty chunks", "too many chunks"),
        ("PNG: no columns", "at least 1x1"),
        ("PNG: no rows", "at least 1x1"),
        ("PNG: more data than pixels", "not 8 rows of 8 pixels"),
        ("PNG: palettes", "too many chunks"),
    ],
)
def test_an_error_names_what_is_wrong(name: str, message: str) -> None:
    file = FILES[name](SIZE)
    with pytest.raises((MalformedMessage, MessageTooLarge), match=message):
        jpeg_png.decode(file, PIXELS)


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


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA", "I;16"])
@pytest.mark.parametrize(
    "options", [{}, {"optimize": True}, {"dpi": (72, 72)}, {"compress_level": 0}]
)
def test_pngs_keep_their_pixels_without_their_other_chunks(
    mode: str, options: dict[str, object]
) -> None:
    image = rendered()
    picture = (
        Image.fromarray(image[:, :, 0].astype(np.uint16) * 257)
        if mode == "I;16"
        else Image.fromarray(image)
    )
    picture = picture if mode == "I;16" else picture.convert(mode)
    file = io.BytesIO()
    picture.save(file, "PNG", **options)
    want = np.repeat(image[:, :, :1], 3, 2) if mode == "I;16" else np.array(picture.convert("RGB"))
    np.testing.assert_array_equal(jpeg_png.decode(file.getvalue()), want)


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
        {"progressive": True},
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


@pytest.mark.slow
def test_the_files_are_what_their_names_say() -> None:
    """Otherwise the tests could pass because each file is rejected for another reason."""
    decoded = set()
    for name, make in FILES.items():
        with contextlib.suppress(MalformedMessage, MessageTooLarge):
            jpeg_png.decode(make(20_000), PIXELS)
            decoded.add(name)
    assert {
        "JPEG: scans within the limit",
        "JPEG: restart markers",
        "JPEG: fill bytes",
    } - decoded == set()
    assert {
        "PNG: interlaced",
        "PNG: filters of 16 bits",
        "PNG: one column",
        "PNG: one bit",
    } - decoded == set()
    assert hostile_images.jpeg()[:2] == b"\xff\xd8"
