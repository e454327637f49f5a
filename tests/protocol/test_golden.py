"""The codec of this package writes and reads the golden files of the protocol, and the schema's
examples are valid.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import golden
import jsonschema
import numpy as np
import pytest
from asgi_server import served
from in_flight import read_requests
from starlette.testclient import TestClient
from websockets.sync.client import connect

from vlagents_ray.contract import Contract
from vlagents_ray.errors import MalformedMessage
from vlagents_ray.images.jpeg_png import decode
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.frame_layout import pack, unpack
from vlagents_ray.protocol.frames import (
    CONTENT_TYPE,
    decode_replies,
    encode_replies,
    encode_requests,
)
from vlagents_ray.protocol.messages import (
    DEFAULT_LIMITS,
    PROTOCOL_VERSION,
    Budget,
    Reply,
    Request,
    is_probe,
)
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine

FRAMES = golden.frames()
SCHEMA = json.loads((golden.ROOT / "clients" / "schema" / "v1.json").read_text())


def of(*kinds: str) -> Any:
    return pytest.mark.parametrize(
        "frame", [pytest.param(one, id=one.name) for one in FRAMES if one.kind in kinds]
    )


def require_valid(document: Any, name: str) -> None:
    """Raise unless the document matches the schema of that name."""
    jsonschema.Draft202012Validator({"$ref": f"#/$defs/{name}", "$defs": SCHEMA["$defs"]}).validate(
        document
    )


def plain(means: Any) -> Any:
    """Return a meaning whose image files are replaced by pixels, as in decoded requests."""
    if isinstance(means, dict) and means.get("$") == "image":
        pixels = means.get("pixels")
        return (
            pixels if pixels is not None else golden.meaning(decode(golden.JPEG_FILE.read_bytes()))
        )
    if isinstance(means, dict):
        return {key: plain(value) for key, value in means.items()}
    return [plain(value) for value in means] if isinstance(means, list) else means


def test_the_files_are_what_the_command_writes(tmp_path: Path) -> None:
    golden.write(tmp_path)
    written = {
        file.relative_to(tmp_path): file.read_bytes()
        for file in tmp_path.rglob("*")
        if file.is_file()
    }
    others = {"README.md", golden.JPEG_FILE.name}
    kept = {
        file.relative_to(golden.GOLDEN): file.read_bytes()
        for file in golden.GOLDEN.rglob("*")
        if file.is_file() and file.name not in others
    }
    assert written == kept, "run `python tests/support/golden.py`"


@of("requests")
def test_the_codec_reads_what_a_request_says_and_writes_its_bytes(frame: golden.Golden) -> None:
    requests = read_requests(frame.data, Budget(DEFAULT_LIMITS))
    assert all(isinstance(request, Request) for request in requests)
    assert [golden.of_request(request) for request in requests] == plain(frame.meaning)  # type: ignore[arg-type]
    if frame.by_codec:
        assert encode_requests(requests) == frame.data  # type: ignore[arg-type]


@of("replies")
def test_the_codec_reads_what_a_reply_says_and_writes_its_bytes(frame: golden.Golden) -> None:
    replies = decode_replies(frame.data)
    # An unknown code is read as "internal".
    said = json.loads(json.dumps(frame.meaning).replace('"melted"', '"internal"'))
    assert [golden.of_reply(reply) for reply in replies] == said
    if frame.by_codec:
        assert encode_replies(replies) == frame.data


@of("requests", "replies")
def test_the_header_of_a_frame_is_one_of_the_schema(frame: golden.Golden) -> None:
    header, _ = unpack(frame.data, DEFAULT_LIMITS)
    require_valid(header, f"{frame.kind}_header")


@of("malformed")
def test_a_malformed_frame_is_refused(frame: golden.Golden) -> None:
    with pytest.raises(MalformedMessage):
        decode_replies(frame.data)


def test_a_probe_is_one_and_its_answer_counts_it() -> None:
    by_name = {frame.name: frame.data for frame in FRAMES}
    assert is_probe(by_name["probe"])
    assert len(by_name["probe"]) == 100


@pytest.mark.parametrize("name", golden.documents())
def test_a_document_is_one_of_the_schema(name: str) -> None:
    require_valid(
        golden.documents()[name], "_".join(name.split("_")[: 1 + (not name.startswith("problem"))])
    )


@pytest.mark.parametrize(
    ("name", "document"),
    [
        ("act_request", {"cameras": {}}),
        ("act_request", {"gripper": "open"}),
        ("act_answer", {"request_id": "", "done": False, "info": {}, "timing": {}}),
        ("problem", {"detail": "no code"}),
        ("metadata", {"protocol": 2}),
        ("requests_header", {"op": "act", "blobs": []}),
        ("requests_header", {"op": "close", "unknown": 1, "blobs": []}),
        ("requests_header", {"requests": [], "blobs": []}),
        ("replies_header", {"request_id": "", "blobs": []}),
        (
            "replies_header",
            {"request_id": "", "info": {"x": {"$": ["nd", 0, "|O8", []]}}, "blobs": []},
        ),
    ],
)
def test_the_schema_refuses_what_the_protocol_does_not_allow(name: str, document: Any) -> None:
    with pytest.raises(jsonschema.ValidationError):
        require_valid(document, name)


REFUSED_ACTS = [
    {"instruction": "push"},
    {"kwargs": {"seed": 3}},
    {"contract": {"chunk": 2}},
    {"deadline_ms": 1e9},
    {"deadline_ms": 0},
    {"request_id": "x" * 129},
    {"state": {"x" * 129: [0.0]}},
    {"state": {"": [0.0]}},
    {"state": {"joints": [-1.1e49]}},
    {"gripper": 2},
]


class Chunks(Agent):
    """A policy that returns a chunk or raises an error."""

    @property
    def contract(self) -> Contract:
        return Contract(chunk=2, history=1)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {"array": np.arange(2), "kwargs": kwargs}

    def act(self, obs: Obs) -> Act:
        if obs.info.get("fail"):
            raise RuntimeError("no")
        return Act(np.ones((2, 3)), info={"nan": np.nan, "raw": b"\0", "pixels": dict(obs.cameras)})


@pytest.fixture(scope="module")
def client() -> Iterator[TestClient]:
    engine = Engine(Chunks())
    engine.start()
    metadata = {
        "protocol": PROTOCOL_VERSION,
        "contract": Chunks().contract.to_json(),
        "stream": None,
    }
    with TestClient(
        AccessMiddleware(build_http_app(engine, lambda: metadata, DEFAULT_LIMITS), None, "app")
    ) as client:
        yield client
    engine.close()


@pytest.mark.parametrize("document", REFUSED_ACTS, ids=str)
def test_what_the_schema_refuses_the_server_refuses_too_in_json_and_in_frames(
    document: dict[str, Any], client: TestClient
) -> None:
    of_obs = {key: value for key, value in document.items() if key in ("state", "gripper")}
    header = {
        "op": "act",
        "obs": of_obs,
        **{key: value for key, value in document.items() if key not in of_obs},
    }
    client.post("/v1/reset", json={}, headers={"x-session-id": "robot-1"})
    for name, said, kind in (
        ("act_request", document, "application/json"),
        ("requests_header", header | {"blobs": []}, CONTENT_TYPE),
    ):
        with pytest.raises(jsonschema.ValidationError):
            require_valid(said, name)
        content = b"".join(pack(header, [])) if kind == CONTENT_TYPE else json.dumps(said).encode()
        headers = {"x-session-id": "robot-1", "content-type": kind}
        answer = client.post("/v1/act", content=content, headers=headers)
        assert answer.json()["code"] in ("malformed", "invalid_observation", "too_large"), (
            answer.text
        )


def test_what_a_server_answers_is_what_the_schema_says(client: TestClient) -> None:
    session = {"x-session-id": "robot-2"}
    require_valid(client.get("/v1/metadata").json(), "metadata")
    unknown = client.post("/v1/act", json={}, headers=session)
    assert (unknown.status_code, unknown.json()["code"]) == (404, "unknown_session")
    require_valid(unknown.json(), "problem")
    for op, name in (("reset", "reset_request"), ("act", "act_request")):
        answer = client.post(f"/v1/{op}", json=golden.documents()[name], headers=session)
        assert answer.status_code == 200, answer.text
        require_valid(answer.json(), f"{op}_answer")
    form = (golden.GOLDEN / "http" / "act_form.bin").read_bytes()
    kind = {"content-type": f"multipart/form-data; boundary={golden.BOUNDARY}"}
    answer = client.post("/v1/act", content=form, headers=session | kind)
    require_valid(answer.json(), "act_answer")
    assert answer.json()["info"]["pixels"] == {"front": golden.PIXELS.tolist()}
    require_valid(
        client.post("/v1/act", json={"info": {"fail": 1}}, headers=session).json(), "problem"
    )
    frame = {"content-type": CONTENT_TYPE, "accept": CONTENT_TYPE}
    answer = client.post(
        "/v1/act", content=encode_requests([Request("act", Obs())]), headers=session | frame
    )
    require_valid(unpack(answer.content, DEFAULT_LIMITS)[0], "replies_header")
    require_valid(client.post("/v1/close", headers=session).json(), "close_answer")
    with served(client.app) as port, connect(f"ws://127.0.0.1:{port}/v1/stream") as stream:
        for data, error in ((encode_requests([Request("reset", Obs())]), False), (b"VLA", True)):
            stream.send(data)
            reply = stream.recv(10)
            require_valid(unpack(reply, DEFAULT_LIMITS)[0], "replies_header")
            assert isinstance(decode_replies(reply)[0], Reply)
            assert (decode_replies(reply)[0].error is not None) == error
