"""The use of the robots' slack by an engine."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from in_flight import answered, checked, ignore

from vlagents_ray import Act, Agent, Obs
from vlagents_ray.errors import InvalidInput
from vlagents_ray.interface import REPLAN, SLACK
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.queue.robots_load import CostCurve, RobotNeed

ROWS = 50


class Chunks(Agent):
    """A policy that returns a chunk after 5 ms."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {}

    def act(self, obs: Obs) -> Act:
        time.sleep(0.005)
        return Act(np.zeros((ROWS, 2), np.float32))


@pytest.fixture
def engine() -> Iterator[Engine]:
    made = Engine(Chunks())
    made.start()
    yield made
    made.close()


def reset(engine: Engine, session: str, hz: float | None = None) -> None:
    """Begin an episode; with `hz`, of a robot whose rate is already known."""
    reply = answered(engine, session, Request("reset", Obs()))
    assert reply.error is None
    if hz is not None:
        engine.sessions.get(session).plan.need = RobotNeed(hz, ROWS)


def act(engine: Engine, session: str, **info: Any) -> Act:
    reply = answered(engine, session, Request("act", Obs(info=info)))
    assert reply.error is None
    return reply.act


@pytest.mark.parametrize("wrong", [-1.0, math.nan, math.inf, "10", True, [1.0]])
def test_a_wrong_slack_is_refused(engine: Engine, wrong: Any) -> None:
    reset(engine, "a")
    with pytest.raises(InvalidInput, match=r"slack_ms.*expected .* got"):
        checked(engine, "a", Request("act", Obs(info={SLACK: wrong})), ignore)


def test_the_slack_of_a_simulation_does_not_count(engine: Engine) -> None:
    reset(engine, "a")
    request = Request("act", Obs(info={SLACK: 250}), priority="simulation")
    assert checked(engine, "a", request, ignore).needed == 0.0


def test_an_answer_is_needed_when_the_slack_is_over_or_the_deadline(engine: Engine) -> None:
    reset(engine, "a")
    pending = checked(engine, "a", Request("act", Obs(info={SLACK: 250})), ignore)
    assert pending.needed == pytest.approx(pending.arrived + 0.25)
    pending = checked(
        engine, "a", Request("act", Obs(info={SLACK: 250}), deadline_ms=100.0), ignore
    )
    assert pending.needed == pending.deadline


def test_a_lone_robot_replans_as_often_as_it_wants(engine: Engine) -> None:
    reset(engine, "a", hz=10)
    assert all(REPLAN not in act(engine, "a", slack_ms=2000.0).info for _ in range(5))


def test_robots_of_a_busy_replica_are_told_when_to_replan(engine: Engine) -> None:
    names = [f"robot{number}" for number in range(400)]
    for name in names:
        reset(engine, name, hz=10)
    act(engine, names[0], slack_ms=2000.0)
    engine.queue.curve = lambda: CostCurve(row_s=0.005)  # type: ignore[method-assign]
    engine.pace._read = -math.inf  # as if half a second had passed
    replan_ms = act(engine, names[0], slack_ms=2000.0).info[REPLAN]
    # 400 robots with 5 ms each.
    assert 1000 < replan_ms < 5000
    assert REPLAN not in act(engine, names[0]).info, "the request has no slack"


@pytest.mark.parametrize("slack_ms", [5e-324, 1e-9, 1.0, 1e308])
def test_no_slack_disturbs_another_robot(engine: Engine, slack_ms: float) -> None:
    for _ in range(3):
        reset(engine, "extreme")
        for _ in range(3):
            act(engine, "extreme", slack_ms=slack_ms)
    reset(engine, "b", hz=10)
    engine.pace._read = -math.inf  # as if half a second had passed
    act(engine, "b", slack_ms=100.0)
    assert not engine.sessions.get("b").plan.waits_behind_others


def test_the_needs_of_a_robot_move_with_its_session_and_end_with_its_episode(
    engine: Engine,
) -> None:
    reset(engine, "a", hz=10)
    act(engine, "a", slack_ms=2000.0)
    began = engine.sessions.get("a").plan.began
    state = engine.moves.export("a", engine.clock())
    assert list(state.robot) == [10, ROWS]
    engine.sessions.close("a")
    engine.sessions.free("a")
    engine.moves.enter(engine.moves.prepare("a", state, began=began))
    plan = engine.sessions.get("a").plan
    assert (plan.need, plan.began) == (RobotNeed(10, ROWS), began)

    reset(engine, "a")
    plan = engine.sessions.get("a").plan
    assert plan.need is None
    assert plan.began > began


def test_the_newest_episodes_wait_behind_others_if_there_are_too_many(engine: Engine) -> None:
    engine.queue.curve = lambda: CostCurve(row_s=0.005)  # type: ignore[method-assign]
    for number in range(9):
        reset(engine, f"robot{number}", hz=2000)
    engine.pace.load()
    requests = [
        checked(engine, f"robot{number}", Request("act", Obs(info={SLACK: 250})), ignore)
        for number in range(9)
    ]
    wait = [request.waits_behind_others for request in requests]
    assert wait == sorted(wait)
    assert (wait[0], wait[-1]) == (False, True)

    assert engine.queue.room is not None
    for number in range(9):
        engine.sessions.close(f"robot{number}")
    engine.pace._read = -math.inf  # as if half a second had passed
    reset(engine, "last")
    assert engine.queue.room is None


def test_the_costs_of_batches_are_measured(engine: Engine) -> None:
    reset(engine, "a")
    for _ in range(5):
        act(engine, "a")
    costs = engine.queue.window.describe_costs()
    assert costs is not None
    assert costs["ms_by_size"]["1"] >= 5.0
