"""Tests of LeRobot's remote inference over Zenoh with robots that continue their plans (real-time
chunking).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, ClassVar

import numpy as np
import pytest
from dialect_situations import REMOTE_SETTINGS
from in_process_replicas import Replicas

from tests.golden.lines import RemoteInferenceLine, remote_messages
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.interface import DELAY, GIVEN, LEFTOVER, Act, Agent, Obs
from vlagents_ray_dialects.messages import lerobot_remote as messages
from vlagents_ray_dialects.messages.lerobot_remote import Envelope

pytest.importorskip("zenoh")
from remote_robot import ACTION, SETTINGS, RemoteRobot, on_wire

ROWS, LONGEST = 6, 2
CONTRACT = Contract(
    action=ActionSpec(dim=2, gripper_open=1.0, gripper_closed=0.0), control_hz=10, chunk=ROWS
)
# The client's gripper is open at 100, which the policy calls 1.
PERCENT = {"preset": "lerobot", "action_gripper": {"index": 1, "open": 100.0, "closed": 0.0}}
ARM = ACTION | {"shape": [2], "names": ["joint", "gripper"]}
GUIDED = {"contract": CONTRACT, "continues_plans": True}
TRAINED = GUIDED | {"longest_prefix": LONGEST}

Open = Callable[..., int]


class Counting(Agent):
    """A policy whose first joint continues the count of the plan, or begins at 100 times the number
    of the act. The other columns are 0.5.
    """

    given: ClassVar[list[dict[str, Any]]] = []  # the plan in each act

    def __init__(self, width: int) -> None:
        self.width = width

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict[str, Any]:
        self.acts = 0
        return {}

    def act(self, obs: Obs) -> Act:
        self.acts += 1
        self.given.append({name: obs.info[name] for name in (LEFTOVER, DELAY) if name in obs.info})
        plan = obs.info.get(LEFTOVER)
        first = 100.0 * self.acts if plan is None else plan[0, 0]
        rows = np.full((ROWS, self.width), 0.5, np.float32)
        rows[:, 0] = first + np.arange(ROWS)
        return Act(rows, info={} if plan is None else {GIVEN: obs.info[DELAY]})


@pytest.fixture(name="replicas")
def one_counting_replica(request: pytest.FixtureRequest) -> Iterator[Replicas]:
    Counting.given.clear()
    replicas = Replicas([Counting(getattr(request, "param", 2))])
    yield replicas
    replicas.close()


@pytest.fixture
def open_arm(open_dialect: Any) -> Open:
    settings = SETTINGS | {"mapping": PERCENT, "action": ARM, "steps": 2}
    return partial(open_dialect, "lerobot_remote", **settings)


def begin(port: int, mode: str, **changes: Any) -> RemoteRobot:
    return RemoteRobot(port).begin(mode=mode, action_feature=on_wire(ARM), **changes)


def continue_plan(robot: RemoteRobot, plan: Any, canonical: Any, delay: int) -> Envelope:
    """Send an observation of a robot that has these rows left, and return the answer."""
    return robot.act(7, model_continuation=plan, canonical_continuation=canonical, delay=delay)


OFFERED: dict[str, tuple[dict[str, Any], list[str], int, int]] = {
    "no plans": ({"contract": CONTRACT}, ["chunk"], 0, 0),
    "guided": (GUIDED, ["chunk", "rtc_guided"], 0, ROWS),
    "trained": (TRAINED, ["chunk", "rtc_trained"], LONGEST, ROWS),
}


@pytest.mark.parametrize(
    ("policy", "modes", "longest", "horizon"), OFFERED.values(), ids=list(OFFERED)
)
def test_a_mode_is_offered_if_the_policy_declares_its_ability(
    open_arm: Open, policy: dict[str, Any], modes: list[str], longest: int, horizon: int
) -> None:
    with RemoteRobot(open_arm(policy=policy)) as robot:
        offered = robot.descriptor["capabilities"]
        assert offered["modes"] == modes
        assert (offered["training_max_delay"], offered["rtc_horizon"]) == (longest, horizon)
        assert (offered["prediction_steps"], offered["execution_steps"]) == (ROWS, 2)
        for mode in ("rtc_guided", "rtc_trained"):
            answer = robot.open(mode=mode, action_feature=on_wire(ARM))
            if mode in modes:
                assert answer.message_type == "accepted"
                assert answer.body["mode"] == mode
            else:
                assert answer.body["code"] == "unsupported"
                assert str(modes) in answer.body["message"]


@pytest.mark.parametrize(("mode", "policy"), [("rtc_guided", GUIDED), ("rtc_trained", TRAINED)])
def test_a_robot_continues_its_plan(open_arm: Open, mode: str, policy: dict[str, Any]) -> None:
    with begin(open_arm(policy=policy), mode) as robot:
        answer = robot.act(7)
        model, canonical = answer.body["model_actions"], answer.body["canonical_actions"]
        # The whole chunk is sent in both spaces, the policy's and the robot's.
        assert answer.body["execution_steps"] == ROWS
        assert model[:, 0].tolist() == [100, 101, 102, 103, 104, 105]
        assert (model[0, 1], canonical[0, 1]) == (0.5, 50)
        assert model.dtype == canonical.dtype == np.float32

        answer = continue_plan(robot, model[2:], canonical[2:], 2)
        assert answer.body["model_actions"][:, 0].tolist() == [102, 103, 104, 105, 106, 107]
        assert Counting.given[0] == {}
        np.testing.assert_equal(Counting.given[1], {LEFTOVER: model[2:], DELAY: 2})

        # Another task begins an episode, and the robot's motion continues without a jump.
        robot.act(7, "another", model_continuation=model[4:], delay=1)
        np.testing.assert_equal(Counting.given[2], {LEFTOVER: model[4:], DELAY: 1})


def test_a_chunk_that_is_no_plan_is_short_and_the_robots_rows_are_ignored(open_arm: Open) -> None:
    with begin(open_arm(policy=GUIDED), "chunk") as robot:
        answer = continue_plan(robot, np.ones((3, 2), np.float32), None, 1)
        assert answer.body["model_actions"] is None
        assert answer.body["canonical_actions"].tolist() == [[100, 50], [101, 50]]
        assert Counting.given == [{}]


@pytest.mark.parametrize("replicas", [7], indirect=True)
def test_the_plan_that_lerobots_own_client_sends_is_read(open_dialect: Any) -> None:
    policy = {"continues_plans": True}
    line = RemoteInferenceLine(open_dialect("lerobot_remote", policy=policy, **REMOTE_SETTINGS))
    sent = remote_messages()
    answers = []
    try:
        for end, name in (
            (b"describe", "describe"),
            (b"open", "open guided"),
            (b"control", "reset guided"),
            (b"obs", "observation guided"),
            (b"obs", "observation with a plan"),
            (b"control", "close guided"),
        ):
            line.send(end, [sent[name]])
            answers.append(messages.decode(line.receive()[1]))
    finally:
        line.close()

    kinds = [answer.message_type for answer in answers]
    assert kinds == ["descriptor", "accepted", "ack", "action", "action", "ack"]
    assert answers[1].body["mode"] == "rtc_guided"
    assert [given.get(DELAY) for given in Counting.given] == [None, 1]
    np.testing.assert_equal(Counting.given[1][LEFTOVER], np.full((2, 7), 0.5, np.float32))
    assert answers[4].body["model_actions"][:, 0].tolist() == [0.5, 1.5]


@pytest.mark.parametrize("version", ["open aligned", "open aligned, version 1", "open append"])
@pytest.mark.parametrize("replicas", [7], indirect=True)
def test_lerobots_own_client_of_both_versions_is_served(open_dialect: Any, version: str) -> None:
    line = RemoteInferenceLine(open_dialect("lerobot_remote", **REMOTE_SETTINGS))
    sent = remote_messages()
    name = "observation append" if version == "open append" else "observation aligned"
    answers = []
    try:
        line.send(b"open", [sent[version]])
        answers.append(messages.decode(line.receive()[1]))
        # The robot sends an observation before it resets its session.
        for end, message in ((b"obs", sent[name]), (b"control", sent["reset aligned"])):
            line.send(end, [message])
            answers.append(messages.decode(line.receive()[1]))
        line.send(b"obs", [sent[name]])
        answers.append(messages.decode(line.receive()[1]))
    finally:
        line.close()

    assert [answer.message_type for answer in answers] == ["accepted", "error", "ack", "action"]
    assert answers[1].body["code"] == "stale"
    assert "expected a reset" in answers[1].body["message"]
    asked = messages.decode(sent[version]).body
    assert answers[0].body.get("chunk_settings") == asked.get("chunk_settings")


def rows(number: int, width: int = 2, dtype: Any = np.float32) -> np.ndarray:
    return np.ones((number, width), dtype)


FAULTY: dict[str, tuple[Any, Any, Any, str]] = {
    "too wide": (rows(3, 3), None, 1, "model_continuation: expected (up to 6, 2) float32"),
    "too long": (rows(7), None, 1, "model_continuation: expected (up to 6, 2) float32"),
    "another type": (rows(3, dtype=np.float64), None, 1, "model_continuation: expected (up to"),
    "no matrix": (np.ones(2, np.float32), None, 1, "model_continuation: expected (up to 6, 2)"),
    "no array": ([[1, 2]], None, 1, "model_continuation: expected (up to 6, 2) float32"),
    "a wide canonical plan": (rows(3), rows(3, 3), 1, "canonical_continuation: expected (up to"),
    "unequal plans": (rows(3), rows(2), 1, "canonical_continuation: expected 3 rows"),
    "no delay": (rows(3), rows(3), None, "delay: expected 0 to"),
    "a true delay": (rows(3), rows(3), True, "delay: expected 0 to"),
    "a negative delay": (rows(3), rows(3), -1, "delay: expected 0 to"),
    "a delay of more than a chunk": (rows(3), rows(3), 7, "delay: expected 0 to"),
    "a delay without a plan": (None, None, 1, "delay: expected 0 to 0 ticks"),
}


@pytest.mark.parametrize(("mode", "policy"), [("rtc_guided", GUIDED), ("rtc_trained", TRAINED)])
def test_a_wrong_plan_is_refused_and_the_session_goes_on(
    open_arm: Open, mode: str, policy: dict[str, Any]
) -> None:
    with begin(open_arm(policy=policy), mode) as robot:
        for name, (plan, canonical, delay, expected) in FAULTY.items():
            answer = continue_plan(robot, plan, canonical, delay)
            assert answer.message_type == "error", name
            code, message = answer.body["code"], answer.body["message"]
            assert (code, expected in message) == ("malformed", True), (name, message)
        assert Counting.given == []
        assert continue_plan(robot, rows(3), rows(3), 2).message_type == "action"


def test_a_delay_beyond_the_plan_holds_all_of_it_if_the_policy_is_guided(open_arm: Open) -> None:
    """LeRobot's client sends the delay of an answer, even if its plan is shorter."""
    with begin(open_arm(policy=GUIDED), "rtc_guided") as robot:
        assert continue_plan(robot, rows(3), rows(3), 5).message_type == "action"
        assert Counting.given[0][DELAY] == 3


@pytest.mark.parametrize(("number", "delay", "longest"), [(5, 3, LONGEST), (1, 2, 1)])
def test_a_delay_beyond_what_the_policy_was_trained_with_is_refused(
    open_arm: Open, number: int, delay: int, longest: int
) -> None:
    with begin(open_arm(policy=TRAINED), "rtc_trained") as robot:
        answer = continue_plan(robot, rows(number), rows(number), delay)
        assert answer.body == {
            "code": "malformed",
            "message": f"delay: expected 0 to {longest} ticks in mode rtc_trained with a plan of "
            f"{number} rows, got {delay}",
        }


def test_aligned_chunks_are_refused_with_real_time_chunking(open_arm: Open) -> None:
    with RemoteRobot(open_arm(policy=GUIDED)) as robot:
        answer = robot.open(
            mode="rtc_guided",
            action_feature=on_wire(ARM),
            chunk_settings={"chunk_merge": "aligned"},
            required_capabilities=["chunk_alignment_v2"],
        )
        assert answer.body["code"] == "incompatible"
        assert "chunk_merge 'append'" in answer.body["message"]
