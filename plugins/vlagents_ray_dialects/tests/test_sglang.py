"""Tests of SGLang's `/v1/actions`: one or several observations, in JSON and msgpack, with and
without sessions, over HTTP and WebSocket.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from dialect_server import ALL, image, serving
from golden import png
from in_memory_keys import ChangingKeys
from served_agents import Mirror
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from vlagents_ray.interface import Act, Obs
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray_dialects.messages import openpi
from vlagents_ray_dialects.messages.msgpack import pack

PATH = "/v1/actions/generations"
STATE = [0.5, 1.5]

Context = tuple[TestClient, Engine]


def observed(pixel: int = 7, **more: Any) -> dict[str, Any]:
    return {"images": {"front": image(pixel)}, "state": np.array(STATE, np.float32), **more}


def asking(prompt: Any = "task 1", observation: Any = None, **more: Any) -> dict[str, Any]:
    observation = observed() if observation is None else observation
    return {"input": {"prompt": prompt, "observation": observation}, **more}


def batch(pixels: list[int], names: list[str] | None, **parameters: Any) -> dict[str, Any]:
    """Return the request of RLinf's worker for several environments."""
    images = {"front": np.stack([image(pixel) for pixel in pixels])}
    observation = {"images": images, "state": np.tile(np.float32(STATE), (len(pixels), 1))}
    prompts = [f"task {index + 1}" for index in range(len(pixels))]
    if names is not None:
        parameters["session_ids"] = names
    return asking(prompts, observation, parameters=parameters)


def post_msgpack(client: TestClient, payload: dict[str, Any], **headers: str) -> dict[str, Any]:
    kind = {"content-type": "application/msgpack"}
    response = client.post(PATH, content=openpi.encode(payload), headers={**kind, **headers})
    assert response.status_code == 200, response.text
    assert response.headers["content-type"] == "application/msgpack"
    return openpi.decode(response.content)


def as_json(value: Any) -> Any:
    """Return an observation with lists in place of arrays."""
    if isinstance(value, dict):
        return {key: as_json(item) for key, item in value.items()}
    return value.tolist() if isinstance(value, np.ndarray) else value


def values_of(answer: dict[str, Any]) -> np.ndarray:
    [entry] = answer["data"]
    return np.asarray(entry["action"]["values"])


def test_the_envelope_is_the_one_that_sglang_sends(context: Context) -> None:
    answer = post_msgpack(context[0], asking(request_id="r-7"))
    [entry] = answer["data"]
    action = entry.pop("action")
    assert entry == {"index": 0, "input_index": 0, "candidate_index": 0}
    assert action["type"] == "continuous"
    assert action["dtype"] == "float32"
    assert action["shape"] == [2, 7]
    assert action["values"].dtype == np.float32
    assert action["values"][:, :4].tolist() == [[7, 2, 1, 1], [7, 2, 1, 1]]
    assert answer["id"] == "r-7"
    assert answer["object"] == "action.generation"
    assert answer["model"] == "mirror"
    assert isinstance(answer["created"], int)
    assert answer["timings"].keys() == {"queue_ms", "inference_ms"}
    assert answer["usage"] == {
        "batch_size": 1,
        "action_horizon": 2,
        "action_dim": 7,
        "denoise_steps": None,
        "prefix_cache_hit": False,
    }


@pytest.mark.parametrize("sends", ["json", "msgpack"])
@pytest.mark.parametrize("accepts", ["json", "msgpack"])
@pytest.mark.parametrize("response_format", ["envelope", "raw"])
@pytest.mark.parametrize("output_format", ["list", "numpy", None])
def test_an_answer_has_the_form_that_the_client_wants(
    context: Context, sends: str, accepts: str, response_format: str, output_format: str | None
) -> None:
    runtime = {"response_format": response_format, "return_timing": False}
    if output_format is not None:
        runtime["output_format"] = output_format
    payload = asking(runtime=runtime)
    is_json = sends == "json"
    content = json.dumps(as_json(payload)).encode() if is_json else openpi.encode(payload)
    headers = {"content-type": f"application/{sends}", "accept": f"application/{accepts}"}
    response = context[0].post(PATH, content=content, headers=headers)

    assert response.status_code == 200, response.text
    is_msgpack = "msgpack" in (sends, accepts)
    answer = openpi.decode(response.content) if is_msgpack else response.json()
    is_raw = response_format == "raw"
    actions = answer["actions"] if is_raw else answer["data"][0]["action"]["values"]
    has_arrays = is_msgpack and output_format != "list"
    assert isinstance(actions, np.ndarray if has_arrays else list)
    assert np.asarray(actions)[:, :4].tolist() == [[7, 2, 1, 1], [7, 2, 1, 1]]
    assert "timings" not in answer


@pytest.mark.parametrize(
    "observation",
    [
        {"images": {"front": image(7).tolist()}, "state": STATE},
        {
            "images": {"front": {"b64_json": base64.b64encode(png(image(7))).decode()}},
            "state": STATE,
        },
        {
            "images": {
                "front": {
                    "base64": "data:image/png;base64," + base64.b64encode(png(image(7))).decode()
                }
            },
            "state": STATE,
        },
        {
            "images": {
                "front": {
                    "values": image(7).ravel().tolist(),
                    "dtype": "uint8",
                    "shape": [8, 8, 3],
                }
            },
            "state": {"values": STATE, "dtype": "float32", "shape": [2]},
        },
        {"observation.images.front": image(7).tolist(), "observation.state": {"data": STATE}},
    ],
    ids=["lists", "PNG", "data URL", "values with a shape", "dotted names"],
)
def test_an_observation_is_read_in_each_form_that_sglang_reads(
    context: Context, observation: dict[str, Any]
) -> None:
    for payload in (
        asking("task 3", observation),
        {"input": {"task": "task 3", **observation}},
        {"task": "task 3", **observation},
    ):
        response = context[0].post(PATH, json=payload)
        assert response.status_code == 200, response.text
        assert values_of(response.json())[0, :4].tolist() == [7, 2, 1, 3]


def test_each_session_of_a_batch_keeps_its_episode(context: Context) -> None:
    client, _ = context
    names = ["rlinf-r0-slot0", "rlinf-r0-slot1"]
    for acts in (1, 2):
        answer = post_msgpack(client, batch([7, 8], names, reset_mask=[False, False]))
        # RLinf reads only one entry, (B, H, D).
        assert answer["data"][0]["action"]["shape"] == [2, 2, 7]
        assert values_of(answer)[:, 0, :4].tolist() == [[7, 2, acts, 1], [8, 2, acts, 2]]

    answer = post_msgpack(client, batch([7, 8], names, reset_mask=[True, False]))
    assert values_of(answer)[:, 0, 2].tolist() == [1, 3]

    # The robots are in another order, and one robot is new.
    answer = post_msgpack(client, batch([8, 9], [names[1], "rlinf-r0-slot2"]))
    assert values_of(answer)[:, 0, :4].tolist() == [[8, 2, 1, 1], [9, 2, 1, 2]]


def test_a_batch_of_one_is_stacked_where_its_session_is_named(context: Context) -> None:
    answer = post_msgpack(context[0], batch([7], ["alone"]))
    assert answer["data"][0]["action"]["shape"] == [1, 2, 7]
    raw = post_msgpack(context[0], batch([7], None) | {"runtime": {"response_format": "raw"}})
    assert raw["actions"].shape == (1, 2, 7)


def test_a_batch_without_sessions_has_an_entry_for_each_and_leaves_none(context: Context) -> None:
    client, engine = context
    before = len(engine.sessions)
    for _ in range(2):
        answer = post_msgpack(client, batch([7, 8, 9], None))
        assert [entry["input_index"] for entry in answer["data"]] == [0, 1, 2]
        rows = [entry["action"]["values"][0, :4].tolist() for entry in answer["data"]]
        assert rows == [[7, 2, 1, 1], [8, 2, 1, 2], [9, 2, 1, 3]]
    assert len(engine.sessions) == before


def test_one_observation_belongs_to_the_session_that_it_names(context: Context) -> None:
    client, _ = context
    for acts in (1, 2):
        by_header = post_msgpack(client, asking(), **{"x-session-id": "by-header"})
        by_parameter = post_msgpack(client, asking(parameters={"session_ids": ["by-parameter"]}))
        assert values_of(by_header).shape == values_of(by_parameter).shape == (2, 7)
        assert values_of(by_header)[0, 2] == values_of(by_parameter)[0, 2] == acts
        # Each such request is a new episode.
        assert values_of(post_msgpack(client, asking()))[0, 2] == 1


def test_fewer_rows_are_sent_if_the_client_wants_fewer(context: Context) -> None:
    answer = post_msgpack(context[0], asking(parameters={"action_horizon": 1, "action_dim": 7}))
    assert answer["data"][0]["action"]["shape"] == [1, 7]
    assert answer["usage"]["action_horizon"] == 1


WRONG: dict[str, tuple[Callable[[], Any], str]] = {
    "no map": (lambda: [1], "expected a map"),
    "nothing": (lambda: asking(observation={"joints": STATE}), "images/*"),
    "a wrong shape": (
        lambda: asking(observation=observed() | {"images": {"front": image(7)[0]}}),
        "(H, W, 3)",
    ),
    "too bright": (
        lambda: asking(observation={"images": {"front": [[[256, 0, 0]]]}}),
        "from 0 to 255, got 0 to 256",
    ),
    "no file": (
        lambda: asking(observation={"images": {"front": {"b64_json": "R0lGODlh"}}}),
        "front",
    ),
    "an unknown form": (
        lambda: asking(observation={"images": {"front": {"url": "x"}}}),
        "expected an array, got a map",
    ),
    "a shape that does not fit": (
        lambda: asking(
            observation={"images": {"front": {"values": [1, 2], "shape": [3], "dtype": "uint8"}}}
        ),
        "no array of",
    ),
    "noise": (lambda: asking(observation=observed(noise=np.zeros(3))), "the policy draws its own"),
    "unequal lengths": (
        lambda: asking(["task 1", "task 2"]),
        "images/front: expected one value for each robot, 2 in all, got 8",
    ),
    "too many sessions": (
        lambda: asking(["task 1"] * 8, parameters={"session_ids": ["one"]}),
        "session_ids: expected one for each of 8 observations, got 1",
    ),
    "a session twice": (lambda: batch([7, 8], ["one", "one"]), "expected each id only once"),
    "a session without a name": (lambda: batch([7, 8], ["one", ""]), "visible ASCII"),
    "no list of sessions": (
        lambda: asking(parameters={"session_ids": "one"}),
        "expected a list of texts",
    ),
    "a short mask": (
        lambda: batch([7, 8], ["one", "two"], reset_mask=[True]),
        "reset_mask: expected 2 booleans",
    ),
    "a mask of numbers": (
        lambda: batch([7, 8], ["one", "two"], reset_mask=[1, 0]),
        "reset_mask: expected 2 booleans",
    ),
    "more values": (
        lambda: asking(parameters={"action_dim": 32}),
        "action_dim: expected 7, the values in a row of the policy, got 32",
    ),
    "no rows": (lambda: asking(parameters={"action_horizon": 0}), "a whole number above 0"),
    "an unknown format": (
        lambda: asking(runtime={"response_format": "protobuf"}),
        "expected 'envelope' or 'raw'",
    ),
    "an unknown output": (
        lambda: asking(runtime={"output_format": "torch"}),
        "expected 'list' or 'numpy'",
    ),
    "formats that are arrays": (
        lambda: asking(runtime={"response_format": np.zeros(2)}, request_id=np.zeros(2)),
        "expected 'envelope' or 'raw'",
    ),
    "an output that is an array": (
        lambda: asking(runtime={"output_format": np.zeros(0)}),
        "expected 'list' or 'numpy'",
    ),
    "times that are an array": (
        lambda: asking(runtime={"return_timing": np.zeros(2)}),
        "return_timing: expected a boolean",
    ),
    "parameters that are no map": (lambda: asking(parameters=[1]), "parameters: expected a map"),
}


class Counted(Mirror):
    """A `Mirror` that counts its acts."""

    def __init__(self) -> None:
        super().__init__(chunk=2)
        self.acted: list[int] = []

    def shared_objects(self) -> list[object]:
        return [self.acted]

    def act_batch(self, obs: list[Obs], sessions: list[Any]) -> list[Act]:
        self.acted += [1] * len(obs)
        return [session.act(one) for session, one in zip(sessions, obs, strict=True)]


@pytest.mark.slow
@pytest.mark.parametrize("sent_as", ["msgpack", "realtime"])
@pytest.mark.parametrize("wrong", sorted(WRONG))
def test_a_wrong_request_says_what_is_wrong_and_nothing_is_acted_on(
    sent_as: str, wrong: str
) -> None:
    make, expected = WRONG[wrong]
    agent = Counted()
    with serving(agent, ALL) as (client, engine):
        if sent_as == "msgpack":
            response = client.post(
                PATH,
                content=openpi.encode(make()),
                headers={"content-type": "application/msgpack"},
            )
            assert 400 <= response.status_code < 500, response.text
            detail = response.json()["detail"]
        else:
            with client.websocket_connect("/v1/actions/realtime") as socket:
                socket.receive_bytes()
                socket.send_bytes(openpi.encode(make()))
                detail = openpi.decode(socket.receive_bytes())["error"]
                with pytest.raises(WebSocketDisconnect) as closed:
                    socket.receive_bytes()
                assert closed.value.code == 1011
        assert expected in detail
        assert agent.acted == []
        assert len(engine.sessions) == 0


def test_a_batch_over_the_rate_of_its_key_is_refused_and_nothing_is_acted_on() -> None:
    keys, agent = ChangingKeys(), Counted()
    headers = {
        "authorization": f"Bearer {keys.add('slow', rate=4)}",
        "content-type": "application/msgpack",
    }
    content = openpi.encode(batch([7, 8, 9], ["one", "two", "three"]))
    with serving(agent, ALL, keys.keys) as (client, _):
        assert client.post(PATH, content=content, headers=headers).status_code == 200
        refused = client.post(PATH, content=content, headers=headers)
        assert refused.status_code == 429
        assert int(refused.headers["retry-after"]) >= 1
        assert refused.json()["code"] == "too_many_requests"
        assert len(agent.acted) == 3
        no_key = {"content-type": "application/msgpack"}
        assert client.post(PATH, content=content, headers=no_key).status_code == 401


def test_a_websocket_is_a_session_and_its_answers_have_the_times(context: Context) -> None:
    client, engine = context
    before = len(engine.sessions)
    with client.websocket_connect("/v1/actions/realtime") as socket:
        assert openpi.decode(socket.receive_bytes())["object"] == "action.metadata"
        for acts in (1, 2):
            socket.send_bytes(openpi.encode(asking()))
            answer = openpi.decode(socket.receive_bytes())
            assert values_of(answer)[0, 2] == acts
            expected = {"infer_ms"} if acts == 1 else {"infer_ms", "prev_total_ms"}
            assert answer["server_timing"].keys() == expected
        socket.send_bytes(openpi.encode(batch([7, 8], None)))
        assert len(openpi.decode(socket.receive_bytes())["data"]) == 2
        socket.send_bytes(openpi.encode(asking()))
        assert values_of(openpi.decode(socket.receive_bytes()))[0, 2] == 3
    assert len(engine.sessions) == before


def test_the_metadata_are_those_that_sglangs_clients_read(context: Context) -> None:
    client, _ = context
    metadata = client.get("/v1/actions/metadata").json()
    assert metadata["object"] == "action.metadata"
    assert metadata["output"]["action_dim"] == 7
    assert metadata["capabilities"]["batch_inputs"] is True
    assert client.get("/health").json() == {"status": "ok"}


@pytest.mark.parametrize("kind", ["application/json", "application/msgpack"])
def test_a_camera_as_nested_lists_is_refused_with_the_forms_that_are_read(
    context: Context, kind: str
) -> None:
    client, _ = context
    payload = asking("task 1", observed() | {"images": {"front": np.zeros((64, 64, 3)).tolist()}})
    payload["input"]["observation"]["state"] = STATE
    content = json.dumps(payload).encode() if kind == "application/json" else pack(payload, str)
    answer = client.post(PATH, content=content, headers={"content-type": kind})
    assert answer.status_code == 413
    assert "b64_json" in answer.json()["detail"]
