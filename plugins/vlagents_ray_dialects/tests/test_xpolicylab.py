"""Tests of XPolicyLab's clients: `infer`, `call`, batches, repeated messages, images, and the
answers to errors.
"""

from __future__ import annotations

import base64
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dialect_server import (
    ALL,
    LIMITS,
    METADATA,
    serving,
    xpolicylab,
    xpolicylab_observation,
)
from eval_fakes import wait_for
from in_memory_keys import ChangingKeys
from served_agents import BatchedMirror, Mirror
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import MalformedMessage, MessageTooLarge
from vlagents_ray.images import jpeg_png
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.messages import Budget, MessageLimits
from vlagents_ray.serve.config.dialects import presets
from vlagents_ray.serve.dialects.base import ReplicaContext
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray_dialects.messages import xpolicylab as codec
from vlagents_ray_dialects.messages.msgpack import pack, write_packed
from vlagents_ray_dialects.xpolicylab import XPolicyLabDialect

ROWS = {"action": {"actions": {}}}  # all columns under one name
SETTINGS = {"xpolicylab": {"mapping": {"preset": "xpolicylab", **ROWS}}}
RECORDED: dict[str, list[str]] = json.loads(
    Path(__file__).with_name("xpolicylab_messages.json").read_text()
)
MARK = b"\xff\xfe\x00\x0aXPL-RGB1"


Served = tuple[TestClient, Engine, list[int]]


@pytest.fixture(name="served")
def _served() -> Iterator[Served]:
    agent = BatchedMirror()
    with serving(agent, SETTINGS) as (client, engine):
        yield client, engine, agent.sizes


class Messages:
    """Sends messages, each with a new id."""

    def __init__(self) -> None:
        self.sent = 0

    def ask(self, socket: Any, kind: str, message_id: str = "", **payload: Any) -> codec.Frame:
        """Send a message, and return the answer."""
        self.sent += 1
        message_id = message_id or f"m-{self.sent}"
        socket.send_bytes(xpolicylab(kind, message_id, **payload))
        answer = codec.decode(socket.receive_bytes(), Budget(LIMITS))
        assert answer.message_id == message_id
        return answer

    def call(self, socket: Any, method: str, obs: Any = None, message_id: str = "") -> Any:
        """Call a method, and return its result."""
        answer = self.ask(socket, "call", message_id, func_name=method, obs=obs)
        assert answer.kind == "call_result", answer.payload
        assert answer.payload["ok"] is True
        assert isinstance(answer.payload["latency_ms"], float)
        return answer.payload.get("result")

    def infer(self, socket: Any, pixel: int, message_id: str = "", **more: Any) -> Any:
        """Send an observation, and return its chunk."""
        observation = xpolicylab_observation(pixel, **more)
        answer = self.ask(socket, "infer", message_id, observation=observation)
        assert answer.kind == "infer_result", answer.payload
        return answer.payload["actions"]


@pytest.fixture(name="messages")
def _messages() -> Messages:
    return Messages()


def first_row(chunk: list[dict[str, np.ndarray]]) -> list[float]:
    """Return the pixel, the sum of the state, the number of acts in the episode, and the number of
    the task.
    """
    return chunk[0]["actions"][:4].tolist()


def error_of(answer: codec.Frame) -> tuple[str, str]:
    assert answer.kind == "error", answer
    return answer.payload["code"], answer.payload["details"]["code"]


@pytest.mark.parametrize(
    ("kind", "answered", "payload"),
    [
        ("hello", "hello_ack", {"evaluation_plan": {"cases": []}}),
        ("prepare_case", "prepare_case_ack", {"action_case_id": "case"}),
        ("reset", "reset_result", {"trial_id": "trial"}),
        ("trial_end", "trial_end_ack", {"trial_id": "trial", "success": True}),
        ("heartbeat", "heartbeat_ack", {}),
    ],
)
def test_each_message_has_its_answer_with_all_ids(
    served: Served, kind: str, answered: str, payload: dict[str, Any]
) -> None:
    labels = {
        "evaluation_id": "evaluation",
        "action_case_id": "case",
        "trial_id": "trial",
        "repeat_index": 4,
        "step": 17,
    }
    with served[0].websocket_connect("/xpolicylab") as socket:
        socket.send_bytes(codec.encode(codec.Frame(kind, "m-1", labels, payload)))
        answer = codec.decode(socket.receive_bytes(), Budget(LIMITS))
    assert answer.kind == answered
    assert answer.labels == labels
    assert answer.payload["ok"] is True


def test_a_client_is_served_at_the_root_where_no_other_dialect_has_it(
    served: Served, messages: Messages
) -> None:
    with served[0].websocket_connect("/") as socket:
        assert messages.ask(socket, "hello").payload["ok"] is True
    with serving(Mirror(), ALL) as (client, _), client.websocket_connect("/") as socket:
        assert b"needs_wrist_camera" in socket.receive_bytes()  # a message of RoboArena's client


def test_close_ends_the_connection_and_its_sessions(served: Served, messages: Messages) -> None:
    client, engine, _ = served
    with client.websocket_connect("/xpolicylab") as socket:
        messages.infer(socket, 1)
        assert len(engine.sessions) == 1
        socket.send_bytes(xpolicylab("close", reason="done"))
        with pytest.raises(WebSocketDisconnect) as ended:
            socket.receive_bytes()
        assert ended.value.code == 1000
    wait_for(lambda: len(engine.sessions) == 0)


def test_infer_is_an_act_and_reset_begins_an_episode(served: Served, messages: Messages) -> None:
    with served[0].websocket_connect("/xpolicylab") as socket:
        assert first_row(messages.infer(socket, 7)) == [7, 3, 1, 1]
        assert first_row(messages.infer(socket, 8)) == [8, 3, 2, 1]
        messages.ask(socket, "reset", trial_id="trial")
        assert first_row(messages.infer(socket, 9)) == [9, 3, 1, 1]
        # Another instruction begins an episode.
        assert first_row(messages.infer(socket, 9, task="task 5")) == [9, 3, 1, 5]


def test_an_observation_after_each_row_is_no_act(served: Served, messages: Messages) -> None:
    client, engine, sizes = served
    with client.websocket_connect("/xpolicylab") as socket:
        for acts, pixel in ((1, 10), (2, 20)):
            messages.call(socket, "update_obs", xpolicylab_observation(pixel))
            chunk = messages.call(socket, "get_action")
            assert len(chunk) == 2
            assert first_row(chunk) == [pixel, 3, acts, 1]
            # The observation after the first row of the chunk.
            messages.call(socket, "update_obs", xpolicylab_observation(99))
        assert sizes == [1, 1]
        assert len(engine.sessions) == 1


def test_the_actions_have_the_names_and_sizes_of_the_robot(messages: Messages) -> None:
    class TwoArms(Agent):
        contract = Contract(action=ActionSpec(14, gripper_open=-1.0, gripper_closed=1.0))

        def act(self, obs: Obs) -> Act:
            rows = np.tile(np.arange(14, dtype=np.float32), (3, 1))
            rows[:, [6, 13]] = [-1.0, 1.0]
            return Act(rows)

    with (
        serving(TwoArms(), {"xpolicylab": {}}) as (client, _),
        client.websocket_connect("/xpolicylab") as socket,
    ):
        chunk = messages.infer(socket, 1)
    assert len(chunk) == 3
    for row in chunk:
        assert {name: values.tolist() for name, values in row.items()} == {
            "left_arm_joint_state": [0, 1, 2, 3, 4, 5],
            "left_ee_joint_state": [1],  # the value of an open gripper
            "right_arm_joint_state": [7, 8, 9, 10, 11, 12],
            "right_ee_joint_state": [0],
        }


def test_poses_are_two_times_seven_numbers_and_a_gripper() -> None:
    mapping = presets()["xpolicylab-ee"]
    columns = mapping.columns(np.arange(16.0)[None])
    assert {name: values[0].tolist() for name, values in columns.items()} == {
        "left_ee_pose": [0, 1, 2, 3, 4, 5, 6],
        "left_ee_joint_state": [7],
        "right_ee_pose": [8, 9, 10, 11, 12, 13, 14],
        "right_ee_joint_state": [15],
    }


def test_a_batch_is_queued_together_and_each_environment_is_a_session(
    served: Served, messages: Messages
) -> None:
    client, engine, sizes = served

    def observations(*indices: int) -> list[dict[str, Any]]:
        return [xpolicylab_observation(10 + i, f"task {i}", env_idx=i) for i in indices]

    with client.websocket_connect("/xpolicylab") as socket:
        messages.call(socket, "update_obs_batch", observations(0, 1, 2))
        chunks = messages.call(socket, "get_action_batch", [0, 1, 2])
        assert [first_row(chunk) for chunk in chunks] == [
            [10, 3, 1, 0],
            [11, 3, 1, 1],
            [12, 3, 1, 2],
        ]
        assert sizes == [3]

        # One environment has ended; the others continue, in the order of the client.
        messages.call(socket, "update_obs_batch", observations(2, 0))
        chunks = messages.call(socket, "get_action_batch", [0, 2])
        assert [first_row(chunk) for chunk in chunks] == [[10, 3, 2, 0], [12, 3, 2, 2]]

        # Without indices, the call is for the environments of the last update.
        messages.call(socket, "update_obs_batch", observations(2, 1))
        chunks = messages.call(socket, "get_action_batch")
        assert [first_row(chunk) for chunk in chunks] == [[12, 3, 3, 2], [11, 3, 2, 1]]
        assert len(engine.sessions) == 3

        messages.ask(socket, "reset", trial_id="trial")
        messages.call(socket, "update_obs_batch", observations(0, 1, 2))
        chunks = messages.call(socket, "get_action_batch", np.arange(3))
        assert [chunk[0]["actions"][2] for chunk in chunks] == [1, 1, 1]
    wait_for(lambda: len(engine.sessions) == 0)


def test_environments_of_several_messages_act_together(served: Served, messages: Messages) -> None:
    client, _, sizes = served

    def encoded(pixel: int, index: int) -> dict[str, Any]:
        file = jpeg_png.encode_png(np.full((8, 8, 3), pixel, np.uint8))
        vision = {"cam_head": {"color": file}}
        return xpolicylab_observation(0, env_idx=index) | {"vision": vision}

    with client.websocket_connect("/xpolicylab") as socket:
        messages.call(socket, "update_obs_batch", [encoded(10, 0), encoded(11, 1)])
        messages.call(socket, "update_obs", encoded(12, 2))
        chunks = messages.call(socket, "get_action_batch", [2, 0, 1])
    assert [first_row(chunk)[0] for chunk in chunks] == [12, 10, 11]
    assert sizes == [3]


def test_two_clients_get_their_own_actions(served: Served, messages: Messages) -> None:
    client = served[0]
    with (
        client.websocket_connect("/xpolicylab") as one,
        client.websocket_connect("/xpolicylab") as two,
    ):
        for acts in (1, 2, 3):
            messages.call(one, "update_obs", xpolicylab_observation(1))
            messages.call(two, "update_obs", xpolicylab_observation(2, "task 2"))
            assert first_row(messages.call(two, "get_action")) == [2, 3, acts, 2]
            assert first_row(messages.call(one, "get_action")) == [1, 3, acts, 1]


@pytest.mark.parametrize("generation", RECORDED)
def test_the_recorded_messages_of_a_client_get_their_answers(
    served: Served, generation: str
) -> None:
    """XPolicyLab's own WsModelClient sent these messages: two acts with an executed row between
    them, and a batch of two.
    """
    client, _, sizes = served
    rows, answered = [], []
    with client.websocket_connect("/xpolicylab") as socket:
        for message in RECORDED[generation]:
            sent = codec.decode(base64.b64decode(message), Budget(LIMITS))
            socket.send_bytes(base64.b64decode(message))
            if sent.kind == "close":
                break
            answer = codec.decode(socket.receive_bytes(), Budget(LIMITS))
            assert (answer.kind, answer.message_id) == (codec.ANSWERS[sent.kind], sent.message_id)
            assert answer.labels == sent.labels
            answered.append(answer.kind)
            result = answer.payload.get("actions", answer.payload.get("result"))
            if result is not None:
                chunks = result if isinstance(result[0], list) else [result]
                rows += [first_row(chunk) for chunk in chunks]
    assert answered[:3] == ["hello_ack", "prepare_case_ack", "reset_result"]
    assert answered[-1] == "trial_end_ack"
    assert rows == [[1, 6, 1, 1], [2, 6, 2, 1], [3, 6, 1, 2], [4, 6, 1, 3]]
    # The first generation sends the observations of a batch one after the other.
    assert sum(sizes) == 4


# Repeated messages


def test_a_repeated_act_is_answered_as_the_first_time(served: Served, messages: Messages) -> None:
    client, _, sizes = served
    with client.websocket_connect("/xpolicylab") as socket:
        first = messages.infer(socket, 7, message_id="lost")
    with client.websocket_connect("/xpolicylab") as socket:
        again = messages.infer(socket, 7, message_id="lost")
        assert first_row(again) == first_row(first)
        messages.call(socket, "update_obs", xpolicylab_observation(5))
        called = messages.call(socket, "get_action", message_id="called")
    with client.websocket_connect("/xpolicylab") as socket:
        # This connection has no observation, and the repeated message needs none.
        again = messages.call(socket, "get_action", message_id="called")
        assert first_row(again) == first_row(called)
    assert sizes == [1, 1]


def test_a_message_that_is_repeated_while_it_is_answered_waits_for_that_answer(
    messages: Messages, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent, gate = BatchedMirror(), tmp_path / "gate"
    observation = xpolicylab_observation(255, f"{gate} task 1")
    message = xpolicylab("infer", "lost", observation=observation)
    has_left = threading.Event()
    monkeypatch.setattr("vlagents_ray_dialects.xpolicylab.current_client", lambda: has_left.is_set)
    with serving(agent, SETTINGS) as (client, _), client.websocket_connect("/xpolicylab") as a:
        a.send_bytes(message)
        wait_for(lambda: agent.sizes == [1])
        has_left.set()
        answers: list[bytes] = []

        def repeat() -> None:
            with client.websocket_connect("/xpolicylab") as socket:
                socket.send_bytes(message)
                answers.append(socket.receive_bytes())

        repeating = threading.Thread(target=repeat)
        repeating.start()
        gate.touch()
        answers.append(a.receive_bytes())
        repeating.join()
    actions = [codec.decode(answer, Budget(LIMITS)).payload["actions"] for answer in answers]
    assert first_row(actions[0]) == first_row(actions[1])
    assert agent.sizes == [1]


@pytest.mark.parametrize("pixels", [(10, 20), (10, 10)], ids=["other pixels", "equal pixels"])
@pytest.mark.parametrize("called", [False, True], ids=["infer", "call"])
def test_two_clients_with_equal_names_get_their_own_actions(
    served: Served, messages: Messages, pixels: tuple[int, int], called: bool
) -> None:
    client, _, sizes = served

    def act(socket: Any, pixel: int, message_id: str) -> list[float]:
        if not called:
            return first_row(messages.infer(socket, pixel, message_id))
        messages.call(socket, "update_obs", xpolicylab_observation(pixel), f"u-{message_id}")
        return first_row(messages.call(socket, "get_action", message_id=message_id))

    with (
        client.websocket_connect("/xpolicylab") as red,
        client.websocket_connect("/xpolicylab") as blue,
    ):
        for step in range(3):
            for socket, pixel in ((red, pixels[0]), (blue, pixels[1])):
                assert act(socket, pixel + step, str(step)) == [pixel + step, 3, step + 1, 1]
        assert sizes == [1] * 6
        assert act(blue, pixels[1] + 2, "2")[0] == pixels[1] + 2
    assert sizes == [1] * 6, "a repeated message was executed"


def test_an_answer_is_of_one_trial_and_one_step(served: Served, messages: Messages) -> None:
    client, _, sizes = served
    labels = {
        "evaluation_id": "e",
        "action_case_id": "c",
        "trial_id": "t",
        "repeat_index": 0,
        "step": 0,
    }
    with client.websocket_connect("/xpolicylab") as socket:
        others: list[dict[str, Any]] = [{}]
        for name, value in labels.items():
            others.append({name: 5 if isinstance(value, int) else "other"})
        for pixel, other in enumerate(others):
            payload = {"observation": xpolicylab_observation(pixel)}
            frame = codec.Frame("infer", "1", {**labels, **other}, payload)
            socket.send_bytes(codec.encode(frame))
            answer = codec.decode(socket.receive_bytes(), Budget(LIMITS))
            assert first_row(answer.payload["actions"])[0] == pixel, other
    assert sizes == [1] * 6


def test_an_id_that_is_used_for_two_messages_is_an_error(
    served: Served, messages: Messages
) -> None:
    client, _, sizes = served
    with client.websocket_connect("/xpolicylab") as socket:
        messages.infer(socket, 7, "1")
        other = messages.ask(socket, "infer", "1", observation=xpolicylab_observation(8))
        assert error_of(other) == ("invalid_frame", "malformed")
        assert "message_id: expected a new id" in other.payload["message"]
        assert sizes == [1]
        # A reset begins the evaluation again, whose messages may have the same numbers.
        messages.ask(socket, "reset")
        assert first_row(messages.infer(socket, 8, "1"))[0] == 8
        messages.ask(socket, "reset")
        assert first_row(messages.infer(socket, 8, "1"))[0] == 8
    assert sizes == [1, 1, 1]


def test_a_message_that_failed_is_executed_when_it_is_repeated(
    served: Served, messages: Messages
) -> None:
    client, _, sizes = served
    with client.websocket_connect("/xpolicylab") as socket:
        failed = messages.ask(socket, "call", "m", func_name="get_action")
        assert error_of(failed) == ("call_failed", "invalid_observation")
        messages.call(socket, "update_obs", xpolicylab_observation(5))
        assert first_row(messages.call(socket, "get_action", message_id="m")) == [5, 3, 1, 1]
    assert sizes == [1]


def test_the_answers_of_a_key_are_not_those_of_another(messages: Messages) -> None:
    keys, agent = ChangingKeys(), BatchedMirror()
    headers = [{"authorization": f"Bearer {keys.add(name)}"} for name in ("one", "two")]
    with serving(agent, SETTINGS, keys.keys) as (client, _):
        for header, pixel in zip(headers, (1, 2), strict=True):
            with client.websocket_connect("/xpolicylab", headers=header) as socket:
                assert first_row(messages.infer(socket, pixel, "same"))[0] == pixel
    assert agent.sizes == [1, 1]


def test_old_answers_are_forgotten(
    served: Served, messages: Messages, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vlagents_ray_dialects.xpolicylab._KEPT_ANSWERS", 2)
    client, _, sizes = served
    with client.websocket_connect("/xpolicylab") as socket:
        for message_id in ("a", "b", "c", "c", "b", "a"):
            messages.infer(socket, 1, message_id)
    assert sizes == [1] * 4


# Errors


def test_errors_have_their_code_and_the_connection_stays(
    served: Served, messages: Messages
) -> None:
    with served[0].websocket_connect("/xpolicylab") as socket:
        observation = xpolicylab_observation(1)
        for kind, payload, codes in (
            ("jump", {}, ("unknown_message_type", "malformed")),
            ("hello_ack", {}, ("unknown_message_type", "malformed")),
            ("infer", {}, ("invalid_frame", "malformed")),
            ("infer", {"observation": [1]}, ("invalid_frame", "malformed")),
            (
                "infer",
                {"observation": observation | {"env_idx": -1}},
                ("invalid_frame", "malformed"),
            ),
            ("infer", {"observation": {"other": 1}}, ("infer_failed", "missing_camera")),
            ("call", {"func_name": "step", "obs": observation}, ("invalid_frame", "malformed")),
            ("call", {}, ("invalid_frame", "malformed")),
            ("call", {"func_name": np.zeros(2)}, ("invalid_frame", "malformed")),
            ("call", {"func_name": "update_obs"}, ("invalid_frame", "malformed")),
            (
                "call",
                {"func_name": "update_obs_batch", "obs": []},
                ("invalid_frame", "malformed"),
            ),
            (
                "call",
                {
                    "func_name": "update_obs_batch",
                    "obs": [observation, observation | {"env_idx": 0}],
                },
                ("invalid_frame", "malformed"),
            ),
            (
                "call",
                {"func_name": "get_action_batch", "obs": [0, 7]},
                ("call_failed", "invalid_observation"),
            ),
            (
                "call",
                {"func_name": "get_action_batch", "obs": "all"},
                ("invalid_frame", "malformed"),
            ),
        ):
            answer = messages.ask(socket, kind, **payload)
            assert error_of(answer) == codes, (kind, payload, answer.payload["message"])
        assert first_row(messages.infer(socket, 4)) == [4, 3, 1, 1]


def test_a_message_that_names_itself_is_told_what_is_wrong_with_it(served: Served) -> None:
    good = {
        "message_type": "heartbeat",
        "message_id": "m-1",
        "evaluation_id": "e",
        "payload": {},
    }
    with served[0].websocket_connect("/xpolicylab") as socket:
        for change, expected in (
            ({"payload": [1]}, "payload: expected a map"),
            ({"evaluation_id": None}, "evaluation_id: expected a text"),
            ({"message_type": None}, "message_type: expected one of"),
            ({"message_id": None}, "message_id: expected a text"),
            ({"message_id": "x" * 1000}, "ids of at most"),
            ({"step": "first"}, "expected whole numbers"),
        ):
            socket.send_bytes(pack(good | change, write_packed))
            answer = codec.decode(socket.receive_bytes(), Budget(LIMITS))
            assert answer.payload["code"] == "invalid_frame"
            assert expected in answer.payload["message"]
        for rubbish in (b"\xc1", b"\x90"):
            socket.send_bytes(rubbish)
            answer = codec.decode(socket.receive_bytes(), Budget(LIMITS))
            assert (answer.message_id, answer.payload["code"]) == ("", "invalid_frame")
        socket.send_bytes(pack(good, write_packed))
        assert codec.decode(socket.receive_bytes(), Budget(LIMITS)).kind == "heartbeat_ack"


def test_a_failing_policy_is_reported_without_its_traceback(messages: Messages) -> None:
    class Broken(Agent):
        def act(self, obs: Obs) -> Act:
            raise RuntimeError("/no/path/of/ours")

    with (
        serving(Broken(), SETTINGS) as (client, _),
        client.websocket_connect("/xpolicylab") as socket,
    ):
        answer = messages.ask(socket, "infer", observation=xpolicylab_observation(1))
        assert error_of(answer) == ("infer_failed", "policy_failed")
        messages.call(socket, "update_obs", xpolicylab_observation(1))
        answer = messages.ask(socket, "call", func_name="get_action")
        assert error_of(answer) == ("call_failed", "policy_failed")
        assert "Traceback" not in answer.payload["message"]


def test_a_key_over_its_rate_is_told_to_come_later(messages: Messages) -> None:
    keys = ChangingKeys()
    header = {"authorization": f"Bearer {keys.add('slow', rate=2)}"}
    with (
        serving(BatchedMirror(), SETTINGS, keys.keys) as (client, _),
        client.websocket_connect("/xpolicylab", headers=header) as socket,
    ):
        for _ in range(2):
            messages.infer(socket, 1)
        socket.send_bytes(xpolicylab("heartbeat"))
        answer = codec.decode(socket.receive_bytes(), Budget(LIMITS))
        assert error_of(answer) == ("internal", "too_many_requests")
        with pytest.raises(WebSocketDisconnect) as ended:
            socket.receive_bytes()
        assert ended.value.code == 1013


def test_each_environment_of_a_batch_counts_for_its_key(messages: Messages) -> None:
    keys, agent = ChangingKeys(), BatchedMirror()
    header = {"authorization": f"Bearer {keys.add('slow', rate=4)}"}
    observations = [xpolicylab_observation(1, env_idx=index) for index in range(4)]
    with (
        serving(agent, SETTINGS, keys.keys) as (client, _),
        client.websocket_connect("/xpolicylab", headers=header) as socket,
    ):
        messages.call(socket, "update_obs_batch", observations)
        answer = messages.ask(socket, "call", func_name="get_action_batch", obs=[0, 1, 2, 3])
        assert error_of(answer) == ("call_failed", "too_many_requests")
    assert agent.sizes == []


def test_an_observation_counts_as_in_flight_until_its_act(
    served: Served, messages: Messages
) -> None:
    client, engine, _ = served
    large = xpolicylab_observation(1, padding=np.zeros(100_000, np.uint8))
    in_flight = engine.admission
    with client.websocket_connect("/xpolicylab") as socket:
        messages.call(socket, "update_obs", large)
        assert in_flight.held >= 100_000
        messages.call(socket, "update_obs", xpolicylab_observation(1))
        assert in_flight.held < 100_000
        messages.call(socket, "get_action")
        wait_for(lambda: in_flight.held == 0)
        both = [large | {"env_idx": index} for index in range(2)]
        messages.call(socket, "update_obs_batch", both)
        messages.call(socket, "get_action_batch", [0])
        assert in_flight.held >= 200_000  # one of the message's observations is still waiting
        messages.call(socket, "get_action_batch", [1])
        wait_for(lambda: in_flight.held == 0)
        messages.call(socket, "update_obs", large)
    wait_for(lambda: in_flight.held == 0)


def test_a_connection_has_a_limit_of_environments(messages: Messages) -> None:
    with serving(BatchedMirror(), SETTINGS) as (client, engine):
        with client.websocket_connect("/xpolicylab") as socket:
            for index in range(LIMITS.requests):
                observation = xpolicylab_observation(1, env_idx=index)
                messages.call(socket, "update_obs", observation)
            observation["env_idx"] = LIMITS.requests
            answer = messages.ask(socket, "call", func_name="update_obs", obs=observation)
            assert error_of(answer) == ("invalid_frame", "too_large")
        assert len(engine.sessions) == 0


# Images and observations


def observed(camera: Any, **more: Any) -> dict[str, Any]:
    return codec.read_observation({"vision": {"cam_head": camera}, **more}, Budget(LIMITS))


def colours() -> np.ndarray:
    """Return an image whose channels differ."""
    pixels = np.zeros((16, 16, 3), np.uint8)
    pixels[:] = (200, 100, 20)
    return pixels


@pytest.mark.parametrize("form", ["bytes", "array", "padded"])
@pytest.mark.parametrize("key", ["color", "colors", "rgb", "image", None])
def test_an_image_may_be_a_file_that_says_whether_it_is_rgb(form: str, key: str | None) -> None:
    """XPolicyLab's `decode_image_bit` reverses the channels of a JPEG without its comment."""
    standard = jpeg_png.encode_jpeg(colours(), 95, "444")
    marked = standard[:2] + MARK + standard[2:]
    forms: dict[str, Any] = {
        "bytes": lambda file: file,
        "array": lambda file: np.frombuffer(file, np.uint8),
        "padded": lambda file: file + bytes(40),
    }
    for file, expected in ((marked, colours()), (standard, colours()[..., ::-1])):
        value = forms[form](file)
        camera = value if key is None else {key: value}
        image = observed(camera)["vision"]["cam_head"]["color"]
        assert np.abs(image.astype(int) - expected).max() < 8


def test_pixels_arrive_as_they_are() -> None:
    for camera in ({"color": colours()}, {"rgb": colours()}, colours()):
        assert np.array_equal(observed(camera)["vision"]["cam_head"]["color"], colours())


def test_of_several_instructions_the_first_counts() -> None:
    assert observed(colours(), instructions=["a", "b"])["instruction"] == "a"
    assert observed(colours(), instructions=["a"], instruction="c")["instruction"] == "c"
    assert "instruction" not in observed(colours(), instructions=[])


def test_images_have_the_limits_of_all_others() -> None:
    with pytest.raises(MalformedMessage, match="cam_head"):
        observed({"color": b"no picture"})
    small = Budget(MessageLimits(pixels=20))
    file = jpeg_png.encode_png(colours())
    with pytest.raises(MessageTooLarge):
        codec.read_observation({"vision": {"a": file}}, small)
    many = {f"cam_{index}": {"color": colours()} for index in range(LIMITS.cameras + 1)}
    with pytest.raises(MessageTooLarge, match="cameras"):
        codec.read_observation({"vision": many}, Budget(LIMITS))


def test_maps_with_indices_as_keys_are_read() -> None:
    frame = codec.Frame("call", "m", {"evaluation_id": "e"}, {"obs": {0: [1], 12: {"a": 2}}})
    assert codec.decode(codec.encode(frame), Budget(LIMITS)).payload == {
        "obs": {"0": [1], "12": {"a": 2}}
    }


# The id of the server


def test_all_replicas_have_one_id_which_changes_with_the_policy_and_the_cluster() -> None:
    def id_of(**metadata: Any) -> str:
        context = ReplicaContext(Engine(Mirror()), lambda: METADATA | metadata, LIMITS)
        config = XPolicyLabDialect.Config()
        return XPolicyLabDialect("xpolicylab", config, context).server_instance_id()

    assert id_of(cluster="a", devices=["cpu"]) == id_of(cluster="a", devices=["cuda:1"])
    ids = {id_of(cluster="a"), id_of(cluster="b"), id_of(cluster="a", checkpoint="other")}
    assert len(ids) == 3


def test_a_client_gets_the_id_when_it_connects(served: Served, messages: Messages) -> None:
    ids = set()
    for _ in range(2):
        with served[0].websocket_connect("/xpolicylab") as socket:
            ids.add(messages.ask(socket, "hello").payload["server_instance_id"])
    assert len(ids) == 1
