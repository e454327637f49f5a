"""Measures the link to the server once, and selects the image codec that is fastest over it."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vlagents_ray.client.transports.probe import LEAST_BYTES, bytes_probe
from vlagents_ray.errors import MessageTooLarge, TooManyRequests
from vlagents_ray.images.codecs import JPEG, LOSSLESS, RAW, ImageCodec, decode_files, encode_files
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.messages import Budget, Limits

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
_CODINGS = 5  # times that a codec is tried on the images; the fastest one counts, since the machine may be busy
_CODING_S = 0.05  # s after which a codec is not tried again
_JPEG_GAIN = 0.9  # share of the time of the best lossless codec that JPEG must not exceed, since it changes the pixels
_RESIZED = 2  # the factor by which the size of the images must change for a new selection


@dataclass(frozen=True, slots=True)
class LinkSpeed:
    """The speed of a connection: a message of n bytes and a short answer take `round_trip_s + n / bandwidth`."""

    round_trip_s: float
    bandwidth: float  # bytes/s from client to server, including the work of both sides on each byte

    def seconds(self, size: int) -> float:
        """Return the time, s, for a message of `size` bytes and a short answer."""
        return self.round_trip_s + size / self.bandwidth


def measure(
    send: Send, clock: Callable[[], float] = time.perf_counter, within_s: float = float("inf")
) -> LinkSpeed | None:
    """Measure the link over which `send` carries probes.

    Takes 0.15 s at most where a round trip is short, else ten round trips and one probe. Probes grow only while the
    last one was too short to measure, so a slow link carries few bytes.

    Returns:
        The speed; None, after two round trips, if ten of them take longer than `within_s`.
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


def fastest(
    cameras: Sequence[np.ndarray],
    candidates: Sequence[ImageCodec],
    link: LinkSpeed,
    send: Send,
    most_bytes: float = float("inf"),
) -> ImageCodec:
    """Return the candidate with which images are encoded, sent and decoded in the least time.

    The images are encoded and decoded here, and the time of their bytes is computed from the speed of the link: to send
    them with each codec would measure the chance load of the link and of the server. One message of the size of the
    result is sent, as a proxy on the way may refuse it.

    Args:
        cameras: The images, (H, W, 3) uint8 RGB.
        candidates: The codecs; the first one is the result if all are refused.
        link: The measured speed of the link.
        send: Sends a probe and waits for the answer.
        most_bytes: The largest message.
    """
    taken: dict[ImageCodec, float] = {}
    sizes: dict[ImageCodec, int] = {}
    for codec in candidates:
        sizes[codec], coding_s = coding_cost(cameras, codec)
        seconds = link.seconds(sizes[codec]) + coding_s
        taken[codec] = seconds if codec.exact else seconds / _JPEG_GAIN
    for codec in sorted(candidates, key=taken.__getitem__):
        if _passes(sizes[codec], send, most_bytes):
            return codec
    return candidates[0]


def _passes(size: int, send: Send, most_bytes: float) -> bool:
    """Whether a message of that size is accepted on the way, which is tried with one of at most `most_bytes`."""
    if size > most_bytes:
        return False
    try:
        send(bytes_probe(size))
    except MessageTooLarge:
        return False
    return True


def coding_cost(cameras: Sequence[np.ndarray], codec: ImageCodec) -> tuple[int, float]:
    """Return the bytes of encoded images, and the least time, s, to encode and decode them on this machine."""
    size = sum(image.nbytes for image in cameras)
    if codec.name == "raw":  # to copy pixels is a part of the measured bandwidth
        return size, 0.0
    own = Limits(pixels=size, decoded_bytes=size)  # the server's may be higher than the default
    least_s = float("inf")
    end = time.perf_counter() + _CODING_S
    for _ in range(_CODINGS):
        begun, used_s = time.perf_counter(), time.process_time()
        files = encode_files(cameras, codec)
        decode_files(files, Budget(own))
        # CPU time leaves out what other processes take; where several threads encode, it is the longer of the two.
        least_s = min(least_s, time.perf_counter() - begun, time.process_time() - used_s)
        if time.perf_counter() > end:
            break
    return sum(map(len, files)), least_s


class CodecChoice:
    """The codec of one session's cameras: the one that the user asks for, or the fastest over the link.

    "auto" takes the fastest of JPEG, PNG and raw; "exact" the faster of PNG and raw. Within a machine it is raw without
    a measurement, unless a message of so many bytes is refused. To a server so far away that measuring would take much
    of a request's time, it is JPEG, or PNG, without one.
    """

    def __init__(self, requested: CodecName | ImageCodec) -> None:
        self._near = False  # whether the server is known to be on this machine
        self.link: LinkSpeed | None = None
        self.codec: ImageCodec | None = None
        self._candidates: tuple[ImageCodec, ...] = ()  # those that are likely to be short come first
        if isinstance(requested, ImageCodec):
            self.codec = requested
        elif requested == "auto":
            self._candidates = (JPEG, LOSSLESS, RAW)
        elif requested == "exact":
            self._candidates = (LOSSLESS, RAW)
        else:
            self.codec = ImageCodec(requested)
        self._size = 0  # bytes of the images for which the codec was chosen

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
        """Return the codec for an observation; probes are sent only if it has yet to be chosen.

        Args:
            obs: The observation of the request.
            send: Sends a probe and waits for the answer.
            most_bytes: The largest message.
            timeout_s: How long the request may take, probes included.
        """
        if not self._candidates or obs is None:
            return self.codec or RAW
        size = sum(image.nbytes for image in obs.cameras.values())
        if size and (self.codec is None or not self._size / _RESIZED <= size <= self._size * _RESIZED):
            try:
                if self._near and _passes(size, send, most_bytes):
                    self.codec = RAW
                else:
                    self.link = link = self.link or measure(send, within_s=_SHARE * timeout_s)
                    cameras = list(obs.cameras.values())
                    self.codec = self._candidates[0]
                    if link is not None:
                        self.codec = fastest(cameras, self._candidates, link, send, most_bytes)
            except TooManyRequests as error:  # probes count as requests: the key's rate is too low to measure by
                self.codec = RAW if self._near else self._candidates[0]
                time.sleep(min(error.retry_after_s, _RATE_WAIT_S))  # the request that follows counts, too
            self._size = size
        return self.codec or RAW

    def forget(self) -> None:
        """Forget the choice: the next connection is measured again."""
        if self._candidates:
            self.link, self.codec, self._size = None, None, 0
