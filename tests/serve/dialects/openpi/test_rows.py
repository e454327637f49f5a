"""BEHAVIOR-1K's evaluation: its client gets one row at each step, in chunks if it asks for them, of stacked
environments too."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgpack
import numpy as np
import pytest
from dialect_server import serving
from pydantic import ValidationError
from served_agents import Mirror
from starlette.websockets import WebSocketDisconnect

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.serve.config.dialects import DialectArgs

ROBOT = "robot_r1::robot_r1:"
LIMIT = 4  # sessions of the server
MAPPING = {"preset": "behavior-r1pro", "instructions": {number: f"task {number}" for number in range(3)}}


class R1Pro(Mirror):
    """`Mirror` with the 23 numbers of an R1 Pro: pixel, sum of the state, inferences, the task's number, row, zeros."""

    contract = Contract(instruction=True, action=ActionSpec(dim=23, gripper_open=1.0, gripper_closed=0.0))

    def act(self, obs: Obs) -> Act:
        return Act(np.pad(super().act(obs).action, ((0, 0), (0, 16))))


def observation(pixel: int = 1, task: int = 1, size: int = 8) -> dict[str, Any]:
    """What its evaluator.py sends at c71025a: flat keys, RGBA, the task's number, no text."""
    image = np.full((size, size, 4), 255, np.uint8)
    image[:, :, :3] = pixel
    return {
        f"{ROBOT}zed_link:Camera:0::rgb": image,
        f"{ROBOT}left_realsense_link:Camera:0::rgb": image,
        f"{ROBOT}right_realsense_link:Camera:0::rgb": image,
        "robot_r1::proprio": np.eye(1, 61, dtype=np.float32)[0],
        "robot_r1::cam_rel_poses": np.zeros(21, np.float32),
        "task_id": np.array([task], np.int64),
    }


def stacked(*each: dict[str, Any]) -> dict[str, Any]:
    return {key: np.stack([one[key] for one in each]) for key in each[0]}


class EvaluationClient:
    """A double of `WebsocketClientPolicy` of its network_utils.py at c8a6cd8, over a socket that is open."""

    def __init__(self, socket: Any, chunk: int = 0) -> None:
        self.socket, self.chunk_size, self.asks = socket, chunk, chunk > 1
        self.messages = 0
        self.metadata = self.unpack(socket.receive_bytes())
        self.forget()

    @staticmethod
    def pack(value: Any) -> bytes:
        def array(one: np.ndarray) -> dict[bytes, Any]:
            return {b"__ndarray__": True, b"data": one.tobytes(), b"dtype": one.dtype.str, b"shape": one.shape}

        return msgpack.packb(value, default=array)

    @staticmethod
    def unpack(data: bytes) -> Any:
        def array(node: dict[Any, Any]) -> Any:
            if b"__ndarray__" not in node:
                return node
            return np.ndarray(buffer=node[b"data"], dtype=np.dtype(node[b"dtype"]), shape=node[b"shape"])

        return msgpack.unpackb(data, object_hook=array)

    def forget(self) -> None:
        self.rows, self.at = np.zeros((0, 0)), 0

    def reset(self) -> None:
        self.forget()
        self.socket.send_bytes(self.pack({"reset": True}))  # and waits for no reply

    def act(self, obs: dict[str, Any]) -> np.ndarray:
        if self.at < self.rows.shape[-2]:
            self.at += 1
            return self.rows[..., self.at - 1, :]
        self.socket.send_bytes(self.pack(obs | ({"__action_chunk_size__": self.chunk_size} if self.asks else {})))
        self.messages += 1
        answer = self.unpack(self.socket.receive_bytes())
        action = answer["action"]
        if self.asks and "action_chunk" in answer:
            self.rows, self.at = answer["action_chunk"], 1
            assert self.rows.shape == (*action.shape[:-1], self.chunk_size, action.shape[-1])
            assert np.array_equal(self.rows[..., 0, :], action)
        elif self.asks:
            self.asks = False
        return action


@contextmanager
def evaluation(
    rows: int = 3, chunk: int = 0, agent: Agent | None = None, **settings: Any
) -> Iterator[EvaluationClient]:
    dialects = {"openpi": {"mapping": MAPPING, "answer": "row", **settings}}
    with (
        serving(agent or R1Pro(chunk=rows), dialects, session_limit=LIMIT) as (client, _),
        client.websocket_connect("/") as socket,
    ):
        yield EvaluationClient(socket, chunk)


def played(action: np.ndarray) -> list[list[float]]:
    """The pixel, the inferences, the task and the row of an action, of each environment."""
    return np.atleast_2d(action)[:, [0, 2, 3, 4]].tolist()


def test_each_step_gets_the_next_row_and_the_policy_is_asked_when_none_is_left() -> None:
    with evaluation() as client:
        assert client.metadata["policy"] == "mirror"
        actions = [client.act(observation(pixel)) for pixel in range(5)]
        assert all(action.shape == (23,) and action.dtype == np.float32 for action in actions)
        assert [played(action)[0] for action in actions] == [
            [0, 1, 1, 0],
            [0, 1, 1, 1],
            [0, 1, 1, 2],
            [3, 2, 1, 0],
            [3, 2, 1, 1],
        ]
        assert actions[0][[14, 22]].tolist() == [-1, -1]  # the policy's closed gripper, 0, is -1 for the robot


def test_execute_limits_the_rows_of_each_chunk() -> None:
    with evaluation(execute=2) as client:
        assert [played(client.act(observation(1)))[0][1:] for _ in range(4)] == [
            [1, 1, 0],
            [1, 1, 1],
            [2, 1, 0],
            [2, 1, 1],
        ]


def test_a_reset_and_another_task_leave_out_the_rows_that_are_left() -> None:
    with evaluation() as client:
        client.act(observation(1))
        client.reset()
        assert played(client.act(observation(2)))[0] == [2, 1, 1, 0]
        assert played(client.act(observation(3, task=2)))[0] == [3, 1, 2, 0]
        assert played(client.act(observation(4, task=2)))[0] == [3, 1, 2, 1]


def test_a_client_that_asks_for_chunks_gets_as_many_rows_and_sends_a_message_for_each_chunk() -> None:
    with evaluation(rows=4, chunk=2) as client:
        actions = [played(client.act(observation(pixel)))[0] for pixel in range(6)]
        assert actions == [[0, 1, 1, 0], [0, 1, 1, 1], [0, 1, 1, 2], [0, 1, 1, 3], [4, 2, 1, 0], [4, 2, 1, 1]]
        assert client.messages == 3


def test_a_chunk_that_has_fewer_rows_is_got_row_by_row() -> None:
    with evaluation(rows=2, chunk=3) as client:
        assert [played(client.act(observation(7)))[0][1:] for _ in range(3)] == [[1, 1, 0], [1, 1, 1], [2, 1, 0]]
        assert client.messages == 3
        assert not client.asks


@pytest.mark.parametrize("chunk", [0, 2])
def test_stacked_environments_get_stacked_actions(chunk: int) -> None:
    with evaluation(rows=2, chunk=chunk) as client:
        both = stacked(observation(5, task=1), observation(6, task=2))
        assert played(client.act(both)) == [[5, 1, 1, 0], [6, 1, 2, 0]]
        assert client.act(both)[:, 4].tolist() == [1, 1]
        assert played(client.act(both)) == [[5, 2, 1, 0], [6, 2, 2, 0]]
        client.forget()
        alone = client.act(stacked(observation(7)))
        assert alone.shape == (1, 23)
        assert played(alone)[0][:3] == [7, 1, 1]


def test_an_environment_that_is_not_stacked_gets_no_row_of_stacked_ones() -> None:
    with evaluation() as client:
        assert played(client.act(observation(1))) == [[1, 1, 1, 0]]
        client.act(stacked(observation(2), observation(3)))
        assert played(client.act(observation(4))) == [[4, 2, 1, 0]]


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (observation(task=9), r"'prompt|task_id': got 9, want one of"),
        (observation() | {"__action_chunk_size__": 0}, "__action_chunk_size__: got 0"),
        (observation() | {"__action_chunk_size__": True}, "__action_chunk_size__: got True"),
        (observation() | {"__action_chunk_size__": np.zeros(9)}, "__action_chunk_size__"),
        (observation() | {"task_id": np.zeros((2, 1), np.int64)}, "want 2 environments"),
        (observation() | {"task_id": np.zeros((0, 1), np.int64)}, "want 1 to 4 environments"),
        ({"task_id": np.zeros((200_000, 1), np.uint8)}, "want 1 to 4 environments"),
        (observation() | {"task_id": np.array([0.5])}, "want text"),
        (observation() | {"robot_r1::proprio": np.zeros((2, 61))}, "robot_r1::proprio"),
        (observation() | {f"{ROBOT}zed_link:Camera:0::rgb": np.zeros((8, 8, 5), np.uint8)}, "zed_link"),
        ({"reset": 1}, "reset"),
        ({}, "zed_link"),
    ],
)
def test_garbage_is_a_text_then_1011(message: dict[str, Any], said: str) -> None:
    with evaluation() as client:
        client.socket.send_bytes(client.pack(message))
        text = client.socket.receive_text()
        assert said in text
        assert "Traceback" not in text
        with pytest.raises(WebSocketDisconnect) as closed:
            client.socket.receive_bytes()
        assert closed.value.code == 1011


def test_the_settings_are_closed() -> None:
    for settings in ({"answer": "rows"}, {"execute": 0}, {"mapping": MAPPING | {"instructions": {0: 1}}}):
        with pytest.raises(ValidationError):
            DialectArgs(openpi={"mapping": MAPPING, **settings})  # type: ignore[arg-type]


def test_a_policy_without_an_instruction_needs_no_texts() -> None:
    class Silent(R1Pro):
        contract = Contract(action=ActionSpec(dim=23))

        def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict:
            assert instruction is None
            assert obs.info["task_id"].tolist() == [5]
            return super().reset(obs, "task 0")

    with evaluation(agent=Silent(), mapping="behavior-r1pro") as client:
        assert played(client.act(observation(8, task=5))) == [[8, 1, 0, 0]]


def test_its_health_check_is_answered() -> None:
    with serving(R1Pro(), {"openpi": {"mapping": "behavior-r1pro"}}) as (client, _):
        assert client.get("/healthz").status_code == 200


def test_the_policy_gets_the_colours_without_alpha() -> None:
    class Colours(R1Pro):
        def act(self, obs: Obs) -> Act:
            assert {camera.shape for camera in obs.cameras.values()} == {(8, 8, 3)}
            assert all((camera == 9).all() for camera in obs.cameras.values())
            return super().act(obs)

    with evaluation(agent=Colours()) as client:
        client.act(observation(9))
