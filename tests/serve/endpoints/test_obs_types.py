"""A policy receives observations with exactly the declared types, and a malformed request never
causes a server error.
"""

from __future__ import annotations

import collections
import json
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from dialect_server import client_of
from starlette.testclient import TestClient

from vlagents_ray.errors import VLAgentsError
from vlagents_ray.images.jpeg_png import encode_jpeg
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol import frame_layout
from vlagents_ray.protocol.frames import CONTENT_TYPE, decode_requests
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Budget
from vlagents_ray.serve.engine.engine import Engine


def require_types(obs: Obs) -> None:
    """Fail unless each field has exactly its declared type."""
    assert type(obs) is Obs
    assert type(obs.cameras) is dict
    assert type(obs.state) is dict
    assert type(obs.info) is dict
    assert obs.gripper is None or type(obs.gripper) is float
    for name, image in obs.cameras.items():
        assert (type(name), type(image), image.dtype, image.ndim) == (str, np.ndarray, np.uint8, 3)
        assert image.shape[2] == 3
    for name, part in obs.state.items():
        assert (type(name), type(part), part.dtype, part.ndim) == (str, np.ndarray, np.float32, 1)
    assert all(type(name) is str for name in obs.info)


class Strict(Agent):
    """A policy that checks its observations, and answers with a value that only some encodings
    support.
    """

    def __init__(self) -> None:
        self.wrong: list[str] = []

    def _check(self, obs: Obs) -> None:
        try:
            require_types(obs)
        except AssertionError as error:
            self.wrong.append(f"{error}: {obs}")

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self._check(obs)
        assert instruction is None or type(instruction) is str
        return {"last": collections.deque([1, 2])}

    def act(self, obs: Obs) -> Act:
        self._check(obs)
        return Act(
            np.zeros(2, np.float32), info={"last": collections.deque([1, 2]), "some": range(3)}
        )


POLICY = Strict()


@pytest.fixture(scope="module")
def client() -> Iterator[TestClient]:
    engine = Engine(POLICY)
    engine.start()
    with client_of(engine, {}) as http:
        yield http
    engine.close()


def chunk(name: bytes, data: bytes) -> bytes:
    return (
        struct.pack(">I", len(data))
        + name
        + data
        + struct.pack(">I", zlib.crc32(data, zlib.crc32(name)))
    )


JPEG = encode_jpeg(np.zeros((8, 8, 3), np.uint8))
PNG_HEAD = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">2I5B", 1, 1, 8, 2, 0, 0, 0))
ODD_PNG = (
    PNG_HEAD + chunk(b"IDAT", zlib.compress(bytes(4))) + chunk(b"gAMA", b"") + chunk(b"IEND", b"")
)
BLOBS = [
    np.zeros(2, np.float32).tobytes(),
    JPEG,
    b"bytes",
    ODD_PNG,
    np.zeros(12, np.uint8).tobytes(),
]
VALUES: list[Any] = [
    None,
    True,
    -1,
    1.5,
    1e300,
    10**400,
    "",
    "text",
    "a b\n",
    [],
    [1, 2],
    [[1]],
    ["a"],
    {},
    {"a": 1},
    {"": 1},
    {"a": {"b": None}},
    {"$": []},
    {"$": ["float", "nan"]},
    {"$": ["float", "inf"]},
    {"$": ["nd", 0, "<f4", [2]]},
    {"$": ["nd", 0, "<f4", [2, 1]]},
    {"$": ["nd", 0, ">f4", [2]]},
    {"$": ["nd", 0, "<i2", [4]]},
    {"$": ["nd", 0, "|b1", [8]]},
    {"$": ["nd", 4, "|u1", [2, 2, 3]]},
    {"$": ["nd", 0, "|O", [1]]},
    {"$": ["img", 1]},
    {"$": ["img", 3]},
    {"$": ["img", 2]},
    {"$": ["bin", 2]},
    {"a": {"$": ["nd", 0, "<f4", [2]]}},
    {"a": {"$": ["img", 1]}},
    {"a": {"$": ["img", 3]}},
    {"a": {"$": ["bin", 2]}},
    {"a": {"$": ["float", "-inf"]}},
    {"obs": 1},
    {"self": 1, "instruction": 2},
]
FIELDS = [
    "obs",
    "obs.cameras",
    "obs.state",
    "obs.info",
    "obs.gripper",
    "obs.cameras.front",
    "obs.state.joints",
    "obs.info.x",
    "instruction",
    "kwargs",
    "kwargs.weights",
    "kwargs.seed",
    "contract",
    "contract.action",
    "history",
    "request_id",
    "session",
    "priority",
    "step",
    "deadline_ms",
]


def with_value(field: str, value: Any) -> dict[str, Any]:
    node: dict[str, Any] = {"obs": {}}
    *folders, name = field.split(".")
    inner = node
    for folder in folders:
        inner = inner.setdefault(folder, {})
    inner[name] = value
    return node


def is_fine(status: int, field: str) -> bool:
    """Return whether the status is no server error. A deadline of a millisecond may pass, which
    gives 504.
    """
    return status < 500 or (field == "deadline_ms" and status == 504)


@pytest.mark.slow
@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("op", ["reset", "act", "close"])
def test_a_frame_with_any_value_in_any_field_is_answered(
    client: TestClient, op: str, field: str
) -> None:
    client.post("/v1/reset", headers={"x-session-id": "s"}, json={})
    for value in VALUES:
        node = {"op": op} | with_value(field, value)
        content = b"".join(frame_layout.pack(node, list(BLOBS)))
        answer = client.post(
            f"/v1/{op}",
            content=content,
            headers={"x-session-id": "s", "content-type": CONTENT_TYPE},
        )
        assert is_fine(answer.status_code, field), (field, value, answer.content)
        if op == "close":
            client.post("/v1/reset", headers={"x-session-id": "s"}, json={})
    assert POLICY.wrong == []


@pytest.mark.slow
@pytest.mark.parametrize("field", [field for field in FIELDS if "camera" not in field])
@pytest.mark.parametrize("op", ["reset", "act"])
@pytest.mark.parametrize("as_form", [False, True])
def test_a_document_with_any_value_in_any_field_is_answered(
    client: TestClient, op: str, field: str, as_form: bool
) -> None:
    client.post("/v1/reset", headers={"x-session-id": "d"}, json={})
    for value in VALUES:
        node = with_value(field.removeprefix("obs."), value)
        del node["obs"]
        text = json.dumps(node)
        files = {"obs": (None, text), "cameras.front": ("a", ODD_PNG)}
        body: dict[str, Any] = {"files": files} if as_form else {"content": text}
        headers = {"x-session-id": "d"} | ({} if as_form else {"content-type": "application/json"})
        answer = client.post(f"/v1/{op}", headers=headers, **body)
        assert is_fine(answer.status_code, field), (field, value, answer.content)
    assert POLICY.wrong == []


@pytest.mark.parametrize(
    "op", ["reset", "act", "close", "call", "unknown", None, {"$": ["nd", 0, "<f4", [2]]}, []]
)
def test_what_a_decoder_returns_has_the_types_of_an_observation(op: Any) -> None:
    """These tests cover the endpoints without status codes: own port, shared memory and plasma."""
    for field in FIELDS:
        for value in VALUES:
            data = b"".join(frame_layout.pack({"op": op} | with_value(field, value), list(BLOBS)))
            try:
                decoded = decode_requests(data, Budget(DEFAULT_LIMITS))
            except VLAgentsError:
                continue
            for request in decoded.requests:
                for obs in (*request.history, *([] if request.obs is None else [request.obs])):
                    require_types(obs)
                assert (
                    type(request.request_id),
                    type(request.session),
                    type(request.priority),
                ) == (
                    str,
                    str,
                    str,
                )
                assert type(request.kwargs) is dict
            assert all(isinstance(reply.error, VLAgentsError) for reply in decoded.refused.values())


@pytest.mark.parametrize("name", ["self", "obs", "instruction"])
def test_an_option_named_as_a_parameter_of_reset_is_refused(client: TestClient, name: str) -> None:
    answer = client.post("/v1/reset", headers={"x-session-id": "k"}, json={"kwargs": {name: 1}})
    assert answer.status_code == 400
    assert "parameters of `reset`" in answer.json()["detail"]


def test_an_answer_is_the_same_in_json_and_in_a_frame(client: TestClient) -> None:
    client.post("/v1/reset", headers={"x-session-id": "j"}, json={})
    answer = client.post("/v1/act", headers={"x-session-id": "j"}, json={})
    assert answer.status_code == 200
    assert answer.json()["info"].items() >= {"last": [1, 2], "some": [0, 1, 2]}.items()
