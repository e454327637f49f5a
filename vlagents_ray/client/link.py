"""The link to the server, measured once, and the way of writing cameras that is the fastest over it."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vlagents_ray.errors import MessageTooLarge
from vlagents_ray.interface import Obs
from vlagents_ray.wire.codecs import JPEG, LOSSLESS, RAW, ImageCodec, decode_files, encode_files
from vlagents_ray.wire.probe import LEAST_BYTES

Wish = Literal["auto", "exact", "raw", "lossless", "jpeg"]

_BUDGET_S = 0.25  # of probing, unless the round trip alone is so long that ten take more
_ROUND_TRIPS = 10
_TINY = 5  # probes that measure the round trip, the first of which may have to warm up the server
_GROWTH = 4
_SIZES = tuple(16 * 1024 * _GROWTH**n for n in range(4))  # bytes; 1 MiB is a common limit of proxies for one request
_ABOVE = 4  # round trips that a probe's bytes must take before they say something of the bandwidth
_REPEATS = 4  # of the largest probe, of which the best counts: the first find TCP still opening its window
_TIMES_CODED = 3  # each way of coding, of which the best counts
_HOPELESS = 2  # a way this many times slower than the best is not timed again
_RESIZED = 2  # times as large or small: when the images' size calls for another choice


@dataclass(frozen=True, slots=True)
class Link:
    """What a connection takes for a message of n bytes and a short answer: `round_trip_s + n / bandwidth`."""

    round_trip_s: float
    bandwidth: float  # bytes/s from here to the server, whatever both sides do to each byte included

    def seconds(self, size: int) -> float:
        """For a message of `size` bytes and a short answer."""
        return self.round_trip_s + size / self.bandwidth


def measure(probe: Callable[[int], None], clock: Callable[[], float] = time.perf_counter) -> Link:
    """The link over which `probe(n)` sends n bytes and waits for a short answer.

    Takes a quarter of a second at most where a round trip is short, or ten round trips and one probe.
    A probe grows only while the last one was too short to tell, so a slow link carries few bytes.
    """

    def seconds(size: int) -> float:
        begun = clock()
        probe(size)
        return clock() - begun

    seconds(LEAST_BYTES)
    begun = clock()
    round_trip_s = min(seconds(LEAST_BYTES) for _ in range(_TINY - 1))
    end = begun + max(_BUDGET_S, _ROUND_TRIPS * round_trip_s)
    sent, taken_s = LEAST_BYTES, round_trip_s
    with contextlib.suppress(MessageTooLarge):  # a server that takes no more: what is known by then has to do
        for size in _SIZES:
            taken_s, sent = seconds(size), size
            if taken_s > (1 + _ABOVE) * round_trip_s or clock() + _GROWTH * taken_s > end:
                break
        for _ in range(_REPEATS):
            if clock() + taken_s > end:
                break
            taken_s = min(taken_s, seconds(sent))
    return Link(round_trip_s, sent / max(taken_s - round_trip_s, 1e-6))


def fastest(
    cameras: Sequence[np.ndarray], link: Link, candidates: Iterable[ImageCodec], clock: Callable[[], float]
) -> ImageCodec:
    """The candidate that takes the least time to encode, send and decode (estimated here) these images."""
    raw_bytes = sum(image.nbytes for image in cameras)
    best, best_s = RAW, float("inf")
    for codec in candidates:
        total_s = link.seconds(raw_bytes) if codec.name == "raw" else float("inf")
        for _ in range(_TIMES_CODED if codec.name != "raw" else 0):
            begun = clock()
            files = encode_files(cameras, codec)
            decode_files(files, raw_bytes)
            total_s = min(total_s, clock() - begun + link.seconds(sum(map(len, files))))
            if total_s > _HOPELESS * best_s:
                break
        if total_s < best_s:
            best, best_s = codec, total_s
    return best


class CodecChoice:
    """How one session's cameras are written: as the user wishes, or as the link has it.

    "auto" takes the fastest of raw, JPEG and PNG; "exact" the faster of raw and PNG.
    """

    def __init__(self, wish: Wish | ImageCodec) -> None:
        self.link: Link | None = None
        self.codec: ImageCodec | None = None
        self._candidates: tuple[ImageCodec, ...] = ()
        if isinstance(wish, ImageCodec):
            self.codec = wish
        elif wish == "auto":
            self._candidates = (RAW, JPEG, LOSSLESS)
        elif wish == "exact":
            self._candidates = (RAW, LOSSLESS)
        else:
            self.codec = ImageCodec(wish)
        self._size = 0  # bytes of the images for which it was chosen

    def of(self, obs: Obs | None, probe: Callable[[int], None]) -> ImageCodec:
        """The codec for an observation; `probe` measures the link, once and only if it decides."""
        if not self._candidates:
            return self.codec or RAW
        cameras = list(obs.cameras.values()) if obs is not None else []
        size = sum(image.nbytes for image in cameras)
        if size and (self.codec is None or not self._size / _RESIZED <= size <= self._size * _RESIZED):
            self.link = self.link or measure(probe)
            self.codec = fastest(cameras, self.link, self._candidates, time.perf_counter)
            self._size = size
        return self.codec or RAW

    def forget(self) -> None:
        """The connection is gone: the next one is measured anew."""
        if self._candidates:
            self.link, self.codec, self._size = None, None, 0
