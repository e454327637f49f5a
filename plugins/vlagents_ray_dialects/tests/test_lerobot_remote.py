"""Tests of LeRobot's remote inference over Zenoh: many robots at one instance, their sessions, and
rejected requests.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from eval_fakes import wait_for
from in_process_replicas import Replicas
from PIL import Image

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract
from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.noop import Noop, NoopConfig
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.dialects.base import GatewayContext
from vlagents_ray.serve.ports import free_port, reserve
from vlagents_ray_dialects.lerobot_remote import (
    LeRobotRemoteDialect,
    LeRobotRemoteDialectConfig,
)
from vlagents_ray_dialects.messages import lerobot_remote as messages
from vlagents_ray_dialects.messages.lerobot_remote import Envelope

pytest.importorskip("zenoh")
from remote_robot import (
    ACTION,
    FRONT,
    SETTINGS,
    STATE,
    RemoteRobot,
    on_wire,
    rgb,
)

Open = Callable[..., int]


@pytest.fixture
def open_remote(open_dialect: Any) -> Open:
    return partial(open_dialect, "lerobot_remote", **SETTINGS)


def sessions(replicas: Replicas) -> int:
    return len(replicas.engines[0].sessions)


def first_row(answer: Envelope) -> list[float]:
    assert answer.message_type == "action", answer
    row: list[float] = answer.body["canonical_actions"][0].tolist()
    return row


def error_of(answer: Envelope) -> tuple[str, str]:
    assert answer.message_type == "error", answer
    return answer.body["code"], answer.body["message"]


def test_two_robots_act_at_one_instance_each_in_its_own_session(
    open_remote: Open, replicas: Replicas
) -> None:
    port = open_remote()
    with RemoteRobot(port) as red, RemoteRobot(port) as blue:
        assert red.instance_id == blue.instance_id
        red.begin(), blue.begin()
        # A row contains a pixel, the first number of the state, -1 for no gripper, the length of
        # the task, and the number of the act.
        assert first_row(red.act(10)) == [10, 0.5, -1, 3, 1]
        assert first_row(blue.act(20, "abcd")) == [20, 0.5, -1, 4, 1]
        assert first_row(red.act(11)) == [11, 0.5, -1, 3, 2]
        assert sessions(replicas) == 2
        assert red.control("close").message_type == "ack"
        wait_for(lambda: sessions(replicas) == 1)
        assert first_row(blue.act(21, "abcd")) == [21, 0.5, -1, 4, 2]


def test_an_action_repeats_what_the_robot_said_of_its_observation(open_remote: Open) -> None:
    with RemoteRobot(open_remote()).begin() as robot:
        answer = robot.act(1, observation_cursor=4, cursor=6)
        assert {name: answer.body[name] for name in messages.IDENTITY} == {
            "artifact_identity": "so101",
            "observation_id": "o1",
            "capture_time": 12.5,
            "task": "abc",
            "task_version": 3,
        }
        assert (answer.body["observation_cursor"], answer.body["cursor"]) == (4, 6)
        actions = answer.body["canonical_actions"]
        assert (actions.shape, actions.dtype) == ((2, 5), np.float32)
        assert answer.body["execution_steps"] == 2
        assert answer.body["model_actions"] is None
        assert "cursor" in robot.act(1).body
        assert "observation_cursor" not in robot.act(1).body


def test_a_reset_and_another_task_begin_an_episode_and_an_invalidation_does_not(
    open_remote: Open,
) -> None:
    with RemoteRobot(open_remote()).begin() as robot:
        acts = [first_row(robot.act(1))[4] for _ in range(2)]
        assert robot.control("invalidate", 1).body["applied_generation"] == 1
        acts.append(first_row(robot.act(1))[4])
        assert robot.control("reset", 2).body == {"operation": "reset", "applied_generation": 2}
        acts.append(first_row(robot.act(1))[4])
        acts.append(first_row(robot.act(1, "another"))[4])
        assert acts == [1, 2, 3, 1, 1]
        status = robot.control("status").body["session"]
        assert status == {"owner": robot.session_id, "client_present": True}


def test_images_may_be_jpeg(open_remote: Open) -> None:
    file = io.BytesIO()
    Image.fromarray(np.full((8, 8, 3), 128, np.uint8)).save(file, "JPEG", quality=95)
    jpeg = {"encoding": "jpeg", "data": file.getvalue()}
    features = {
        FRONT["name"]: rgb(np.zeros((8, 8, 3), np.uint8), **jpeg),
        STATE["name"]: np.array([0.5, 1, 2], np.float32),
    }
    with RemoteRobot(open_remote()).begin(encoding="jpeg") as robot:
        assert abs(first_row(robot.act(0, features=features))[0] - 128) <= 1


def test_a_connection_has_one_session_and_the_newest_question_begins_it(
    open_remote: Open, replicas: Replicas
) -> None:
    with RemoteRobot(open_remote()) as robot:
        robot.begin()
        assert first_row(robot.act(1))[4] == 1
        ids = [robot.session_id, *(robot.open("q-1").session_id for _ in range(2))]
        assert len(set(ids)) == 3
        wait_for(lambda: sessions(replicas) == 0)
        robot.begin()
        assert first_row(robot.act(1))[4] == 1


ALIGNED: dict[str, tuple[list[str], dict[str, Any]]] = {
    "version 1": (
        ["chunk_alignment_v1"],
        {"blend_steps": 0, "blend_weight": 0.5, "blend_components": []},
    ),
    "version 1, blended by the robot": (
        ["chunk_alignment_v1", "chunk_blending_v1"],
        {"blend_steps": 2, "blend_weight": 0.5, "blend_components": ["a"]},
    ),
    "version 2": (["chunk_alignment_v2"], {}),
}


@pytest.mark.parametrize(("required", "more"), ALIGNED.values(), ids=ALIGNED)
def test_aligned_chunks_are_agreed_on_in_both_versions(
    open_remote: Open, required: list[str], more: dict[str, Any]
) -> None:
    settings = {"chunk_merge": "aligned", **more}
    with RemoteRobot(open_remote()).begin(
        chunk_settings=settings, required_capabilities=required
    ) as robot:
        assert robot.accepted.body["chunk_settings"] == settings
        answer = robot.act(1, observation_cursor=4, cursor=6)
        assert (answer.body["observation_cursor"], answer.body["cursor"]) == (4, 6)
        for cursors in ((5, 4), (-1, 0), (None, 4), (True, 4), (0, 2**63)):
            observed, requested = cursors
            answer = robot.act(1, observation_cursor=observed, cursor=requested)
            code, message = error_of(answer)
            assert (code, "observation_cursor, cursor" in message) == ("malformed", True), cursors
        assert robot.act(1, observation_cursor=4, cursor=4).message_type == "action"


REFUSED: dict[str, tuple[dict[str, Any], str, str]] = {
    "another artifact": ({"expected_artifact": "other"}, "incompatible", "expected_artifact"),
    "another order": (
        {"features": [on_wire(STATE), on_wire(FRONT)]},
        "incompatible",
        "features",
    ),
    "other semantics of a feature": (
        {"features": [on_wire(FRONT), on_wire(STATE | {"semantics": "rad"})]},
        "incompatible",
        "features",
    ),
    "another action": (
        {"action_feature": on_wire(ACTION | {"shape": [6]})},
        "incompatible",
        "action_feature",
    ),
    "other semantics": ({"semantics": "rad"}, "incompatible", "semantics"),
    "another rate": ({"action_interval": 0.2}, "incompatible", "action_interval: expected 0.1 s"),
    "a rate that is no number": ({"action_interval": "0.1"}, "incompatible", "action_interval"),
    "a mode that the policy cannot": (
        {"mode": "rtc_guided"},
        "unsupported",
        "mode: expected one of ['chunk'], which the policy can, got 'rtc_guided'",
    ),
    "another encoding": ({"encoding": "png"}, "unsupported", "encoding: expected raw or jpeg"),
    "settings that are no map": (
        {"chunk_settings": 3},
        "malformed",
        "chunk_settings: expected a map",
    ),
    "an unknown ability": (
        {"required_capabilities": ["telepathy"]},
        "unsupported",
        "required_capabilities",
    ),
    "abilities that are no list": (
        {"required_capabilities": {"a": 1}},
        "unsupported",
        "required_capabilities",
    ),
    "aligned chunks without the ability": (
        {"chunk_settings": {"chunk_merge": "aligned"}},
        "incompatible",
        "chunk_merge 'aligned' together with",
    ),
    "the ability without aligned chunks": (
        {"required_capabilities": ["chunk_alignment_v2"]},
        "incompatible",
        "chunk_merge 'aligned' together with",
    ),
}


def test_a_robot_that_does_not_fit_is_told_what_differs(
    open_remote: Open, replicas: Replicas, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vlagents_ray_dialects.lerobot_remote._OPENS_AT_ONCE", 100)
    with RemoteRobot(open_remote()) as robot:
        for name, (changes, code, expected) in REFUSED.items():
            got, message = error_of(robot.open(**changes))
            assert (got, expected in message) == (code, True), (name, got, message)
        robot.instance_id = "0" * 32
        code, message = error_of(robot.open())
        assert code == "stale"
        assert "started again" in message
        assert sessions(replicas) == 0


def changed(feature: str, value: Any) -> dict[str, Any]:
    """Return the features of an observation, with one feature replaced."""
    features = {
        FRONT["name"]: rgb(np.zeros((8, 8, 3), np.uint8)),
        STATE["name"]: np.array([0.5, 1, 2], np.float32),
    }
    return {"features": features | {feature: value}}


FAULTY: dict[str, tuple[dict[str, Any], str, str]] = {
    "an old sequence": ({"sequence": 1}, "stale", "sequence"),
    "no sequence": ({"sequence": None}, "stale", "sequence"),
    "another artifact": ({"artifact_identity": "x"}, "incompatible", "artifact_identity"),
    "no task": ({"task": 3}, "malformed", "task"),
    "no features": ({"features": 3}, "malformed", "features: expected a map"),
    "a missing feature": ({"features": {}}, "incompatible", "observation.images.front"),
    "one too many": (changed("observation.images.top", 1), "incompatible", "features"),
    "another type": (
        changed(STATE["name"], np.zeros(3)),
        "incompatible",
        "observation.state: expected float32 [3]",
    ),
    "another length": (changed(STATE["name"], np.zeros(4, np.float32)), "incompatible", "float32"),
    "no array": (changed(STATE["name"], [1, 2, 3]), "incompatible", "observation.state"),
    "a wrong size": (
        changed(FRONT["name"], rgb(np.zeros((9, 8, 3), np.uint8))),
        "incompatible",
        "uint8 [8, 8, 3]",
    ),
    "too few bytes": (
        changed(FRONT["name"], rgb(np.zeros((8, 8, 3), np.uint8), data=b"x")),
        "malformed",
        "192 bytes",
    ),
    "an order of BGR": (
        changed(FRONT["name"], rgb(np.zeros((8, 8, 3), np.uint8), channel_order="BGR")),
        "malformed",
        "RGB",
    ),
    "no JPEG": (
        changed(FRONT["name"], rgb(np.zeros((8, 8, 3), np.uint8), encoding="jpeg")),
        "malformed",
        "front",
    ),
    "no finite number": (
        changed(STATE["name"], np.array([np.nan, 0, 0], np.float32)),
        "malformed",
        "finite",
    ),
}


def test_a_faulty_observation_is_answered_and_the_session_goes_on(open_remote: Open) -> None:
    with RemoteRobot(open_remote()).begin() as robot:
        assert first_row(robot.act(1))[4] == 1
        for name, (changes, code, expected) in FAULTY.items():
            robot.send(1, **changes)
            answer = robot.answers.get(timeout=20)
            assert answer.message_type == "error", name
            got, message = error_of(answer)
            assert (got, expected in message) == (code, True), (name, got, message)
        robot.publish("obs", b"\xc1 rubbish")
        assert error_of(robot.answers.get(timeout=20))[0] == "malformed"
        # This observation has a generation that the server has not acknowledged.
        robot.generation = 7
        assert error_of(robot.act(1))[0] == "stale"
        robot.generation = 0
        assert first_row(robot.act(1))[4] == 2


def test_a_question_is_refused_as_the_deployment_has_no_words(open_remote: Open) -> None:
    with RemoteRobot(open_remote()).begin() as robot:
        question = Envelope(
            "language_request", robot.instance_id, robot.session_id, 0, "q1", {"text": "what?"}
        )
        robot.publish("language/request", messages.encode(question))
        code, message = error_of(robot.answers.get(timeout=20))
        assert (code, "actions only" in message) == ("unsupported", True)


def test_the_session_of_a_robot_that_is_gone_ends_and_a_silent_one_stays(
    open_remote: Open, replicas: Replicas
) -> None:
    port = open_remote(idle_s=1.0)
    with RemoteRobot(port).begin() as silent:
        gone = RemoteRobot(port).begin()
        assert first_row(gone.act(1))[4] == 1
        assert first_row(silent.act(1))[4] == 1
        assert sessions(replicas) == 2
        gone.leave()
        wait_for(lambda: sessions(replicas) == 1)
        assert first_row(silent.act(1))[4] == 2


def test_a_robot_learns_that_the_server_ends(replicas: Replicas) -> None:
    def connect(_key: str | None, priority: Any) -> Any:
        return replicas.agent(priority=priority or "robot")

    config = LeRobotRemoteDialectConfig(port=free_port(), **SETTINGS)
    context = GatewayContext("noop", connect, messages.DEFAULT_LIMITS, 8, 30.0, None, NoKey.OPEN)
    dialect = LeRobotRemoteDialect("lerobot_remote", config, context)
    dialect.serve(reserve("lerobot_remote", "127.0.0.1", config.port))
    with RemoteRobot(config.port).begin() as robot:
        assert first_row(robot.act(1))[4] == 1
        assert robot.presence.get(timeout=20) is True
        dialect.close()
        assert not dialect.alive()
        assert robot.presence.get(timeout=20) is False
        assert sessions(replicas) == 0


def test_the_documented_settings_serve_the_robot_that_they_describe() -> None:
    page = (Path(__file__).parents[3] / "docs" / "clients" / "lerobot.md").read_text()
    [block] = re.findall(r"```yaml\n( +dialects:\n +lerobot_remote:.*?)```", page, re.DOTALL)
    settings = yaml.safe_load(block)["dialects"]["lerobot_remote"]
    robot_features = settings["features"]

    policy = Noop(NoopConfig(action_dim=6, chunk=50))
    replicas = Replicas([policy])
    config = LeRobotRemoteDialectConfig(**{**settings, "port": free_port()})
    context = GatewayContext(
        "noop",
        lambda _key, _priority: replicas.agent(),
        messages.DEFAULT_LIMITS,
        8,
        30.0,
        policy.contract,
        NoKey.OPEN,
    )
    dialect = LeRobotRemoteDialect("lerobot_remote", config, context)
    dialect.serve(reserve("lerobot_remote", "127.0.0.1", config.port))
    try:
        with RemoteRobot(config.port, settings["deployment"]).begin(
            features=[on_wire(feature) for feature in robot_features],
            action_feature=on_wire(settings["action"]),
            semantics=settings["semantics"],
            action_interval=1 / 30,
        ) as robot:
            seen = {
                "observation.images.front": rgb(np.zeros((480, 640, 3), np.uint8)),
                "observation.state": np.zeros(6, np.float32),
            }
            answer = robot.act(0, features=seen)
            assert answer.body["canonical_actions"].shape == (50, 6)
    finally:
        dialect.close()
        replicas.close()


NEEDS = Contract(cameras={"wrist": CameraSpec()}, chunk=2, control_hz=10, action=ActionSpec(dim=5))


@pytest.mark.parametrize(
    ("changes", "contract", "expected"),
    [
        ({"deployment": "a/b"}, None, "deployment"),
        ({"steps": None}, None, "steps: expected a value"),
        ({"fps": None}, None, "fps: expected a value"),
        ({"steps": 3}, NEEDS, "steps: expected at most 2"),
        ({"action": ACTION | {"shape": [6]}}, NEEDS, "a float32 vector of 5 numbers"),
        ({}, NEEDS, "expected the camera ['wrist']"),
        ({"features": [STATE | {"name": "joints"}]}, None, "the mapping cannot read them"),
    ],
)
def test_settings_that_contradict_the_policy_fail_at_the_start(
    changes: dict[str, Any], contract: Contract | None, expected: str
) -> None:
    config = LeRobotRemoteDialectConfig(**{**SETTINGS, **changes})
    context = GatewayContext("noop", None, messages.DEFAULT_LIMITS, 8, 30.0, contract, NoKey.OPEN)  # type: ignore[arg-type]
    with pytest.raises(ConfigError) as raised:
        LeRobotRemoteDialect("lerobot_remote", config, context)
    assert expected in str(raised.value)
