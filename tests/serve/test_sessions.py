"""Copies of a policy for sessions, with separate state and shared weights."""

from __future__ import annotations

import collections
import logging
import math
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from in_flight import opened, pending

from vlagents_ray.errors import PolicyUnavailable, UnknownSession
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies import agent_copies
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve import sessions
from vlagents_ray.serve.requests import Origin
from vlagents_ray.serve.sessions import Outdated, Past, Session, SessionTable

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch


class Stateful(Agent):
    """A policy that keeps state in many different forms."""

    def initialize(self) -> None:
        self.history: list[int] = []
        self.queue: collections.deque[int] = collections.deque(maxlen=3)
        self.buffer = np.zeros(4)
        self.nested = {"a": [{"b": set()}]}
        self.rng = np.random.default_rng(0)
        self.tensor = torch.zeros(3)
        self.bound = self.remember
        self.scale = lambda x: 2 * x

    def remember(self, value: int) -> None:
        self.history.append(value)

    def act(self, obs: Obs) -> Act:
        value = int(obs.info["value"])
        self.bound(value)
        self.queue.append(value)
        self.buffer[0] += value
        self.nested["a"][0]["b"].add(value)
        self.tensor += value
        return Act(
            np.array([len(self.history), self.buffer[0], self.scale(value)]),
            info={"random": self.rng.random()},
        )


def copies(agent: Agent) -> Any:
    agent.initialize()
    return AgentCopies(agent)


def test_copies_do_not_mix() -> None:
    make = copies(Stateful())
    a, b = make.make(), make.make()
    for value in range(5):
        a.act(Obs(info={"value": value}))
    assert a.history == [0, 1, 2, 3, 4]
    assert b.history == []
    assert list(b.queue) == []
    assert b.buffer.sum() == 0
    assert b.tensor.sum() == 0
    assert b.nested == {"a": [{"b": set()}]}


def test_a_copy_starts_as_initialize_left_it_whatever_others_did() -> None:
    make = copies(Stateful())
    first = make.make().act(Obs(info={"value": 3}))
    make.make().act(Obs(info={"value": 9}))
    again = make.make().act(Obs(info={"value": 3}))
    np.testing.assert_array_equal(first.action, again.action)
    assert first.info == again.info


class Heavy(Agent):
    shared = ("table",)

    def initialize(self) -> None:
        self.model = torch.nn.Sequential(torch.nn.Linear(3, 3), torch.nn.BatchNorm1d(3))
        self.model.actions = []  # as LeRobot's policies store their queue
        self.table = {"big": np.zeros(10)}
        self.own = {"small": np.zeros(10)}


def test_weights_are_shared_and_module_state_is_not() -> None:
    make = copies(Heavy())
    a, b = make.make(), make.make()
    assert a.model[0].weight is b.model[0].weight
    assert a.model is not b.model
    assert a.model[1].running_mean is not b.model[1].running_mean
    a.model.actions.append(1.0)
    assert b.model.actions == []
    assert a.table is b.table, "the message names the attribute"
    assert a.own is not b.own


class Locked(Agent):
    def initialize(self) -> None:
        self.lock = threading.Lock()
        self.state = [0]


def test_what_cannot_be_copied_is_shared_and_said(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        make = copies(Locked())
    a, b = make.make(), make.make()
    assert a.lock is b.lock
    assert a.state is not b.state
    assert "lock" in caplog.text


def test_a_huge_array_is_shared_but_cannot_be_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agent_copies, "SHARED_ARRAY_BYTES", 1000)

    class Big(Agent):
        def initialize(self) -> None:
            self.weights = np.ones(1000)

    agent: Any = copies(Big()).make()
    with pytest.raises(ValueError, match="read-only"):
        agent.weights[0] = 2


def test_a_full_table_refuses_and_makes_room_for_the_idle_which_are_forgotten() -> None:
    table: SessionTable[Any] = SessionTable(limit=1, idle_s=60)
    opened(table, "a")
    with pytest.raises(PolicyUnavailable, match="limit"):
        opened(table, "b")
    opened(table, "a").used -= 61
    opened(table, "b").used -= 61
    with pytest.raises(UnknownSession, match="'a'"):
        table.get("a")
    table.drop_idle()
    assert len(table) == 0


class Networked(Agent):
    """A policy with shared weights and separate state."""

    shared = ("table",)

    def initialize(self) -> None:
        self.table = {"a": 1}
        self.model = torch.nn.Linear(3, 2)
        self.lock = threading.Lock()
        self.state = torch.zeros(3)
        self.seen: list[np.ndarray] = []


def test_a_session_goes_on_in_another_replica_with_its_state_and_the_other_ones_weights() -> None:
    here, there = Networked(), Networked()
    ours, theirs = copies(here), copies(there)
    assert ours.fingerprint == theirs.fingerprint
    session = ours.make()
    session.state += 5
    session.seen.append(np.arange(3))
    data = ours.dump(session)
    assert len(data) < 2000  # the data contains no weights
    moved = theirs.load(data)
    assert moved.state.tolist() == [5, 5, 5]
    assert moved.seen[0].tolist() == [0, 1, 2]
    assert moved.model.weight is there.model.weight
    assert moved.table is there.table
    assert moved.lock is there.lock


def test_what_a_session_may_not_carry_stays_where_it_is() -> None:
    ours = copies(Networked())
    session = ours.make()
    session.window = threading.Lock()
    with pytest.raises(TypeError):
        ours.dump(session)


def test_another_version_of_a_policy_has_another_fingerprint() -> None:
    wider = Networked()
    wider.initialize()
    wider.model = torch.nn.Linear(4, 2)
    assert AgentCopies(wider).fingerprint != copies(Networked()).fingerprint


def test_a_connection_ends_its_own_sessions_only() -> None:
    table: SessionTable[Any] = SessionTable(limit=10, idle_s=60)
    left, right = Origin(owner="left"), Origin(owner="right")
    for name in ("a", "b"):
        opened(table, name, left)
    opened(table, "b", right)  # its client returned over another connection
    opened(table, "c")
    table.close_owned(left)
    assert table.ids() == ["b", "c"]


def test_an_episode_begins_above_all_earlier_steps_of_its_session_though_the_clock_is_behind() -> (
    None
):
    table: SessionTable[object] = SessionTable(limit=10, idle_s=60, clock=lambda: 0)
    earlier = 2**40
    table.enter(Session("a", steps=earlier))  # from a replica whose clock is ahead
    assert opened(table, "a").first > earlier
    table.close("a")
    assert opened(table, "a").first > earlier


Table = SessionTable[str]


def begin_idle(table: Table) -> None:
    table.get("a").used -= 61
    table.drop_idle()


def replace_by_newer(table: Table) -> None:
    table.enter(Session("a", steps=2**80))


def abandon_arriving(table: Table) -> None:
    arriving = table.get("a")
    table.release("a", arriving.version)
    arriving.over, arriving.model = False, "model"
    table.abandon(arriving)


ENDS: dict[str, Callable[[Table], object]] = {
    "closed": lambda table: table.close("a"),
    "closed with its connection": lambda table: table.close_owned(table.get("a").origin),
    "idle": begin_idle,
    "released to another replica": lambda table: table.release("a", table.get("a").version),
    "begun at another replica": lambda table: table.drop_older({"a": Past((2**80, 0), math.inf)}),
    "replaced by its newer state": replace_by_newer,
    "expected in vain": abandon_arriving,  # released, and then abandoned on its way back
}


@pytest.mark.parametrize("end", ENDS)
def test_a_session_releases_its_model_however_it_ends_and_others_keep_theirs(end: str) -> None:
    table: Table = SessionTable(limit=10, idle_s=60)
    for name, model in (("a", "model"), ("b", "another")):
        origin = Origin(owner="left" if name == "a" else "right")
        opened(table, name, origin).model = model
    ended = table.get("a")

    ENDS[end](table)

    assert ended.over
    assert ended.model is None
    assert table.get("b").model == "another"


@pytest.mark.parametrize(
    ("steps", "moves", "is_kept"),
    [
        (9, 0, False),
        (9, 7, False),
        (10, 0, True),  # the announced episode moved here before its announcement
        (10, 2, True),
        (11, 0, True),
    ],
)
def test_an_announced_episode_ends_the_states_before_it_alone(
    steps: int, moves: int, is_kept: bool
) -> None:
    table: SessionTable[object] = SessionTable(limit=10, idle_s=60)
    table.enter(Session("a", steps=steps, moves=moves, began=3.0))
    episode = Past((10, 0), 5.0)
    greater = table.drop_older({"a": episode, "unknown": episode})
    assert ("a" in table) is is_kept
    assert greater == ({"a": Past((steps, moves), 3.0)} if is_kept else {})

    for name in ("a", "unknown"):
        with pytest.raises(Outdated):
            table.enter(Session(name, steps=9, moves=99))
    table.enter(Session("unknown", steps=10))


def test_the_states_that_are_rejected_are_those_of_the_sessions_that_left_last(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sessions, "_REMEMBERED", 3)
    table: SessionTable[object] = SessionTable(limit=10, idle_s=60)
    for name in "abcde":
        table.enter(Session(name, steps=5))
        table.close(name)
    table.drop_older({"c": Past((7, 0), 0.0)})  # as if it had left last
    table.enter(Session("f", steps=5))
    table.close("f")
    assert [name for name in "abcdef" if table._newest(name).version >= (5, 0)] == ["c", "e", "f"]


def test_sessions_that_can_move_and_were_used_lately_are_counted_by_connection() -> None:
    table: SessionTable[object] = SessionTable(limit=10, idle_s=600)
    for name, connection, can_move, unused_s in (
        ("a", "first", True, 0.0),
        ("b", "first", True, 5.0),
        ("c", "second", True, 5.0),
        ("d", "second", True, 100.0),
        ("e", "third", False, 0.0),
    ):
        origin = Origin(connection=connection, can_move=can_move)
        session: Session[object] = Session(name, steps=1, origin=origin)
        session.used -= unused_s
        table.enter(session)
    assert table.movable_by_connection(within_s=50.0) == {"first": 2, "second": 1}
    assert table.movable_by_connection(within_s=500.0) == {"first": 2, "second": 2}


def test_an_episode_is_that_of_the_connections_own_waiting_reset_until_it_is_dropped() -> None:
    table: SessionTable[object] = SessionTable(limit=10, idle_s=60)
    left, right = Origin(owner="left"), Origin(owner="right")
    begun = opened(table, "a", left).first

    waiting = [
        table.reserve(pending("a", Request("reset"), origin=origin), {}, follows=True)
        for origin in (left, right, left)
    ]
    assert waiting[0].first < waiting[1].first < waiting[2].first
    expected = [waiting[2].first, waiting[0].first, begun]
    for number, dropped in enumerate((2, 0)):
        assert table.episode_of("a", left) == expected[number]
        table.undo("a", waiting[dropped])
    assert table.episode_of("a", left) == begun
    assert table.episode_of("a", right) == waiting[1].first
    assert table.get("a").first == begun


def test_an_episode_that_began_later_is_kept_at_a_smaller_step_and_the_earlier_one_is_void() -> (
    None
):
    here: SessionTable[object] = SessionTable(limit=10, idle_s=60)
    here.enter(Session("a", steps=9, first=9, began=7.0))
    assert here.drop_older({"a": Past((10, 0), 5.0)}) == {"a": Past((9, 0), 7.0)}
    assert "a" in here

    there: SessionTable[object] = SessionTable(limit=10, idle_s=60)
    there.enter(Session("a", steps=10, first=10, began=5.0))
    there.void("a", 8, (9, 0))
    assert "a" in there, "another episode"
    there.void("a", 10, (9, 0))
    assert "a" not in there
    with pytest.raises(Outdated):
        there.enter(Session("a", steps=8))
    there.enter(Session("a", steps=9, moves=1))


def test_a_step_is_raised_above_the_greater_step_of_an_earlier_episode() -> None:
    table: SessionTable[object] = SessionTable(limit=10, idle_s=60)
    origin = Origin(owner="left")
    session = opened(table, "a", origin)
    first = session.first
    session.advance()

    assert table.raise_step("a", first - 1, first + 5) is None, "another episode"
    raised = table.raise_step("a", first, first + 5)
    assert raised is not None
    assert raised > first + 5
    assert (session.first, session.steps) == (raised, raised + 1)
    assert origin.sessions == {"a": raised}


def test_a_waiting_reset_with_a_greater_step_is_reported_if_it_arrived_earlier() -> None:
    table: SessionTable[object] = SessionTable(limit=10, idle_s=60)
    reset = pending("a", Request("reset"))
    opening = table.reserve(reset, {}, follows=True)
    step = opening.first - 10
    assert table.drop_older({"a": Past((step, 0), reset.arrived - 1)}) == {}
    greater = table.drop_older({"a": Past((step, 0), reset.arrived + 1)})
    assert greater == {"a": Past((opening.first, 0), reset.arrived)}


def test_a_connection_has_no_session_after_its_close() -> None:
    table: SessionTable[object] = SessionTable(limit=10, idle_s=60)
    origin = Origin(owner="left")
    opened(table, "a", origin)
    close = pending("a", Request("close"), origin=origin)
    close.episode = table.episode_of("a", origin)
    table.close_for(close)
    assert (len(table), origin.sessions) == (0, {})
