"""Tests of inference engines behind `upstream`, replayed from recordings of their own message code
(engines/*.json).

`tests/support/engine_frames.py` makes the recordings. A server here answers a request only if it is
bit-identical to a recorded one, which the engine's code has answered.
"""

from __future__ import annotations

import base64
import json
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import engine_frames
import numpy as np
import pytest
from websockets.sync.server import serve

from vlagents_ray.errors import (
    ContractMismatch,
    InvalidObservation,
    PolicyFailed,
    PolicyUnavailable,
)
from vlagents_ray.interface import Act, Obs
from vlagents_ray_dialects.upstream import Upstream

IMAGES, STATE, PROMPT = engine_frames.observed()
DOTTED = {"front": "observation.images.base_0_rgb", "wrist": "observation.images.left_wrist_0_rgb"}
NESTED = {"front": "images/base_0_rgb", "wrist": "images/left_wrist_0_rgb"}
SESSION = re.compile(rb"[0-9a-f]{32}")
SETTINGS: dict[str, dict[str, Any]] = {
    "sglang_websocket": {
        "protocol": "openpi",
        "urls": ["/openpi/policy"],
        "mapping": {
            "cameras": DOTTED,
            "state": {"joints": "observation.state"},
            "instruction": "prompt",
        },
    },
    "sglang_http": {
        "protocol": "sglang",
        "urls": [""],
        "mapping": {"cameras": NESTED, "state": {"joints": "state"}, "instruction": "prompt"},
    },
    "vllm_omni_websocket": {
        "protocol": "roboarena",
        "urls": ["/v1/realtime/robot/openpi"],
        "mapping": {"cameras": DOTTED, "state": {"joints": "state"}, "instruction": "prompt"},
    },
    "flashrt_http": {
        "protocol": "flashrt",
        "urls": [""],
        "mapping": {"cameras": NESTED, "instruction": "prompt"},
    },
}
PATHS = {
    "sglang_http": ("/v1/actions/metadata", "/v1/actions/generations"),
    "flashrt_http": ("/health", "/predict"),
}
STATES = {"flashrt_http": np.zeros_like(STATE)}  # FlashRT's server reads no state
# SGLang's own code does not produce its HTTP error 500, so it is not recorded.
FAILING = [name for name in SETTINGS if name != "sglang_http"]
SEEN = Obs(dict(zip(("front", "wrist"), IMAGES.values(), strict=True)), state={"joints": STATE})


def recorded(name: str) -> tuple[bytes, dict[bytes, bytes]]:
    """Return the metadata of an engine, and its answers by request."""
    document = json.loads((engine_frames.FOLDER / f"{name}.json").read_text())
    requests, replies = (
        [base64.b64decode(one) for one in document[key]] for key in ("requests", "replies")
    )
    return replies[0], dict(zip(requests, replies[1:], strict=True))


@pytest.fixture
def replayed() -> Iterator[Callable[[str], Upstream]]:
    """Yield a function that returns a policy whose upstream replays the recording with a name."""
    with ExitStack() as stack:

        def make(name: str, *, closing: bool = False, prefix: str = "", **changes: Any) -> Upstream:
            metadata, answers = recorded(name)

            def websocket(connection: Any) -> None:
                connection.send(metadata)
                for request in connection:
                    connection.send(answers[SESSION.sub(b"0" * 32, request)])

            class Http(BaseHTTPRequestHandler):
                protocol_version = "HTTP/1.1"

                def do_GET(self) -> None:
                    self._send(metadata if self.path == prefix + PATHS[name][0] else None)

                def do_POST(self) -> None:
                    body = self.rfile.read(int(self.headers["Content-Length"]))
                    self._send(answers[body] if self.path == prefix + PATHS[name][1] else None)

                def _send(self, body: bytes | None) -> None:
                    self.send_response(404 if body is None else 422 if b"detail" in body else 200)
                    self.send_header("Content-Length", str(len(body or b"")))
                    if closing:
                        self.send_header("Connection", "close")
                    self.end_headers()
                    self.wfile.write(body or b"")

                def log_message(self, *_arguments: object) -> None:
                    pass

            if is_http := name.endswith("http"):
                server: Any = ThreadingHTTPServer(("127.0.0.1", 0), Http)
                stack.callback(server.server_close)
                port = server.server_address[1]
            else:
                server = stack.enter_context(serve(websocket, "127.0.0.1", 0, compression=None))
                port = server.socket.getsockname()[1]
            thread = threading.Thread(target=server.serve_forever)
            thread.start()
            stack.callback(thread.join)
            stack.callback(server.shutdown)
            path = prefix + PATHS[name][1] if prefix else SETTINGS[name]["urls"][0]
            url = f"{'http' if is_http else 'ws'}://127.0.0.1:{port}{path}"
            config = (
                SETTINGS[name] | {"urls": [url], "connect_timeout_s": 5, "retry_s": 30} | changes
            )
            return stack.enter_context(Upstream.from_config(config))

        yield make


def act(agent: Upstream, instruction: str | None, obs: Obs = SEEN) -> Act | Exception:
    agent.reset(obs, instruction)
    [answer] = agent.act_batch([obs], [agent])
    return answer


@pytest.mark.parametrize("name", SETTINGS)
def test_an_engine_reads_our_request_and_its_actions_arrive_unchanged(
    replayed: Callable[..., Upstream], name: str
) -> None:
    agent = replayed(name)
    agent.initialize()
    answer = act(agent, PROMPT)
    assert not isinstance(answer, Exception), answer
    np.testing.assert_array_equal(
        answer.action, engine_frames.answered(IMAGES, STATES.get(name, STATE), PROMPT), strict=True
    )


@pytest.mark.parametrize("name", FAILING)
def test_an_engines_error_is_in_the_log_and_not_in_the_answer(
    replayed: Callable[..., Upstream], name: str, caplog: pytest.LogCaptureFixture
) -> None:
    agent = replayed(name)
    agent.initialize()
    error = act(agent, "fail")
    assert isinstance(error, PolicyFailed)
    assert "secret" not in str(error)
    assert "Internal inference error" in caplog.text or "a secret of the upstream" in caplog.text
    assert isinstance(act(agent, PROMPT), Act)


@pytest.mark.parametrize("name", [name for name in SETTINGS if not name.startswith("flashrt")])
def test_the_rows_of_an_engines_metadata_are_the_contracts(
    replayed: Callable[..., Upstream], name: str
) -> None:
    agent = replayed(name)
    agent.initialize()
    assert agent.contract.chunk == engine_frames.ROWS
    with pytest.raises(ContractMismatch, match="gives 3 rows"):
        replayed(name, contract={"chunk": 50}).initialize()


def test_vllm_omni_needs_its_external_and_its_wrist_camera(
    replayed: Callable[..., Upstream],
) -> None:
    mapping = SETTINGS["vllm_omni_websocket"]["mapping"] | {"cameras": {"wrist": DOTTED["wrist"]}}
    with pytest.raises(
        ContractMismatch, match="expected 1 external ones, which the upstream needs, got 0"
    ):
        replayed("vllm_omni_websocket", mapping=mapping).initialize()


CAMERAS = SETTINGS["flashrt_http"]["mapping"]["cameras"]


@pytest.mark.parametrize(
    ("mapping", "said"),
    [
        ({"instruction": "prompt"}, r"cameras: expected images/NAME for each.*got \[\]"),
        (
            {"cameras": {"front": "images"}, "instruction": "prompt"},
            r"cameras: expected images/NAME for each.*got \['front'\]",
        ),
        (
            {"cameras": CAMERAS | {"front": {"key": "images/f", "optional": True}}},
            r"cameras: expected images/NAME for each.*got \['front'\]",
        ),
        ({"cameras": CAMERAS, "instruction": "task"}, "instruction: expected 'prompt', got 'task'"),
    ],
)
def test_flashrt_does_not_start_with_a_mapping_that_it_would_complete_itself(
    replayed: Callable[..., Upstream], mapping: dict[str, Any], said: str
) -> None:
    with pytest.raises(ContractMismatch, match=said):
        replayed("flashrt_http", mapping=mapping).initialize()


@pytest.mark.parametrize(
    ("obs", "instruction"),
    [(SEEN, None), (Obs(SEEN.cameras | {"front": np.zeros((4, 4, 3), np.uint8)}), PROMPT)],
)
def test_flashrt_never_gets_an_observation_that_it_would_complete_itself(
    replayed: Callable[..., Upstream], obs: Obs, instruction: str | None
) -> None:
    agent = replayed("flashrt_http")
    agent.initialize()
    assert isinstance(error := act(agent, instruction, obs), InvalidObservation)
    assert "expected images of one shape and a prompt" in str(error)


@pytest.mark.parametrize("name", ["sglang_websocket", "sglang_http"])
def test_a_camera_that_sglang_would_ignore_does_not_start(
    replayed: Callable[..., Upstream], name: str
) -> None:
    mapping = SETTINGS[name]["mapping"]
    only_front = mapping | {"cameras": {"front": mapping["cameras"]["front"]}}
    replayed(name, mapping=only_front).initialize()  # the robot has no camera at its wrist
    misspelt = mapping | {"cameras": {"front": mapping["cameras"]["front"].replace("rgb", "bgr")}}
    with pytest.raises(
        ContractMismatch,
        match=r"expected \['base_0_rgb', 'left_wrist_0_rgb'\], which the upstream reads, got",
    ):
        replayed(name, mapping=misspelt).initialize()


def test_an_upstream_that_closes_each_connection_or_has_a_prefix_is_used(
    replayed: Callable[..., Upstream],
) -> None:
    for agent in (
        replayed("sglang_http", closing=True),
        replayed("sglang_http", prefix="/robot/1"),
    ):
        agent.initialize()
        assert isinstance(act(agent, PROMPT), Act)


def test_an_error_over_http_states_the_status_and_the_place_of_the_text(
    replayed: Callable[..., Upstream],
) -> None:
    agent = replayed("flashrt_http")
    agent.initialize()
    assert "it answered with HTTP 422, whose text the server's log has" in str(act(agent, "fail"))
    with pytest.raises(
        PolicyUnavailable, match=r"HTTP 404, .*; expected its metadata at /v1/actions/metadata"
    ):
        replayed("flashrt_http", protocol="sglang", connect_timeout_s=0.2).initialize()
