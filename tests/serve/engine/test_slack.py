"""The use of the robots' SLOs and slack by an engine."""

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
from vlagents_ray.interface import REPLAN, SLACK, SLO
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.fleet import CostCurve

ROWS = 50


class Chunks(Agent):
    """A policy that returns a chunk after 5 ms, and keeps the options of its reset."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {"options": sorted(kwargs)}

    def act(self, obs: Obs) -> Act:
        time.sleep(0.005)
        return Act(np.zeros((ROWS, 2), np.float32))


@pytest.fixture
def engine() -> Iterator[Engine]:
    made = Engine(Chunks())
    made.start()
    yield made
    made.close()


def reset(engine: Engine, session: str, **options: Any) -> dict[str, Any]:
    reply = answered(engine, session, Request("reset", Obs(), kwargs=options))
    assert reply.error is None
    return dict(reply.info)


def act(engine: Engine, session: str, **info: Any) -> Act:
    reply = answered(engine, session, Request("act", Obs(info=info)))
    assert reply.error is None
    return reply.act


def test_an_slo_is_answered_at_the_reset_and_not_passed_to_the_policy(engine: Engine) -> None:
    reset(engine, "a")
    for _ in range(5):
        act(engine, "a")
    info = reset(engine, "a", slo={"hz": 10}, seed=1)
    assert info["options"] == ["seed"]
    assert info[SLO]["in_time"] is True
    assert 0 < info[SLO]["load"] < 0.9


def test_a_robot_that_cannot_be_served_is_told_so_at_its_reset(engine: Engine) -> None:
    reset(engine, "a")
    for _ in range(5):
        act(engine, "a")
    answer = reset(engine, "b", slo={"hz": 10_000})[SLO]
    assert answer["in_time"] is False
    assert "lower the rate" in answer["reason"]


@pytest.mark.parametrize(
    "wrong",
    [
        *({}, {"hz": 0}, {"hz": 10, "ages": 1}, 10),
        *(
            {"hz": 5e-324},
            {"hz": 1e308},
            {"hz": 10, "age_ms": 5e-324},
            {"hz": 10**400},
            {"hz": 10, "rows": 10**10},
        ),
    ],
)
def test_a_wrong_slo_is_refused(engine: Engine, wrong: Any) -> None:
    with pytest.raises(InvalidInput, match=r"slo.*expected .* got"):
        checked(engine, "a", Request("reset", Obs(), kwargs={SLO: wrong}), ignore)


@pytest.mark.parametrize("hz", [1e-6, 1, 1e9])
@pytest.mark.parametrize("age_ms", [1e-6, 100, 1e9])
@pytest.mark.parametrize("rows", [1, 10**9])
def test_the_least_and_the_largest_slo_is_answered_and_disturbs_no_other_robot(
    engine: Engine, hz: float, age_ms: float, rows: int
) -> None:
    reset(engine, "a")
    act(engine, "a")
    answer = reset(engine, "extreme", slo={"hz": hz, "age_ms": age_ms, "rows": rows})[SLO]
    assert type(answer["in_time"]) is bool
    for slack_ms in (5e-324, 1e308):
        act(engine, "extreme", slack_ms=slack_ms)
    engine.pace._read = -math.inf  # as if half a second had passed
    assert reset(engine, "b", slo={"hz": 10})[SLO]["in_time"] is True
    act(engine, "b", slack_ms=100.0)


@pytest.mark.parametrize("wrong", [-1.0, math.nan, math.inf, "10", True, [1.0]])
def test_a_wrong_slack_is_refused(engine: Engine, wrong: Any) -> None:
    reset(engine, "a")
    with pytest.raises(InvalidInput, match=r"slack_ms.*expected .* got"):
        checked(engine, "a", Request("act", Obs(info={SLACK: wrong})), ignore)


def test_an_answer_is_needed_when_the_slack_is_over_or_the_deadline(engine: Engine) -> None:
    reset(engine, "a")
    pending = checked(engine, "a", Request("act", Obs(info={SLACK: 250})), ignore)
    assert pending.needed == pytest.approx(pending.arrived + 0.25)
    pending = checked(
        engine, "a", Request("act", Obs(info={SLACK: 250}), deadline_ms=100.0), ignore
    )
    assert pending.needed == pending.deadline


def test_a_lone_robot_replans_as_often_as_it_wants(engine: Engine) -> None:
    reset(engine, "a", slo={"hz": 10})
    assert all(REPLAN not in act(engine, "a", slack_ms=2000.0).info for _ in range(5))


def test_robots_of_a_busy_replica_are_told_when_to_replan(engine: Engine) -> None:
    names = [f"robot{number}" for number in range(400)]
    for name in names:
        reset(engine, name, slo={"hz": 10})
    for name in names[:5]:
        act(engine, name, slack_ms=2000.0)
    engine.pace._read = -math.inf  # as if half a second had passed
    replan_ms = act(engine, names[0], slack_ms=2000.0).info[REPLAN]
    # 400 robots with 5 ms each.
    assert 1000 < replan_ms < 5000
    assert REPLAN not in act(engine, names[0]).info, "the request has no slack"


def test_an_slo_moves_with_its_session(engine: Engine) -> None:
    reset(engine, "a", slo={"hz": 10, "age_ms": 500, "rows": 8})
    act(engine, "a", slack_ms=2000.0)
    state = engine.moves.export("a", engine.clock())
    plan = engine.sessions.get("a").plan
    assert list(state.robot) == [10, 8, 0.5, True, 0.98, 8]
    engine.sessions.close("a")
    engine.sessions.free("a")
    engine.moves.adopt("a", state)
    moved = engine.sessions.get("a").plan
    assert (moved.need, moved.most_rows) == (plan.need, 8)


def test_a_robot_that_executes_a_part_of_each_answer_needs_the_next_one_sooner(
    engine: Engine,
) -> None:
    reset(engine, "a", slo={"hz": 10, "rows": 8})
    act(engine, "a", slack_ms=500.0)
    need = engine.sessions.get("a").plan.need
    assert need is not None
    assert need.rows == 8, "the answer has 50 rows"


def test_requests_of_robots_that_came_too_late_wait_behind_others(engine: Engine) -> None:
    reset(engine, "first", slo={"hz": 10})
    act(engine, "first", slack_ms=2000.0)
    engine.pace._curve = lambda: CostCurve(row_s=0.005)
    answers = [reset(engine, f"robot{number}", slo={"hz": 60})[SLO] for number in range(9)]
    are_in_time = [answer["in_time"] for answer in answers]
    assert are_in_time == sorted(are_in_time, reverse=True)
    assert not are_in_time[-1]
    late = checked(engine, "robot8", Request("act", Obs(info={SLACK: 250})), ignore)
    first = checked(engine, "first", Request("act", Obs(info={SLACK: 250})), ignore)
    assert late.waits_behind_others
    assert not first.waits_behind_others


def test_the_costs_of_batches_are_measured(engine: Engine) -> None:
    reset(engine, "a")
    for _ in range(5):
        act(engine, "a")
    costs = engine.queue.window.describe_costs()
    assert costs is not None
    assert costs["ms_by_size"]["1"] >= 5.0
