"""The HTTP endpoint of robots, over an engine without Ray: each fault gets its documented
answer.
"""

from __future__ import annotations

import gzip
import json
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient, WebSocketDenialResponse

from vlagents_ray.contract import CameraSpec, Contract, StateSpec
from vlagents_ray.images.jpeg_png import encode_jpeg
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.loading import report_progress, report_uncompiled
from vlagents_ray.protocol.frames import CONTENT_TYPE, encode_requests
from vlagents_ray.protocol.messages import MessageLimits, Request
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine

IMAGE = np.random.default_rng(0).integers(0, 255, (32, 48, 3), np.uint8)
JPEG = encode_jpeg(IMAGE, quality=95)
GOOD = {"gripper": 0.5, "state": {"joints": [0.1, 0.2]}}
LIMITS = MessageLimits(body_bytes=300_000, pixels=64 * 64)


class Mean(Agent):
    """A policy that returns the mean colour of its camera, and its joints."""

    @property
    def contract(self) -> Contract:
        return Contract({"front": CameraSpec(32, 48)}, {"joints": StateSpec(2)}, gripper=True)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.instruction = instruction
        return {"seed": kwargs.get("seed")}

    def act(self, obs: Obs) -> Act:
        if obs.info.get("fail"):
            raise RuntimeError("no")
        if obs.info.get("odd"):
            return Act(np.zeros(5), info={"loss": np.inf, "text": "\ud800"})
        action = [*obs.cameras["front"].mean((0, 1)), *obs.state["joints"]]
        return Act(np.array(action), info={"instruction": self.instruction, "array": np.arange(2)})


@pytest.fixture(scope="module")
def client() -> Iterator[TestClient]:
    engine = Engine(Mean())
    engine.start()
    metadata = {"policy": "mean", "version": "0", "protocol": 1, "config": {"clip": float("inf")}}
    inside = build_http_app(engine, lambda: metadata, LIMITS)
    with TestClient(AccessMiddleware(inside, None, "app")) as client:
        yield client
    engine.close()


def post(
    client: TestClient,
    op: str,
    obs: Any = GOOD,
    files: Any = None,
    session: str | None = "robot-1",
    **kwargs: Any,
):
    headers = {**({"x-session-id": session} if session else {}), **kwargs.pop("headers", {})}
    text = obs if isinstance(obs, (str, bytes)) else json.dumps(obs)
    parts = {"obs": (None, text, "application/json")} | (
        {"cameras.front": JPEG} if files is None else files
    )
    return client.post(f"/v1/{op}", headers=headers, files=parts, **kwargs)


def good_act(client: TestClient) -> None:
    assert post(client, "reset", {**GOOD, "instruction": "push"}).status_code == 200
    answer = post(client, "act")
    assert answer.status_code == 200, answer.text
    document = answer.json()
    np.testing.assert_allclose(document["action"][:3], IMAGE.mean((0, 1)), atol=2)
    np.testing.assert_allclose(document["action"][3:], [0.1, 0.2], atol=1e-6)
    assert document["info"].pop("policy") == {"version": 0, "fingerprint": ""}
    assert document["info"] == {"instruction": "push", "array": [0, 1]}
    assert document["timing"].keys() >= {
        "queue_ms",
        "inference_ms",
        "decode_ms",
        "encode_ms",
        "total_ms",
    }


def test_a_form_that_does_not_say_how_long_it_is_has_the_limit_of_all(client: TestClient) -> None:
    def form() -> Iterator[bytes]:
        yield b'--b\r\ncontent-disposition: form-data; name="cameras.front"; filename="f"\r\n\r\n'
        for _ in range(20):
            yield bytes(100_000)
        yield b"\r\n--b--\r\n"

    headers = {"x-session-id": "a", "content-type": "multipart/form-data; boundary=b"}
    answer = client.post("/v1/act", content=form(), headers=headers)
    assert (answer.status_code, answer.json()["code"]) == (413, "too_large")


def test_what_json_cannot_hold_in_the_info_of_a_policy_costs_no_action(client: TestClient) -> None:
    post(client, "reset")
    answer = post(client, "act", {**GOOD, "info": {"odd": True}})
    assert answer.status_code == 200, answer.text
    assert answer.json()["action"] == [0] * 5
    assert answer.json()["info"]["loss"] is None


MULTIPART = {"x-session-id": "robot-1", "content-type": "multipart/form-data; boundary=b"}


def form(*parts: tuple[str, str | None, bytes]) -> bytes:
    """Return a multipart form. Each part has a name, a filename or None, and its content."""
    written = [
        b'--b\r\ncontent-disposition: form-data; name="%s"%s\r\n\r\n%s\r\n'
        % (name.encode(), b"" if file is None else b'; filename="%s"' % file.encode(), content)
        for name, file, content in parts
    ]
    return b"".join(written) + b"--b--\r\n"


OBS = ("obs", None, json.dumps(GOOD).encode())
HINTS = [  # a form, and the text in its error
    (
        form(OBS, ("cameras.front", "f", JPEG), ("cameras.front", "f", JPEG)),
        "expected the part 'cameras.front' once, got it twice",
    ),
    (form(OBS, OBS, ("cameras.front", "f", JPEG)), "expected the part 'obs' once, got it twice"),
    (
        form(OBS, ("cameras.", "f", JPEG)),
        "expected a part 'cameras.<name>', got 'cameras.', which names no camera",
    ),
    (
        form(OBS, ("cameras.front", None, b"text")),
        "expected a file in the part 'cameras.front', got text; send it with a filename",
    ),
    (
        form(OBS, ("front", "f", JPEG)),
        "expected the parts 'obs' and files 'cameras.<name>', got 'front'",
    ),
    (
        form(OBS, ("cameras.front", "f", JPEG), ("cameras.left", "f", JPEG[:-20])),
        "camera 'left': broken JPEG",
    ),
    (
        form(OBS, ("cameras.left", "f", b"GIF89a"), ("cameras.front", "f", JPEG)),
        "camera 'left': expected a JPEG or PNG file, got 6 bytes",
    ),
]
DOCUMENTS = [
    (
        b'{"cameras": {"front": "..."}}',
        {},
        "send multipart/form-data, in it the document as part 'obs' and each image",
    ),
    (b'{"state": {"joints": [1, 2], "joints": [3, 4]}}', {}, "the key 'joints' occurs twice"),
    (
        gzip.compress(b"{}"),
        {"content-encoding": "gzip"},
        "content-encoding: expected none, got 'gzip'",
    ),
    (gzip.compress(b"{}"), {}, "body: expected it uncompressed, got gzip"),
    (b"{}", {"content-encoding": "br"}, "content-encoding: expected none, got 'br'"),
]


def test_what_is_misplaced_is_refused_with_the_cure(client: TestClient) -> None:
    answers = [
        (client.post("/v1/act", content=body, headers=MULTIPART), said) for body, said in HINTS
    ]
    plain = {"x-session-id": "robot-1", "content-type": "application/json"}
    answers += [
        (client.post("/v1/act", content=body, headers=plain | more), said)
        for body, more, said in DOCUMENTS
    ]
    body, more = gzip.compress(HINTS[0][0]), {"content-encoding": "gzip"}
    answers.append(
        (
            client.post("/v1/act", content=body, headers=MULTIPART | more),
            "content-encoding: expected none, got 'gzip'",
        )
    )
    for answer, said in answers:
        assert (answer.status_code, answer.json()["code"]) == (400, "malformed"), said
        assert said in answer.json()["detail"]


@pytest.mark.parametrize("name", ["", "x" * 129, "a\nb"])
def test_a_camera_or_state_whose_name_is_none_is_refused(client: TestClient, name: str) -> None:
    good_act(client)
    for obs in (
        Obs({"front": IMAGE, name: IMAGE}, None, {"joints": np.zeros(2, np.float32)}),
        Obs(
            {"front": IMAGE},
            None,
            {"joints": np.zeros(2, np.float32), name: np.zeros(2, np.float32)},
        ),
    ):
        headers = {"x-session-id": "robot-1", "content-type": CONTENT_TYPE}
        answer = client.post(
            "/v1/act", content=encode_requests([Request("act", obs)]), headers=headers
        )
        assert (answer.status_code, answer.json()["code"]) == (422, "invalid_observation")
        assert "expected names of 1 to 128 printable characters" in answer.json()["detail"]


def test_an_identity_coding_is_none(client: TestClient) -> None:
    assert post(client, "reset", headers={"content-encoding": "identity"}).status_code == 200


def test_health_metadata_and_docs(client: TestClient) -> None:
    assert client.get("/healthz").text == "OK\n"
    metadata = client.get("/v1/metadata").json()
    assert (metadata["policy"], metadata["config"]) == ("mean", {"clip": None})
    page = client.get("/docs")
    assert "/v1/reset" in page.text
    assert "missing_camera" in page.text
    assert "encode_ms" in page.text


class Slow(Mean):
    """A policy whose load has two steps; the second one waits."""

    def __init__(self) -> None:
        self.compiling, self.go_on = threading.Event(), threading.Event()

    def initialize(self) -> None:
        report_progress("compiling 1 rows (1 of 2)")
        report_progress("compiling 2 rows (2 of 2)")
        report_uncompiled("2 rows")
        self.compiling.set()
        self.go_on.wait(60)


def test_health_and_refusals_name_the_step_of_a_long_start() -> None:
    policy = Slow()
    engine = Engine(policy)
    starting = threading.Thread(target=engine.start)
    with TestClient(AccessMiddleware(build_http_app(engine, dict, LIMITS), None, "app")) as client:
        starting.start()
        try:
            assert policy.compiling.wait(60)
            for answer in (
                client.get("/healthz"),
                client.get("/v1/metadata"),
                post(client, "reset"),
            ):
                assert answer.status_code == 503
                assert "the policy is loading (compiling 2 rows (2 of 2))" in answer.text
        finally:
            policy.go_on.set()
            starting.join()
        assert client.get("/healthz").text == "OK\n"
        assert engine.model.uncompiled == ["2 rows"]
    engine.close()


NAN, HUGE = float("nan"), 10**400


FRAME = encode_requests(
    [Request("act", Obs({"front": IMAGE}, 1.0, {"joints": np.zeros(2, np.float32)}))]
)
FRAMED = {"content-type": CONTENT_TYPE}

# (request, status, code) for each kind of fault in a robot's software; tests/protocol has further
# faults of frames.
FAULTS: list[tuple[dict[str, Any], int, str]] = [
    *[({"files": {"cameras.front": JPEG[:-cut]}}, 400, "malformed") for cut in (20, 700)],
    *[({"content": FRAME[:-cut], "headers": FRAMED}, 400, "malformed") for cut in (1, 900)],
    *[
        ({"obs": text}, 400, "malformed")
        for text in ("", "{", "null", "[1]", "nan", "[" * 9999, '{"a": 1}', "\xff")
    ],
    *[
        ({"obs": json.dumps({**GOOD, "info": {text: text}})}, 400, "malformed")
        for text in ("\ud800", "a\udfff")
    ],
    *[
        ({"obs": {**GOOD, key: 1}}, 400, "malformed")
        for key in ("camera", "images", "prompt", "session", "x" * 999)
    ],
    *[
        ({"obs": {**GOOD, "state": {"joints": x}}}, 422, "invalid_observation")
        for x in (
            [NAN, 0],
            [float("inf"), 0],
            [1],
            [1, 2, 3],
            [[1, 2]],
            ["1", "2"],
            [None, 1],
            [True, 1],
            [HUGE, 1],
            1,
        )
    ],
    *[
        ({"obs": {**GOOD, "gripper": x}}, 422, "invalid_observation")
        for x in (-0.1, 1.1, "open", [1], NAN, True, HUGE)
    ],
    *[({"obs": {**GOOD, "state": x}}, 400, "malformed") for x in ([1], "joints", 3)],
    ({"obs": {**GOOD, "state": {}}}, 422, "missing_state"),
    ({"obs": {**GOOD, "state": {"joint": [1, 2]}}}, 422, "missing_state"),
    ({"obs": {"state": GOOD["state"]}}, 422, "invalid_observation"),
    ({"files": {}}, 422, "missing_camera"),
    ({"files": {"cameras.wrist": JPEG}}, 422, "missing_camera"),
    ({"files": {"cameras.front": encode_jpeg(IMAGE[:8])}}, 422, "invalid_observation"),
    ({"files": {"cameras.front": b"GIF89a" + JPEG}}, 400, "malformed"),
    ({"files": {"cameras.front": b""}}, 400, "malformed"),
    ({"files": {"cameras.front": encode_jpeg(np.zeros((65, 65, 3), np.uint8))}}, 413, "too_large"),
    ({"files": {"cameras.front": JPEG, "image": JPEG}}, 400, "malformed"),
    ({"files": {f"cameras.{i}": JPEG for i in range(30)}}, 400, "malformed"),
    ({"files": {"cameras.front": JPEG, "x": bytes(400_000)}}, 413, "too_large"),
    ({"obs": {**GOOD, "info": {"a": list(range(20_000))}}}, 413, "too_large"),
    ({"obs": {**GOOD, "info": [1]}}, 400, "malformed"),
    ({"obs": {**GOOD, "instruction": 3}}, 400, "malformed"),
    ({"obs": {**GOOD, "instruction": "x"}}, 400, "malformed"),
    ({"obs": {**GOOD, "kwargs": {"seed": 1}}}, 400, "malformed"),
    ({"obs": {**GOOD, "state": {"joints": [0.1, -1e49]}}}, 422, "invalid_observation"),
    ({"obs": {**GOOD, "deadline_ms": 0}}, 400, "malformed"),
    ({"obs": {**GOOD, "info": {"fail": 1}}}, 500, "policy_failed"),
    ({"session": None}, 400, "malformed"),
    ({"session": "x" * 200}, 400, "malformed"),
    ({"session": "never-reset"}, 404, "unknown_session"),
    ({"headers": {"x-deadline-ms": "soon"}}, 400, "malformed"),
    ({"headers": {"x-deadline-ms": "nan"}}, 400, "malformed"),
    ({"content": FRAME, "headers": {"content-type": "text/plain"}}, 400, "malformed"),
    ({"content": FRAME}, 400, "malformed"),
    ({"content": b"{}", "headers": {"content-type": "multipart/form-data"}}, 400, "malformed"),
    (
        {"content": b"--x", "headers": {"content-type": "multipart/form-data; boundary=x"}},
        400,
        "malformed",
    ),
    ({"content": bytes(400_000), "headers": FRAMED}, 413, "too_large"),
    ({"content": encode_requests([Request("close")]), "headers": FRAMED}, 400, "malformed"),
    ({"content": FRAME.replace(b'"<f4"', b'"|O8"'), "headers": FRAMED}, 400, "malformed"),
]


def send(client: TestClient, fault: dict[str, Any]):
    if "content" in fault:
        headers = {"x-session-id": fault.get("session", "robot-1"), **fault.get("headers", {})}
        return client.post("/v1/act", content=fault["content"], headers=headers)
    return post(client, "act", **fault)


def test_each_fault_gets_its_code_and_harms_nobody(client: TestClient) -> None:
    good_act(client)
    for fault, status, code in FAULTS:
        answer = send(client, fault)
        summary = {key: str(value)[:80] for key, value in fault.items()}
        assert (answer.status_code, answer.json().get("code")) == (status, code), (
            summary,
            answer.text[:300],
        )
        assert answer.headers["content-type"] == "application/problem+json"
        assert answer.json()["request_id"]
        assert "Traceback" not in answer.text
        good = post(client, "act")
        assert good.status_code == 200, (summary, good.text)


def test_a_deadline_that_passed_is_504(client: TestClient) -> None:
    class Slow(Mean):
        def act(self, obs: Obs) -> Act:
            nonlocal acts
            acts += 1
            gate.wait(60)
            return super().act(obs)

    acts = 0
    gate = threading.Event()
    engine = Engine(Slow())
    engine.start()
    with TestClient(AccessMiddleware(build_http_app(engine, dict, LIMITS), None, "app")) as slow:
        post(slow, "reset")
        # Until the policy acts on the request. On a busy machine the first deadlines may pass
        # before.
        while not acts:
            answer = post(slow, "act", headers={"x-deadline-ms": "30"})
        assert (answer.status_code, answer.json()["code"]) == (504, "outcome_unknown")
        # This act waits behind the first one.
        answer = post(slow, "act", headers={"x-deadline-ms": "30"})
        assert (answer.status_code, answer.json()["code"]) == (504, "deadline_exceeded")
        gate.set()
        assert post(slow, "act").status_code == 200
        assert acts == 2, "the policy acted on a request that was answered with deadline_exceeded"
    engine.close()


def test_unknown_paths_and_methods_are_problems(client: TestClient) -> None:
    assert (client.get("/nope").status_code, client.get("/nope").json()["code"]) == (
        404,
        "unknown_app",
    )
    assert client.get("/v1/metadata/", follow_redirects=False).status_code == 404
    for path in ("/nope", "/v1/act"):  # 403 would look like a missing key
        with pytest.raises(WebSocketDenialResponse) as refused, client.websocket_connect(path):
            pass
        assert (refused.value.status_code, refused.value.json()["code"]) == (404, "unknown_app")
    assert client.get("/v1/act").status_code == 405
    assert client.get("/v1/act").headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize("name", ["a b", "\xe9", "x" * 129])
def test_a_request_id_that_could_forge_a_line_in_the_log_is_replaced(
    client: TestClient, name: str
) -> None:
    answer = client.get("/nope", headers=[(b"x-request-id", name.encode("latin-1"))])
    assert answer.json()["request_id"].isalnum()
    assert client.get("/nope", headers={"x-request-id": "mine-1"}).json()["request_id"] == "mine-1"
