"""Messages of several robots are decoded in parallel while batches are slow."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from eval_fakes import wait_for

from vlagents_ray.client.transports.websocket import Stream
from vlagents_ray.images import jpeg_png, thread_map
from vlagents_ray.images.codecs import JPEG
from vlagents_ray.images.image_file import ImageFile
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.frames import Decoded, decode_replies, decode_requests, encode_requests
from vlagents_ray.protocol.messages import Budget, MessageLimits, Request
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints import request_stream
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.engine.admission import (
    SIDE_BY_SIDE_CORES,
    SIDE_BY_SIDE_S,
    Admission,
)
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.queue.batch_window import SLOW_S

ROBOTS, CORES = 8, SIDE_BY_SIDE_CORES
# Time to decode a message, simulated by a sleep that is long compared with all other work.
MESSAGE_S = 0.2
READERS = ("policy", "policy-reader")  # names of the threads that read connections
WAIT_S = 30


class Waits(Agent):
    """A policy whose batches sleep, as if they waited for a GPU."""

    def __init__(self, batch_s: float) -> None:
        self._batch_s = batch_s

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {}

    def act_batch(self, obs: Any, sessions: Any) -> list[Act | Exception]:
        time.sleep(self._batch_s)
        return [Act(np.zeros(1, np.float32)) for _ in obs]


def observation(side: int, cameras: int = 1) -> Obs:
    """Return an observation whose images are sent as JPEG."""
    return Obs({f"camera_{i}": np.zeros((side, side, 3), np.uint8) for i in range(cameras)})


LONG = observation(400)  # its estimated decoding time is 0.8 ms
SHORT = observation(64)


@contextlib.contextmanager
def robots(number: int, batch_s: float = 2 * SLOW_S) -> Iterator[tuple[Engine, list[Stream]]]:
    """Yield an engine, and connections of robots that have acted a few times."""
    engine = Engine(Waits(batch_s))
    own = OwnPortServer(engine, MessageLimits(), "127.0.0.1", None, NoKey.OPEN)
    own.open()
    engine.start()
    streams = []
    try:
        for _ in range(number):
            address = own.address
            streams.append(Stream(urlsplit("http://127.0.0.1"), address.port, address.path, 10))
        ask(streams, "reset", SHORT)
        for _ in range(20):
            ask(streams, "act", SHORT)
        yield engine, streams
    finally:
        for stream in streams:
            stream.close()
        engine.close()
        own.close()
    assert engine.admission.held == 0


def ask(streams: list[Stream], op: Any, obs: Obs) -> None:
    """Send a request from each robot, then wait for all replies."""
    for stream in streams:
        stream.send(encode_requests([Request(op, obs)], JPEG), WAIT_S)
    for stream in streams:
        [reply] = decode_replies(stream.recv(WAIT_S))
        assert reply.error is None


def is_fast(engine: Engine, streams: list[Stream]) -> bool:
    """Let the robots act once more, and return whether batches are now fast."""
    ask(streams, "act", SHORT)
    return not engine.queue.window.overlaps


@pytest.fixture(autouse=True)
def cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate four cores, whatever this machine has."""
    monkeypatch.setattr(thread_map, "allowed", lambda: CORES)


@pytest.fixture
def decoding_threads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return a growing list of the names of threads that decode images."""
    names: list[str] = []
    original = jpeg_png.decode_file

    def decode(file: ImageFile) -> np.ndarray:
        names.append(threading.current_thread().name)
        return original(file)

    monkeypatch.setattr(jpeg_png, "decode_file", decode)
    return names


def test_messages_of_several_robots_are_decoded_at_the_same_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with robots(CORES) as (_, streams):
        together = threading.Barrier(CORES)
        original = jpeg_png.decode_file

        def decode(file: ImageFile) -> np.ndarray:
            together.wait(WAIT_S)
            return original(file)

        monkeypatch.setattr(jpeg_png, "decode_file", decode)
        ask(streams, "act", LONG)


@pytest.mark.parametrize(
    ("number", "batch_s", "obs"),
    [(1, 2 * SLOW_S, LONG), (3, 0.0, LONG), (3, 2 * SLOW_S, SHORT)],
    ids=["a lone robot", "a fast policy", "small images"],
)
def test_other_messages_are_decoded_by_the_thread_that_reads_them(
    decoding_threads: list[str], number: int, batch_s: float, obs: Obs
) -> None:
    with robots(number, batch_s) as (engine, streams):
        if not batch_s:  # on a busy machine, even these batches may have been slow at first
            wait_for(lambda: is_fast(engine, streams))
        decoding_threads.clear()
        ask(streams, "act", obs)
    assert len(decoding_threads) == number
    assert {*decoding_threads} <= {*READERS}


def test_two_cores_decode_the_images_of_one_message_after_another(
    decoding_threads: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(thread_map, "allowed", lambda: 2)
    with robots(3) as (_, streams):
        decoding_threads.clear()
        ask(streams, "act", LONG)
    assert {*decoding_threads} <= {*READERS}


def test_the_acts_of_a_robot_keep_their_order_beside_those_of_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with robots(2) as (_, (first, second)):
        go_on, decoders = threading.Event(), []
        original = jpeg_png.decode_file

        def decode(file: ImageFile) -> np.ndarray:
            image = original(file)
            if image.shape[0] == LONG.cameras["camera_0"].shape[0]:
                decoders.append(threading.current_thread().name)
                assert go_on.wait(WAIT_S)
            return image

        monkeypatch.setattr(jpeg_png, "decode_file", decode)
        for name, obs in (("long", LONG), ("short", SHORT)):
            request = Request("act", obs, request_id=name)
            first.send(encode_requests([request], JPEG), WAIT_S)
        wait_for(lambda: decoders != [])
        ask([second], "act", SHORT)
        go_on.set()
        replies = [decode_replies(first.recv(WAIT_S))[0] for _ in range(2)]
    assert [reply.request_id for reply in replies] == ["long", "short"]
    assert all(name.startswith("decode-robots") for name in decoders)


def test_an_image_that_cannot_be_decoded_is_its_robots_error_alone() -> None:
    with robots(2) as (_, (first, second)):
        data = encode_requests([Request("act", LONG)], JPEG)
        broken = data[:-400] + bytes(400)
        first.send(broken, WAIT_S)
        ask([second], "act", LONG)
        decode_replies(first.recv(WAIT_S))
        ask([first], "act", LONG)


@pytest.mark.slow
def test_eight_messages_are_ready_in_a_third_of_the_time_of_one_thread(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def decode(data: bytes, budget: Budget) -> Decoded:
        with budget.decoding(2 * SIDE_BY_SIDE_S, 0):
            time.sleep(MESSAGE_S)
        return decode_requests(data, budget)

    with robots(ROBOTS) as (_, streams):
        monkeypatch.setattr(request_stream, "decode_requests", decode)
        side_by_side_s = _duration_s(lambda: ask(streams, "act", SHORT))
        monkeypatch.setattr(Admission, "inline_s", lambda *_: 1.0)
        one_by_one_s = _duration_s(lambda: ask(streams, "act", SHORT))
    assert one_by_one_s >= ROBOTS * MESSAGE_S
    assert side_by_side_s <= one_by_one_s / 3


def _duration_s(call: Callable[[], None]) -> float:
    begun = time.perf_counter()
    call()
    return time.perf_counter() - begun
