"""Probes are answered at once, and reach neither a session nor the policy."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from probes import bytes_probe, is_probe_answer
from starlette.testclient import TestClient

from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.frames import decode_reply, encode_request
from vlagents_ray.protocol.messages import Limits, Request
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine

OBS = Obs({"front": np.zeros((32, 48, 3), np.uint8)})


class Untouched(Agent):
    """Its error would be the answer to a probe that reached it."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict:
        return {}

    def act(self, obs: Obs) -> Act:
        raise RuntimeError("a probe reached the policy")


@pytest.fixture(scope="module")
def engine() -> Iterator[Engine]:
    engine = Engine(Untouched())
    engine.start()
    yield engine
    engine.close()


@pytest.fixture(scope="module")
def client(engine: Engine) -> Iterator[TestClient]:
    with TestClient(AccessMiddleware(build_http_app(engine, dict, Limits(body_bytes=100_000)), None, "app")) as client:
        yield client


@pytest.mark.parametrize("size", [8, 5_000, 100_000])
def test_a_probe_is_answered_without_a_session(client: TestClient, engine: Engine, size: int) -> None:
    before, probe = len(engine.sessions), bytes_probe(size)
    with client.websocket_connect("/v1/stream") as socket:
        socket.send_bytes(probe)
        assert is_probe_answer(socket.receive_bytes(), probe)
        assert len(engine.sessions) == before


def test_a_broken_probe_leaves_the_stream_as_it_was(client: TestClient) -> None:
    with client.websocket_connect("/v1/stream") as socket:
        socket.send_bytes(b"VLA?\0\0")
        error = decode_reply(socket.receive_bytes()).error
        assert error is not None
        assert error.code == "malformed"
        socket.send_bytes(encode_request(Request("reset", OBS, request_id="r")))
        assert decode_reply(socket.receive_bytes()).error is None
