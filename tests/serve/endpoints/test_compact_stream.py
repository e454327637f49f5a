"""Acts in compact form on WebSockets at a replica's own port."""

from __future__ import annotations

import random
from collections.abc import Iterator
from urllib.parse import urlsplit

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed

from vlagents_ray.client.transports.websocket import Stream
from vlagents_ray.errors import MessageTooLarge, VLAgentsError
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.compact import (
    STREAM_TAG,
    CompactReader,
    CompactWriter,
    is_compact,
    read_answers,
)
from vlagents_ray.protocol.frames import decode_replies, encode_requests
from vlagents_ray.protocol.messages import Budget, MessageLimits, Reply, Request
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings

LIMITS = MessageLimits(pixels=64 * 64, decoded_bytes=100_000)


class Sums(Agent):
    """A policy whose action shows everything that it sees."""

    def act(self, obs: Obs) -> Act:
        pixels = [float(image.astype(np.int64).sum()) for image in obs.cameras.values()]
        numbers = [float(values.sum()) for values in obs.state.values()]
        return Act(np.array([*pixels, *numbers, obs.gripper or -1.0], np.float32))


@pytest.fixture
def endpoint() -> Iterator[OwnPortServer]:
    engine = Engine(Sums(), EngineSettings(session_limit=300))
    endpoint = OwnPortServer(engine, LIMITS, "127.0.0.1", None, NoKey.OPEN)
    endpoint.open()
    engine.start()
    yield endpoint
    engine.close()
    endpoint.close()


def stream(endpoint: OwnPortServer) -> Stream:
    return Stream(urlsplit("http://127.0.0.1"), endpoint.address.port, endpoint.address.path, 5)


def observation(rng: np.random.Generator) -> Obs:
    side = int(rng.integers(1, 40))
    return Obs(
        {name: rng.integers(0, 255, (side, side, 3), np.uint8) for name in ("front", "wrist")},
        float(rng.random()),
        {"joints": rng.random(7).astype(np.float32)},
    )


def requests_of(rng: np.random.Generator, number: int) -> list[Request]:
    requests = []
    for index in range(int(rng.integers(1, 4))):
        name = f"{number}-{index}"
        requests.append(Request("act", observation(rng), session=f"s{index}", request_id=name))
    return requests


def ask(client: Stream, requests: list[Request], writer: CompactWriter | None) -> list[Reply]:
    if writer is None:
        client.send(encode_requests(requests), 5)
    else:
        written = writer.write(requests)
        assert written is not None
        client.send_pieces(written.stream_parts(), 5)
    return answered(client)


def answered(client: Stream) -> list[Reply]:
    answer = client.recv(5)
    if is_compact(answer):
        return read_answers(memoryview(answer)[len(STREAM_TAG) :])
    return decode_replies(answer)


def test_both_forms_have_the_same_answers(endpoint: OwnPortServer) -> None:
    rng = np.random.default_rng(1)
    client, writer = stream(endpoint), CompactWriter()
    for number in range(60):
        requests = requests_of(rng, number)
        if number == 0:
            resets = []
            for index in range(3):
                resets.append(Request("reset", requests[0].obs, session=f"s{index}"))
            assert all(reply.error is None for reply in ask(client, resets, None))
        for reply, other in zip(
            ask(client, requests, writer), ask(client, requests, None), strict=True
        ):
            assert reply.error is None
            assert other.error is None
            assert reply.act is not None
            assert other.act is not None
            assert reply.act.action.tobytes() == other.act.action.tobytes()
            assert reply.request_id == other.request_id
    client.close()


def test_a_rejected_message_does_not_disturb_the_next(endpoint: OwnPortServer) -> None:
    rng = np.random.default_rng(2)
    client = stream(endpoint)
    assert ask(client, [Request("reset", observation(rng))], None)[0].error is None
    for _ in range(3):
        large = Request("act", Obs({"front": np.zeros((65, 65, 3), np.uint8)}), request_id="large")
        [reply] = ask(client, [large], CompactWriter())
        assert isinstance(reply.error, MessageTooLarge)
        act = Request("act", observation(rng), request_id="next")
        assert ask(client, [act], CompactWriter())[0].error is None
    client.close()


def test_a_request_that_is_too_large_is_rejected_alone(endpoint: OwnPortServer) -> None:
    client, writer = stream(endpoint), CompactWriter()
    image = np.zeros((64, 64, 3), np.uint8)
    cameras = {f"camera{number}": image for number in range(9)}
    small = Request("reset", Obs({"front": image}))
    assert ask(client, [small], None)[0].error is None
    requests = [
        Request("act", Obs(cameras), request_id="large"),
        Request("act", Obs({"front": image}), request_id="small"),
    ]
    large, reply = ask(client, requests, writer)
    assert isinstance(large.error, MessageTooLarge)
    assert reply.error is None
    client.close()


def test_every_broken_message_is_answered_or_ends_its_connection(endpoint: OwnPortServer) -> None:
    rng, choice = np.random.default_rng(3), random.Random(3)
    other = stream(endpoint)
    assert ask(other, [Request("reset", observation(rng), session="other")], None)[0].error is None
    refused = 0
    for number in range(250):
        written = CompactWriter().write([Request("act", observation(rng), request_id=f"{number}")])
        assert written is not None
        message = bytearray(b"".join(written.stream_parts()))
        for _ in range(choice.randint(1, 4)):
            if choice.random() < 0.3:
                del message[choice.randint(8, len(message) - 1) :]
            else:
                message[choice.randrange(4, min(len(message), 300))] = choice.randrange(256)
        client = stream(endpoint)
        try:
            client.send(bytes(message), 5)
            refused += isinstance(answered(client)[0].error, VLAgentsError)
        except ConnectionClosed:
            refused += 1
        finally:
            client.close()
    assert refused > 100
    act = Request("act", observation(rng), session="other", request_id="other")
    assert ask(other, [act], CompactWriter())[0].error is None
    other.close()


def named_anew(number: int) -> Request:
    """Return an act with cameras of new names, whose layout has about 600 bytes."""
    image = np.zeros((1, 1, 3), np.uint8)
    return Request("act", Obs({f"{number}{index}{'x' * 110}": image for index in range(4)}))


def test_a_client_that_names_new_cameras_at_each_act_changes_to_frames() -> None:
    writer, reader = CompactWriter(), CompactReader(LIMITS)
    count = 0
    while (written := writer.write([named_anew(count)])) is not None:
        reader.read_stream(b"".join(written.stream_parts()), Budget(LIMITS))
        count += 1
    assert 100 < count < 600


def test_layouts_of_a_connection_take_bounded_memory() -> None:
    reader = CompactReader(LIMITS)

    def send(number: int) -> None:
        writer = CompactWriter()
        writer._known = dict.fromkeys(range(number))  # so that its layout gets this number
        written = writer.write([named_anew(number)])
        assert written is not None
        reader.read_stream(b"".join(written.stream_parts()), Budget(LIMITS))

    def flood() -> None:
        for number in range(1, 1000):
            send(number)

    with pytest.raises(MessageTooLarge, match="layouts of at most"):
        flood()
    send(0)  # a client that begins again
    send(1)
