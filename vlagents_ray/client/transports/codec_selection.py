"""Measures the link to the server once, and selects the image codec by its bandwidth.

Raw pixels cost no work, JPEG and PNG cost a little for each pixel and save bytes, so each pays below a bandwidth that
hardly depends on the images. Measured on one core of a server with camera-like images from 224 x 224 to 1280 x 720:
JPEG takes 3 ns for a byte of pixels, encoded and decoded, and leaves 7 to 10 % of the bytes; PNG takes 18 ns and leaves
about half.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from vlagents_ray.errors import MessageTooLarge, TooManyRequests
from vlagents_ray.images.codecs import JPEG, LOSSLESS, RAW, ImageCodec
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.messages import LEAST_BYTES, bytes_probe

CodecName = Literal["auto", "exact", "raw", "lossless", "jpeg"]
Send = Callable[[bytes], None]  # sends a probe and waits for the answer

_BUDGET_S = 0.15  # s for the measurement of the link, unless ten round trips take more
_ROUND_TRIPS = 10
_LATENCY_PROBES = 5  # probes that measure the round trip; the first one may have to warm up the server
_GROWTH = 4
_SIZES = tuple(16 * 1024 * _GROWTH**n for n in range(4))  # bytes; 1 MiB is a common limit of proxies for one request
_MIN_PROBE_S = 0.005  # s; a shorter probe measures no bandwidth: links let a burst pass before they slow down
_MIN_PROBE_TRIPS = 5  # round trips; nor does a probe that takes less than these
_SHARE = 0.25  # of the time of a request, which measuring may take; where it would take longer, nothing is measured
_RATE_WAIT_S = 1.0  # most s to wait for the rate limit of a key
_REPEATS = 3  # of the largest probe; the best one counts, since TCP's window is still growing in the first
_RAW_FROM = {JPEG: 300e6, LOSSLESS: 25e6}  # bytes/s from which raw pixels arrive sooner than these; see above


@dataclass(frozen=True, slots=True)
class LinkSpeed:
    """The speed of a connection: a message of n bytes and a short answer take `round_trip_s + n / bandwidth`."""

    round_trip_s: float
    bandwidth: float  # bytes/s from client to server, including the work of both sides on each byte


def measure(
    send: Send, clock: Callable[[], float] = time.perf_counter, within_s: float = float("inf")
) -> LinkSpeed | None:
    """Measure the link over which `send` carries probes; None if ten round trips take longer than `within_s`.

    Takes 0.15 s at most where a round trip is short, else ten round trips and one probe. Probes grow only while the
    last one was too short to measure, so a slow link carries few bytes.
    """

    def seconds(size: int) -> float:
        message = bytes_probe(size)
        begun = clock()
        send(message)
        return clock() - begun

    seconds(LEAST_BYTES)
    begun = clock()
    round_trip_s = seconds(LEAST_BYTES)
    if _ROUND_TRIPS * round_trip_s > within_s:
        return None
    round_trip_s = min(round_trip_s, *(seconds(LEAST_BYTES) for _ in range(_LATENCY_PROBES - 2)))
    end = begun + max(_BUDGET_S, _ROUND_TRIPS * round_trip_s)
    sent, taken_s = LEAST_BYTES, round_trip_s
    with contextlib.suppress(MessageTooLarge):  # the server's limit: what was measured by then is used
        for size in _SIZES:
            taken_s, sent = seconds(size), size
            if taken_s > max(_MIN_PROBE_TRIPS * round_trip_s, _MIN_PROBE_S) or clock() + _GROWTH * taken_s > end:
                break
        for _ in range(_REPEATS):
            if clock() + taken_s > end:
                break
            taken_s = min(taken_s, seconds(sent))
    return LinkSpeed(round_trip_s, sent / max(taken_s - round_trip_s, 1e-6))


def _passes(size: int, send: Send, most_bytes: float) -> bool:
    """Whether a message of that size is accepted on the way, which is tried with one of at most `most_bytes`."""
    if size > most_bytes:
        return False
    try:
        send(bytes_probe(size))
    except MessageTooLarge:
        return False
    return True


class CodecChoice:
    """The codec of one session's cameras: the one that the user asks for, or one chosen by the link.

    "auto" takes raw pixels within a machine and over links of at least 300 MB/s, else JPEG; "exact" raw pixels within a
    machine and over links of at least 25 MB/s, else PNG. A link so far away that measuring would take much of a
    request's time counts as slow. Raw pixels are not taken where a message of so many bytes is refused.
    """

    def __init__(self, requested: CodecName | ImageCodec) -> None:
        self._near = False  # whether the server is known to be on this machine
        self.link: LinkSpeed | None = None
        self.codec: ImageCodec | None = None
        self._compressed: ImageCodec | None = None  # taken where raw pixels are not; None if the codec is given
        if isinstance(requested, ImageCodec):
            self.codec = requested
        elif requested in ("auto", "exact"):
            self._compressed = JPEG if requested == "auto" else LOSSLESS
        else:
            self.codec = ImageCodec(requested)
        self._size = 0  # bytes of the largest images for which raw pixels were chosen

    def connected(self, *, near: bool) -> None:
        """Note a new connection, and whether the server is known to be on this machine.

        A choice of JPEG or PNG stays, so that a robot acts again at once. Raw pixels are for fast links, on which
        another measurement takes no time.
        """
        if near != self._near or self.codec == RAW:
            self.forget()
        self._near = near

    def codec_for(
        self, obs: Obs | None, send: Send, most_bytes: float = float("inf"), timeout_s: float = float("inf")
    ) -> ImageCodec:
        """Return the codec for an observation; probes are sent, by `send`, only if it has yet to be chosen.

        `most_bytes` is the largest message, and `timeout_s` how long the request may take, probes included.
        """
        if obs is None or self._compressed is None or self.codec is self._compressed:
            return self.codec or RAW
        size = sum(image.nbytes for image in obs.cameras.values())
        if size > self._size:  # 0 while nothing is chosen
            try:
                if not self._near and self.link is None:
                    self.link = measure(send, within_s=_SHARE * timeout_s)
                fast = self._near or (self.link is not None and self.link.bandwidth >= _RAW_FROM[self._compressed])
                self.codec = RAW if fast and _passes(size, send, most_bytes) else self._compressed
            except TooManyRequests as error:  # probes count as requests: the key's rate is too low to measure by
                self.codec = RAW if self._near else self._compressed
                time.sleep(min(error.retry_after_s, _RATE_WAIT_S))  # the request that follows counts, too
            self._size = size
        return self.codec or RAW

    def forget(self) -> None:
        """Forget the choice: the next connection is measured again."""
        if self._compressed is not None:
            self.link, self.codec, self._size = None, None, 0
