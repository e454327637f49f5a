"""The thread on which the images of a message are decoded, and the charge of the time that it takes."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
from eval_fakes import wait_for
from frozen_rates import freeze, requests_charged
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from in_memory_keys import ChangingKeys
from PIL import Image

from vlagents_ray.errors import PolicyUnavailable, TooManyRequests, UnsupportedImage
from vlagents_ray.images import codecs, jpeg_png
from vlagents_ray.images.image_file import ImageFile
from vlagents_ray.protocol import frame_layout
from vlagents_ray.protocol.frames import Decoded, decode_requests
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Budget
from vlagents_ray.serve.access.api_keys import Identity, NoKey
from vlagents_ray.serve.access.charges import REQUEST_DECODING_S, Account
from vlagents_ray.serve.engine import admission as admission_module
from vlagents_ray.serve.engine.admission import (
    INLINE_BYTES,
    Admission,
    MessageAdmission,
    NeedsDecodingThread,
)


def image(side: int, shade: int = 0) -> np.ndarray:
    return np.full((side, side, 3), shade, np.uint8)


FILES = {
    "small": jpeg_png.encode_jpeg(image(32, 9)),
    "camera": jpeg_png.encode_jpeg(image(224, 40)),
    "quarter": jpeg_png.encode_jpeg(image(512, 80)),
    "large": jpeg_png.encode_jpeg(image(600, 120)),
    "png": jpeg_png.encode_png(image(16, 160)),
}
# Where a message with one image of each kind is decoded.
IN_PLACE = ("small", "camera", "quarter")


def frame(*names: str) -> bytes:
    """Return a reset whose history contains the images, each in its own observation."""
    seen = [{"cameras": {"front": {"$": ["img", index]}}} for index in range(len(names))]
    header = {"op": "reset", "obs": seen[0], "history": seen[1:]}
    return b"".join(frame_layout.pack(header, [FILES[name] for name in names]))


def message(whole: Admission, caller: Identity = NoKey.OPEN) -> MessageAdmission:
    return MessageAdmission(whole, DEFAULT_LIMITS, Account(caller).charge())


def decode_anywhere(admission: MessageAdmission, data: bytes) -> Decoded:
    read = partial(decode_requests, data)
    try:
        return admission.decode_here(read)
    except NeedsDecodingThread:
        return admission.decode_on_thread(read).result(30)


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, str]]:
    """Return a growing list of the heights of decoded images, and of the threads."""
    images: list[tuple[int, str]] = []
    original = jpeg_png.decode_file

    def decode(file: ImageFile) -> np.ndarray:
        images.append((file.height, threading.current_thread().name.rpartition("_")[0]))
        return original(file)

    monkeypatch.setattr(jpeg_png, "decode_file", decode)
    return images


@pytest.fixture
def whole() -> Iterator[Admission]:
    admission = Admission(2**30)
    yield admission
    admission.close()


@pytest.mark.parametrize("name", FILES)
def test_only_a_jpeg_of_a_quarter_megapixel_is_decoded_by_the_thread_that_reads(
    name: str, decoded: list[tuple[int, str]], whole: Admission
) -> None:
    here = threading.current_thread().name.rpartition("_")[0]
    decode_anywhere(message(whole), frame(name))
    [(_, thread)] = decoded
    assert (thread == here) == (name in IN_PLACE)
    assert thread in (here, "decode-robots")


def test_the_images_of_a_message_in_place_are_a_quarter_megapixel_together(
    decoded: list[tuple[int, str]], whole: Admission
) -> None:
    number = INLINE_BYTES // (224 * 224 * 3)
    here = threading.current_thread().name.rpartition("_")[0]
    decode_anywhere(message(whole), frame(*["camera"] * number))
    assert {thread for _, thread in decoded} == {here}
    decoded.clear()
    decode_anywhere(message(whole), frame(*["camera"] * (number + 1)))
    assert [thread for _, thread in decoded] == [here] * number + ["decode-robots"]


def test_large_files_are_checked_and_decoded_elsewhere(
    decoded: list[tuple[int, str]], whole: Admission, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Finding the end of the scan of a JPEG of 10 MB takes 4 ms."""
    checked: list[str] = []
    original = codecs.read_structure

    def check(file: bytes, max_pixels: int) -> ImageFile:
        checked.append(threading.current_thread().name.rpartition("_")[0])
        return original(file, max_pixels)

    monkeypatch.setattr(codecs, "read_structure", check)
    noise = np.random.default_rng(0).integers(0, 256, (700, 700, 3), np.uint8)
    monkeypatch.setitem(FILES, "noise", jpeg_png.encode_jpeg(noise, 100))
    assert len(FILES["noise"]) > INLINE_BYTES
    decode_anywhere(message(whole), frame("noise"))
    assert checked == ["decode-robots"]


@pytest.mark.slow
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(
    names=st.lists(st.sampled_from(sorted(FILES)), min_size=1, max_size=12),
    long_s=st.sampled_from([1e-9, 1e-3, 3e-3, 1.0]),
)
def test_each_file_is_decoded_once_wherever_the_message_is_read_again(
    decoded: list[tuple[int, str]],
    whole: Admission,
    monkeypatch: pytest.MonkeyPatch,
    names: list[str],
    long_s: float,
) -> None:
    """A message moves to a thread for robots, and from there to one for others."""
    monkeypatch.setattr(admission_module, "LONG_S", long_s)
    decoded.clear()
    data = frame(*names)
    expected = decode_requests(data, Budget(DEFAULT_LIMITS)).requests
    assert len(decoded) == len(names)
    decoded.clear()

    admission = message(whole)
    result = decode_anywhere(admission, data)
    assert len(decoded) == len(names)
    assert not result.refused
    [[request], [reference]] = result.requests, expected
    for ours, theirs in zip(request.history, reference.history, strict=True):
        np.testing.assert_array_equal(ours.cameras["front"], theirs.cameras["front"])
    assert whole.held == sum(
        file.cameras["front"].nbytes for file in [request.obs, *request.history]
    )
    admission.release()
    assert whole.held == 0


def test_a_long_message_of_a_robot_leaves_the_threads_for_robots(
    decoded: list[tuple[int, str]], whole: Admission, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(admission_module, "LONG_S", 4e-3)
    decode_anywhere(message(whole), frame(*["large"] * 6))
    threads = [thread for _, thread in decoded]
    assert threads[0] == "decode-robots"
    assert threads[-1] == "decode-others"


def test_memory_that_changes_between_two_readings_gives_the_later_image(whole: Admission) -> None:
    """Over shared memory, the client may write while another thread reads the message again."""
    admission = message(whole)
    read = [frame("small", "large"), frame("camera", "large")]

    def changing(budget: Budget) -> Decoded:
        return decode_requests(read.pop(0), budget)

    with pytest.raises(NeedsDecodingThread):
        admission.decode_here(changing)
    [request] = admission.decode_on_thread(changing).result(30).requests
    assert request.obs.cameras["front"].shape == (224, 224, 3)


@pytest.mark.parametrize("priority", ["robot", "simulation"])
def test_a_message_that_waits_at_the_end_of_a_replica_gets_an_error(
    whole: Admission, priority: str
) -> None:
    go_on = threading.Event()
    for robot in (True, False):
        for _ in range(16):
            whole.submit(lambda: go_on.wait(30), robot)
    admission = message(whole)
    admission.begin("reset", priority)
    waiting = admission.decode_on_thread(partial(decode_requests, frame("large")))
    whole.close()
    go_on.set()
    with pytest.raises(PolicyUnavailable, match="stopping"):
        waiting.result(30)


@pytest.mark.parametrize("is_long", [False, True])
def test_a_client_that_leaves_cancels_its_message_wherever_it_waits(
    whole: Admission,
    decoded: list[tuple[int, str]],
    monkeypatch: pytest.MonkeyPatch,
    is_long: bool,
) -> None:
    monkeypatch.setattr(admission_module, "LONG_S", 0.0 if is_long else 1.0)
    go_on = threading.Event()
    blocked = [whole.submit(lambda: go_on.wait(30), robot=not is_long) for _ in range(16)]
    admission = message(whole)
    waiting = admission.decode_on_thread(partial(decode_requests, frame("large")))
    if is_long:  # the thread for robots has moved it to the others
        wait_for(lambda: not admission._is_short)
    assert waiting.cancel()
    go_on.set()
    for job in blocked:
        job.result(30)
    whole.submit(lambda: None, not is_long).result(30)
    assert not decoded
    admission.release()
    assert whole.held == 0


@pytest.mark.parametrize("seconds", [0.0, 0.5, 1.0, 1.5, 30.0])
def test_decoding_beyond_what_a_request_includes_is_charged(
    monkeypatch: pytest.MonkeyPatch, whole: Admission, seconds: float
) -> None:
    """The key pays for the CPU time that was used, also if the image is broken in the end."""
    freeze(monkeypatch)
    known = ChangingKeys()
    caller = known.keys.check(known.add("arm", rate=100), "app")
    admission = message(whole, caller)
    admission.begin("reset")
    for _ in range(10):
        admission.spend(REQUEST_DECODING_S * seconds / 10)
    assert requests_charged(known.keys, "arm") == pytest.approx(max(1.0, seconds))
    admission.begin("act")  # a request for which this time has paid is not charged again
    expected = seconds if seconds >= 2.0 else max(1.0, seconds) + 1.0
    assert requests_charged(known.keys, "arm") == pytest.approx(expected)


def test_a_key_in_debt_waits_for_as_long_as_its_decoding_was_worth(whole: Admission) -> None:
    known = ChangingKeys()
    caller = known.keys.check(known.add("arm", rate=10), "app")
    admission = message(whole, caller)
    admission.spend(100 * REQUEST_DECODING_S)
    with pytest.raises(TooManyRequests) as refused:
        caller.take_request()
    assert 8.0 < refused.value.retry_after_s < 10.0


def test_the_cpu_time_of_real_images_is_charged(
    monkeypatch: pytest.MonkeyPatch, whole: Admission
) -> None:
    spent: list[float] = []
    monkeypatch.setattr(MessageAdmission, "spend", lambda _self, seconds: spent.append(seconds))
    begun = time.process_time()
    decode_anywhere(message(whole), frame(*["large"] * 4))
    assert 0 < sum(spent) <= time.process_time() - begun
    broken = bytearray(frame("camera"))
    broken[-600:-2] = bytes(598)
    spent.clear()
    assert decode_anywhere(message(whole), bytes(broken)).refused
    assert len(spent) == 2  # the check of the structure, and the decoding that failed


@pytest.mark.parametrize(
    ("kind", "options"),
    [("JPEG", {"progressive": True}), ("PNG", {"bits": 1})],
)
def test_a_refused_form_is_the_clients_error_with_the_name_of_the_camera(
    whole: Admission, kind: str, options: dict[str, Any]
) -> None:
    file = io.BytesIO()
    picture = Image.fromarray(image(64)).convert("P" if kind == "PNG" else "RGB")
    picture.save(file, kind, **options)
    seen = {"cameras": {"front": {"$": ["img", 0]}}}
    data = b"".join(frame_layout.pack({"op": "reset", "obs": seen}, [file.getvalue()]))
    [refusal] = decode_anywhere(message(whole), data).refused.values()
    assert isinstance(refusal.error, UnsupportedImage)
    assert "camera 'front': expected" in str(refusal.error)
