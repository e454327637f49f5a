"""Tests of openpi's and RoboArena's clients: sessions, `infer_batch` of openpi's pull request 941,
and `reset`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from dialect_server import ALL, call, image, libero, serving
from in_memory_keys import ChangingKeys
from served_agents import BatchedMirror, Mirror
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.config.dialects import DialectArgs
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray_dialects.messages import openpi

STATE = np.array([0, 0, 0, 0, 0, 1, 0.04, -0.04])


def batch(*tasks: tuple[int, str | None]) -> bytes:
    seen = [
        {
            "observation/image": image(p),
            "observation/wrist_image": image(0),
            "observation/state": STATE,
        }
        for p, _ in tasks
    ]
    return openpi.encode(
        {
            "batch": [
                one | ({"prompt": text} if text else {})
                for one, (_, text) in zip(seen, tasks, strict=True)
            ]
        }
    )


@pytest.fixture(name="served_batches")
def batches_served() -> Iterator[tuple[TestClient, Engine, list[int]]]:
    agent = BatchedMirror()
    with serving(agent, ALL) as (client, engine):
        yield client, engine, agent.sizes


def test_each_observation_of_a_batch_gets_its_own_answer(served_batches: Any) -> None:
    client, _, sizes = served_batches
    with client.websocket_connect("/openpi") as socket:
        socket.receive_bytes()
        asked = batch((7, "task 1"), (8, "task 2"), (9, "task 3"))
        for acts in (1, 2):
            said = call(socket, asked)
            # A row contains a pixel, the sum of the state, the session's number of acts, and the
            # number of its instruction.
            assert said["actions"].shape == (3, 2, 7)
            assert said["actions"][:, 0, :4].tolist() == [
                [7, 1, acts, 1],
                [8, 1, acts, 2],
                [9, 1, acts, 3],
            ]
        assert said["policy_timing"].keys() == {"infer_ms", "batch_size"}
        assert said["policy_timing"]["batch_size"] == 3
        assert said["server_timing"].keys() == {"infer_ms", "prev_total_ms"}
        assert sizes == [3, 3]
        assert call(socket, batch((7, None), (8, "task 5"), (9, None)))["actions"][
            :, 0, 2:4
        ].tolist() == [
            [3, 1],
            [1, 5],
            [3, 3],
        ]


def test_a_batch_does_not_disturb_the_session_of_single_observations(served_batches: Any) -> None:
    client, engine, _ = served_batches
    with client.websocket_connect("/openpi") as socket:
        socket.receive_bytes()
        for acts in (1, 2):
            assert call(socket, libero(1))["actions"][0, 2] == acts
            assert call(socket, batch((1, "task 1")))["actions"][:, 0, 2].tolist() == [acts]
        assert len(engine.sessions) == 2
    assert len(engine.sessions) == 0


def test_a_batch_of_another_size_ends_the_episodes_of_all_its_places(served_batches: Any) -> None:
    client, engine, _ = served_batches
    with client.websocket_connect("/openpi") as socket:
        socket.receive_bytes()
        for number, acts in ((3, 1), (3, 2), (2, 1), (2, 2), (4, 1)):
            said = call(socket, batch(*[(1, "task 1")] * number))["actions"]
            assert said[:, 0, 2].tolist() == [acts] * number
            assert len(engine.sessions) == number


def test_nothing_is_acted_on_if_one_observation_is_wrong(served_batches: Any) -> None:
    client, _, sizes = served_batches
    # The recorded bytes in tests/golden cover a single observation that is wrong.
    wrong = openpi.encode(
        {"batch": [{"observation/image": image(0), "observation/state": STATE, "prompt": "task 1"}]}
    )
    for asked, said in (
        (batch((1, "task 1"), (2, None)), "instruction"),
        (wrong, "observation/wrist_image"),
        (openpi.encode({"batch": []}), "expected a list of one observation or more"),
        (openpi.encode({"batch": np.zeros(3)}), "expected a list of one observation or more"),
        (openpi.encode({"batch": [1]}), "expected a map"),
        ("text", "binary"),
    ):
        with client.websocket_connect("/openpi") as socket:
            socket.receive_bytes()
            socket.send_text(asked) if isinstance(asked, str) else socket.send_bytes(asked)
            assert said in socket.receive_text()
            with pytest.raises(WebSocketDisconnect):
                socket.receive_bytes()
    assert sizes == []


def test_a_key_called_batch_beside_others_is_one_of_an_observation(served_batches: Any) -> None:
    client, *_ = served_batches
    with client.websocket_connect("/openpi") as socket:
        socket.receive_bytes()
        assert call(socket, libero(4, batch=np.zeros(2)))["actions"].shape == (2, 7)


def test_each_observation_of_a_batch_counts_for_its_key_before_any_is_acted_on() -> None:
    keys, agent = ChangingKeys(), BatchedMirror()
    # The rate also allows four requests at once.
    header = {"authorization": f"Bearer {keys.add('slow', rate=4)}"}
    ask = batch(*[(1, "task 1")] * 3)
    with (
        serving(agent, ALL, keys.keys) as (client, _),
        client.websocket_connect("/openpi", headers=header) as socket,
    ):
        socket.receive_bytes()
        assert call(socket, ask)["actions"].shape == (3, 2, 7)
        socket.send_bytes(ask)
        assert "requests a second" in socket.receive_text()
        assert agent.sizes == [3]


@pytest.mark.parametrize("answered", [False, True])
def test_a_reset_begins_the_next_episode_of_every_session(answered: bool) -> None:
    settings = {"openpi": {"mapping": "openpi-libero", "answer_reset": answered}}
    with (
        serving(BatchedMirror(), settings) as (client, _),
        client.websocket_connect("/openpi") as socket,
    ):
        socket.receive_bytes()
        for _ in range(2):
            assert call(socket, libero(1))["actions"][0, 2] == 1
            assert call(socket, batch((1, "task 1")))["actions"][0, 0, 2] == 1
            socket.send_bytes(openpi.encode({"reset": True}))
            if answered:
                assert openpi.decode(socket.receive_bytes()) == {"reset": True}


def test_a_sessions_end_is_its_connections(context: tuple[TestClient, Engine]) -> None:
    client, engine = context
    before = len(engine.sessions)
    with client.websocket_connect("/openpi") as one:
        one.receive_bytes()
        with client.websocket_connect("/openpi") as two:
            two.receive_bytes()
            for socket in (one, two):
                call(socket, libero(1))
            assert len(engine.sessions) == before + 2
        assert call(one, libero(1))["actions"][0, 2] == 2
    assert len(engine.sessions) == before


def test_openpi_and_roboarena_share_the_root(context: tuple[TestClient, Engine]) -> None:
    with context[0].websocket_connect("/") as socket:
        config = openpi.decode(socket.receive_bytes())
        assert config.keys() == {
            *(
                "image_resolution",
                "needs_wrist_camera",
                "n_external_cameras",
                "needs_stereo_camera",
            ),
            *("needs_session_id", "action_space"),
        }
        counts = [
            call(socket, libero(1, **more))["actions"][0, 2]
            for more in ({}, {}, *[{"endpoint": "infer"}] * 2)
        ]
        assert counts == [1, 2, 1, 2]
        socket.send_bytes(openpi.encode({"endpoint": "reset"}))
        assert socket.receive_text() == "reset successful"
        assert call(socket, libero(1, endpoint="infer"))["actions"][0, 2] == 1
        assert call(socket, libero(1, endpoint="infer", session_id="a"))["actions"][0, 2] == 2
        assert call(socket, libero(1, endpoint="infer", session_id="b"))["actions"][0, 2] == 1


def test_an_old_roboarena_client_gets_the_array_itself() -> None:
    with serving(
        Mirror(),
        {"roboarena": {"mapping": "openpi-libero", "bare": True, "action_space": "joint_position"}},
    ) as (
        client,
        _,
    ):
        with client.websocket_connect("/") as socket:
            socket.receive_bytes()
            socket.send_bytes(libero(3, endpoint="infer"))
            data = socket.receive_bytes()
        assert openpi.decode(openpi.encode({"": 0})[:-1] + data)[""].shape == (1, 7)


def test_the_mapping_names_the_actions_of_a_reply_as_a_client_reads_them() -> None:
    mapping = {"preset": "openpi-libero", "action": {"arm": {"stop": 6}, "hand": {"start": 6}}}
    with (
        serving(Mirror(), {"openpi": {"mapping": mapping}}) as (client, _),
        client.websocket_connect("/") as socket,
    ):
        socket.receive_bytes()
        answer = call(socket, libero(3))
        assert (answer["arm"].shape, answer["hand"].shape) == ((1, 6), (1, 1))
        assert answer.keys() == {"arm", "hand", "policy_timing", "server_timing"}
        batched = call(
            socket, openpi.encode({"batch": [openpi.decode(libero(3)), openpi.decode(libero(5))]})
        )
        assert batched["arm"][:, 0, 0].tolist() == [3, 5]


def test_a_session_that_was_forgotten_begins_again(context: tuple[TestClient, Engine]) -> None:
    client, engine = context
    with client.websocket_connect("/openpi") as socket:
        socket.receive_bytes()
        call(socket, libero(1))
        for session in engine.sessions.ids():
            engine.sessions.close(session)
        assert call(socket, libero(1))["actions"][0, 2] == 1


# The first message of RoboArena's server

DROID = Contract(
    cameras={name: CameraSpec(180, 320) for name in ("front", "front_2")},
    state={"joints": StateSpec(7)},
    action=ActionSpec(dim=8, space="joint_velocity"),
)
ANNOUNCED: dict[str, tuple[Contract, dict[str, Any]]] = {
    "the space": (DROID, {"action_space": "joint_velocity"}),
    "another space": (
        replace(DROID, action=ActionSpec(space="ee_pose")),
        {"action_space": "cartesian_position"},
    ),
    "two cameras": (DROID, {"n_external_cameras": 2, "needs_wrist_camera": False}),
    "a wrist camera": (
        replace(DROID, cameras={"wrist": CameraSpec()}),
        {"n_external_cameras": 0, "needs_wrist_camera": True},
    ),
    "sizes": (DROID, {"image_resolution": [180, 320]}),
}


@pytest.mark.parametrize(("contract", "expected"), ANNOUNCED.values(), ids=ANNOUNCED)
def test_roboarena_is_told_what_the_contract_declares(
    contract: Contract, expected: dict[str, Any]
) -> None:
    class Declared(Mirror):
        pass

    Declared.contract = contract
    with serving(Declared(), {"roboarena": {}}) as (client, _):
        args = DialectArgs(roboarena={})  # type: ignore[arg-type]
        args.require_fit(contract)
        DialectArgs(**args.model_dump()).require_fit(contract)  # as a replica receives it
        with client.websocket_connect("/roboarena") as socket:
            first = openpi.decode(socket.receive_bytes())
    assert {name: first[name] for name in expected} == expected


CONTRADICTIONS: dict[str, tuple[dict[str, Any], Contract | None, str]] = {
    "a space": ({"action_space": "joint_position"}, DROID, "action_space: expected joint_velocity"),
    "a size": ({"image_resolution": (224, 224)}, DROID, r"image_resolution: expected \[180, 320\]"),
    "a wrist camera": ({"needs_wrist_camera": True}, DROID, "needs_wrist_camera: expected False"),
    "a camera": ({"n_external_cameras": 1}, DROID, "n_external_cameras: expected 2"),
    "no space": ({}, Contract(), "action_space: expected the meaning"),
    "no contract": ({}, None, "action_space: expected the meaning"),
    "relative joints": (
        {"action_space": "joint_position"},
        Contract(action=ActionSpec(space="joint", delta=True)),
        "got relative actions of the space 'joint'",
    ),
    "another space": (
        {},
        Contract(action=ActionSpec(space="ee_position")),
        "got absolute actions of the space 'ee_position'",
    ),
    "three cameras": (
        {},
        replace(DROID, cameras={name: CameraSpec() for name in ("a", "b", "c")}),
        "cameras: expected up to two external cameras",
    ),
    "two sizes": (
        {},
        replace(DROID, cameras={"front": CameraSpec(180, 320), "wrist": CameraSpec(224, 224)}),
        "image_resolution: expected one size",
    ),
}


@pytest.mark.parametrize(
    ("settings", "contract", "expected"), CONTRADICTIONS.values(), ids=CONTRADICTIONS
)
def test_settings_of_roboarena_that_contradict_the_contract_are_refused(
    settings: dict[str, Any], contract: Contract | None, expected: str
) -> None:
    with pytest.raises(ConfigError, match=expected):
        DialectArgs(roboarena=settings).require_fit(contract)  # type: ignore[arg-type]
