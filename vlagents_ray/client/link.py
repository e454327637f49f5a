"""The link to the server, measured once, and the way of writing cameras that is the fastest over it."""

from __future__ import annotations

import contextlib
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from vlagents_ray.errors import MessageTooLarge
from vlagents_ray.interface import Obs
from vlagents_ray.wire.codecs import JPEG, LOSSLESS, RAW, ImageCodec
from vlagents_ray.wire.frames import request_parts
from vlagents_ray.wire.messages import Request
from vlagents_ray.wire.probe import LEAST_BYTES, bytes_probe, frame_probe

Wish = Literal["auto", "exact", "raw", "lossless", "jpeg"]
Send = Callable[[bytes], None]  # sends a probe and waits for its answer

_BUDGET_S = 0.15  # of either measurement, unless the round trip alone is so long that ten take more
_ROUND_TRIPS = 10
_TINY = 5  # probes that measure the round trip, the first of which may have to warm up the server
_GROWTH = 4
_SIZES = tuple(16 * 1024 * _GROWTH**n for n in range(4))  # bytes; 1 MiB is a common limit of proxies for one request
_TELLING_S = 0.005  # a probe that takes less says too little: links let a burst pass before they slow down
_ABOVE = 5  # nor does one that takes less than so many round trips
_REPEATS = 3  # of the largest probe, of which the best counts: the first find TCP still opening its window
_ROUNDS = 9  # in which each codec has its turn; the first only warms up
_HOPELESS = 2  # a codec this many times slower than the best has no further turn
_WORTH = 0.9  # of the time without loss, at most: what JPEG must take, for it changes the pixels
_RESIZED = 2  # times as large or small: when the images' size calls for another choice


@dataclass(frozen=True, slots=True)
class Link:
    """What a connection takes for a message of n bytes and a short answer: `round_trip_s + n / bandwidth`."""

    round_trip_s: float
    bandwidth: float  # bytes/s from here to the server, whatever both sides do to each byte included

    def seconds(self, size: int) -> float:
        """For a message of `size` bytes and a short answer."""
        return self.round_trip_s + size / self.bandwidth


def measure(send: Send, clock: Callable[[], float] = time.perf_counter) -> Link:
    """The link over which `send` carries probes.

    Takes 0.15 s at most where a round trip is short, or ten round trips and one probe. A probe grows
    only while the last one was too short to tell, so a slow link carries few bytes.
    """

    def seconds(size: int) -> float:
        message = bytes_probe(size)
        begun = clock()
        send(message)
        return clock() - begun

    seconds(LEAST_BYTES)
    begun = clock()
    round_trip_s = min(seconds(LEAST_BYTES) for _ in range(_TINY - 1))
    end = begun + max(_BUDGET_S, _ROUND_TRIPS * round_trip_s)
    sent, taken_s = LEAST_BYTES, round_trip_s
    with contextlib.suppress(MessageTooLarge):  # a server that takes no more: what is known by then has to do
        for size in _SIZES:
            taken_s, sent = seconds(size), size
            if taken_s > max(_ABOVE * round_trip_s, _TELLING_S) or clock() + _GROWTH * taken_s > end:
                break
        for _ in range(_REPEATS):
            if clock() + taken_s > end:
                break
            taken_s = min(taken_s, seconds(sent))
    return Link(round_trip_s, sent / max(taken_s - round_trip_s, 1e-6))


def fastest(
    obs: Obs,
    candidates: Sequence[ImageCodec],
    link: Link,
    send: Send,
    clock: Callable[[], float] = time.perf_counter,
    most_bytes: float = float("inf"),
) -> ImageCodec:
    """The candidate by which `obs` is encoded, sent and decoded in the least time.

    They take turns with frames of this very observation, which the server decodes and answers at
    once. One whose bytes alone would take the link far longer than the best is not sent; no message
    over `most_bytes` is. Takes 0.15 s, or ten round trips, or as long as each candidate takes once.
    """
    taken: dict[ImageCodec, list[float]] = {codec: [] for codec in candidates}
    least_s = float("inf")
    end = clock() + max(_BUDGET_S, _ROUND_TRIPS * link.round_trip_s)
    request = Request("act", obs)
    for turn in range(_ROUNDS):
        for codec in [codec for codec, seconds in taken.items() if len(seconds) == turn]:
            begun = clock()
            if turn and begun + taken[codec][-1] > end:
                continue
            message = frame_probe(request_parts([request], codec))
            if len(message) > most_bytes or link.seconds(len(message)) > _HOPELESS * least_s:
                continue
            with contextlib.suppress(MessageTooLarge):
                send(message)
                taken[codec].append(clock() - begun)
        least_s = min((min(seconds) for seconds in taken.values() if seconds), default=least_s)
        taken = {codec: seconds for codec, seconds in taken.items() if seconds}
        if turn:  # the first one warms up: TCP's window, the server's memory
            taken = {codec: seconds for codec, seconds in taken.items() if min(seconds) <= _HOPELESS * least_s}
    typical = {codec: statistics.median(seconds[1:] or seconds) for codec, seconds in taken.items()}
    weighed = {codec: seconds if codec.exact else seconds / _WORTH for codec, seconds in typical.items()}
    return min(weighed, key=lambda codec: weighed[codec], default=candidates[0])


class CodecChoice:
    """How one session's cameras are written: as the user wishes, or as the link has it.

    "auto" takes the fastest of JPEG, PNG and raw; "exact" the faster of PNG and raw.
    """

    def __init__(self, wish: Wish | ImageCodec) -> None:
        self.link: Link | None = None
        self.codec: ImageCodec | None = None
        self._candidates: tuple[ImageCodec, ...] = ()  # those that promise to be short come first
        if isinstance(wish, ImageCodec):
            self.codec = wish
        elif wish == "auto":
            self._candidates = (JPEG, LOSSLESS, RAW)
        elif wish == "exact":
            self._candidates = (LOSSLESS, RAW)
        else:
            self.codec = ImageCodec(wish)
        self._size = 0  # bytes of the images for which it was chosen

    def of(self, obs: Obs | None, send: Send, most_bytes: float = float("inf")) -> ImageCodec:
        """The codec for an observation; probes are sent only if it has yet to be chosen."""
        if not self._candidates or obs is None:
            return self.codec or RAW
        size = sum(image.nbytes for image in obs.cameras.values())
        if size and (self.codec is None or not self._size / _RESIZED <= size <= self._size * _RESIZED):
            self.link = self.link or measure(send)
            cameras = Obs(obs.cameras)
            self.codec = fastest(cameras, self._candidates, self.link, send, most_bytes=most_bytes)
            self._size = size
        return self.codec or RAW

    def forget(self) -> None:
        """The connection is gone: the next one is measured anew."""
        if self._candidates:
            self.link, self.codec, self._size = None, None, 0
