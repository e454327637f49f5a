"""The selection of a replica for a new session, and the decision to move a session to another
replica.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Collection
from dataclasses import replace

import numpy as np
import pytest
from in_flight import opened
from in_process_replicas import Replicas

from vlagents_ray import Act, Agent, Obs
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.scaling import rebalancer as balancing
from vlagents_ray.serve.scaling.rebalancer import (
    ClientLocation,
    Rebalancer,
    ReplicaLoad,
    choose_connections,
    choose_replica,
    excess_sessions,
)
from vlagents_ray.serve.sessions import DrainList


def load(replica: str, sessions: int, node: str = "n1", *, accepts: bool = True) -> ReplicaLoad:
    return ReplicaLoad(replica, sessions, accepts, node, f"boot of {node}", ("v", "f"))


def chosen(loads: list[ReplicaLoad], place: ClientLocation = ClientLocation()) -> str | None:  # noqa: B008 - a frozen dataclass
    replica = choose_replica(loads, place)
    return None if replica is None else replica.replica


def test_a_new_session_goes_to_the_least_loaded_replica_that_accepts_it() -> None:
    loads = [load("a", 3), load("b", 2), load("c", 0, accepts=False)]
    assert chosen(loads) == "b"
    assert chosen(loads[2:]) is None


@pytest.mark.parametrize("place", [ClientLocation("near"), ClientLocation(boot_id="boot of near")])
def test_a_near_replica_is_preferred_until_it_is_clearly_more_loaded(place: ClientLocation) -> None:
    assert chosen([load("far", 0, "far"), load("near", 1, "near")], place) == "near"
    assert chosen([load("far", 0, "far"), load("near", 2, "near")], place) == "far"
    assert chosen([load("far", 40, "far"), load("near", 50, "near")], place) == "near"
    assert chosen([load("far", 40, "far"), load("near", 51, "near")], place) == "far"


def test_a_client_that_reaches_one_machine_only_is_sent_nowhere_else() -> None:
    place = ClientLocation("near", must_be_near=True)
    assert chosen([load("far", 0, "far"), load("near", 90, "near")], place) == "near"
    assert chosen([load("far", 0, "far")], place) is None
    nowhere = replace(load("a", 0), node="", boot_id="")
    assert chosen([nowhere], ClientLocation(must_be_near=True)) is None, (
        "the replica does not know its location"
    )


@pytest.mark.parametrize(
    ("mine", "others", "leaving", "expected"),
    [
        (12, [0], 0, 6),
        (12, [0], 6, 0),  # these sessions are already moving
        (7, [5], 0, 0),
        (8, [4], 0, 2),
        (2, [0], 0, 0),  # one more than the mean does not justify a move
        (3, [0], 0, 1),
        (1, [0, 0, 0, 0], 0, 0),
        (50, [40, 42], 0, 0),
        (60, [40, 42], 0, 12),
        (0, [12], 0, 0),
        (5, [], 0, 0),
    ],
)
def test_surplus(mine: int, others: list[int], leaving: int, expected: int) -> None:
    assert excess_sessions(mine, others, leaving) == expected


def test_moving_the_surplus_never_makes_another_one() -> None:
    for mine in range(60):
        for other in range(mine + 1):
            moved = excess_sessions(mine, [other])
            assert excess_sessions(mine - moved, [other + moved]) == 0
            assert excess_sessions(other + moved, [mine - moved]) == 0


def test_connections_move_whole() -> None:
    assert choose_connections(Counter(a=1, b=1, c=1), 2) == {"a", "b"}
    assert choose_connections(Counter(a=8, b=1, c=3), 4) == {"c", "b"}
    assert choose_connections(Counter(a=8), 6) == set()


def test_a_connection_is_told_once_each_time_it_is_marked() -> None:
    drain_list = DrainList()
    assert not drain_list.ask("a")
    drain_list.mark({"a"})
    assert (drain_list.ask("b"), drain_list.ask("a"), drain_list.ask("a")) == (False, True, False)
    assert drain_list.asked_within(60) == {"a"}
    drain_list.forget_older(0)
    assert drain_list.asked_within(60) == set()


class Counting(Agent):
    """A policy that counts its acts."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict:
        self.count = 0
        return {}

    def act(self, obs: Obs) -> Act:
        self.count += 1
        return Act(np.array([self.count], np.float32))


class Beside:
    """Other replicas with given loads; counts the queries."""

    def __init__(self, *loads: ReplicaLoad) -> None:
        self.held, self.asked = list(loads), 0
        self.asked_again: list[str] = []  # names of replicas that were queried again at once

    async def some_loads(self, near: Collection[ClientLocation] = ()) -> list[ReplicaLoad]:
        self.asked += 1
        await asyncio.sleep(0.01)
        return [replace(one) for one in self.held]

    async def announce_client(self, replica: str) -> str:
        return replica

    def forget_silence(self, replica: str) -> None:
        self.asked_again.append(replica)


def balance(engine: Engine, *beside: ReplicaLoad) -> tuple[Rebalancer, Beside]:
    neighbours = Beside(*beside)
    return Rebalancer(engine, neighbours, lambda sessions: load("me", sessions)), neighbours


def test_clients_that_come_at_once_are_spread_evenly() -> None:
    engine = Engine(Counting())
    mine, neighbours = balance(engine, load("b", 3), load("c", 0))

    async def place() -> list[str | None]:
        return await asyncio.gather(*(mine.redirect(ClientLocation()) for _ in range(15)))

    places = asyncio.run(place())
    assert {name: places.count(name) for name in (None, "b", "c")} == {None: 6, "b": 3, "c": 6}
    assert mine.load().sessions == 6
    assert neighbours.asked == 1


def test_a_client_that_no_replica_is_near_to_gets_the_least_loaded_of_the_next_place() -> None:
    mine, _ = balance(
        Engine(Counting()), load("b", 0), replace(load("c", 2), boot_id="another machine")
    )
    near = [
        ClientLocation(boot_id=machine, must_be_near=True)
        for machine in ("another machine", "none", load("b", 0).boot_id)
    ]
    assert asyncio.run(mine.redirect(near[0], near[2])) == "c"
    assert asyncio.run(mine.redirect(near[1], near[2])) in ("b", None)
    assert asyncio.run(mine.redirect(near[1])) is None


def test_a_client_is_expected_until_its_session_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = Engine(Counting())
    mine, _ = balance(engine)
    mine.expect_client()
    mine.expect_client()
    assert mine.load().sessions == 2
    opened(engine.sessions, "one")
    assert mine.load().sessions == 2
    monkeypatch.setattr(balancing, "_EXPECTED_S", 0.0)
    time.sleep(0.01)
    assert mine.load().sessions == 1


def test_surplus_connections_go_elsewhere_with_all_their_sessions() -> None:
    served = Replicas([Counting(), Counting()])
    first, second = served.engines
    agents = [served.agent() for _ in range(4)]
    groups = [[agent, *agent.sessions(1)] for agent in agents]
    for agents_of_one in groups:
        agents_of_one[0].reset_batch([Obs(), Obs()], [None, None], agents_of_one)
    mine, _ = balance(first, load("b", 0))
    asyncio.run(mine.compare())
    assert first.drain_list._marked == set(), "a momentary surplus moves no session"
    asyncio.run(mine.compare())
    served.prefer = 1
    for step in range(1, 5):
        for agents_of_one in groups:
            for act in agents_of_one[0].act_batch([Obs(), Obs()], agents_of_one):
                assert isinstance(act, Act)
                assert act.action[0] == step
                assert "resumed" not in act.info
    assert (len(first.sessions), len(second.sessions)) == (4, 4)
    for agents_of_one in groups:
        for agent in agents_of_one:
            agent.close()
    assert (len(first.sessions), len(second.sessions)) == (0, 0)
    served.close()


def test_a_replica_that_joins_gets_its_share_after_one_comparison() -> None:
    served = Replicas([Counting()])
    [engine] = served.engines
    agents = [served.agent() for _ in range(4)]
    for agent in agents:
        agent.reset(Obs())

    mine, neighbours = balance(engine, load("b", 4))
    asyncio.run(mine.compare())
    neighbours.held.append(load("c", 0))
    asyncio.run(mine.compare())
    assert len(engine.drain_list._marked) == 1

    for agent in agents:
        agent.close()
    served.close()


def test_sessions_that_end_or_begin_while_the_others_answer_are_counted_as_they_are_then() -> None:
    """The loads that the other replicas report count sessions that have left this replica."""
    served = Replicas([Counting()])
    [engine] = served.engines
    agents = [served.agent() for _ in range(12)]
    for agent in agents:
        agent.reset(Obs())

    class Moving(Beside):
        """Reports its load when sessions of the first replica have just moved to it."""

        async def some_loads(self, near: Collection[ClientLocation] = ()) -> list[ReplicaLoad]:
            for agent in agents[6:]:
                agent.close()
            return [replace(self.held[0], sessions=6)]

    neighbours = Moving(load("b", 0))
    mine = Rebalancer(engine, neighbours, lambda sessions: load("me", sessions))
    asyncio.run(mine.compare())
    served.close()
    assert not mine._uneven


def test_a_replica_that_announces_itself_is_compared_with_at_once() -> None:
    served = Replicas([Counting()])
    [engine] = served.engines
    agents = [served.agent() for _ in range(4)]
    for agent in agents:
        agent.reset(Obs())
    mine, neighbours = balance(engine, load("b", 4))

    async def join() -> float:
        """Add a replica, and return the time until the next comparison in s."""
        await mine.compare()
        comparing = asyncio.ensure_future(mine.run())
        await asyncio.sleep(0.1)
        neighbours.held.append(load("c", 0))
        joined = time.monotonic()
        mine.replica_joined("c")
        while neighbours.asked < 2:
            await asyncio.sleep(0.01)
        comparing.cancel()
        return time.monotonic() - joined

    assert asyncio.run(join()) < 0.5 * balancing.PERIOD_S
    assert neighbours.asked_again == ["c"]
    for agent in agents:
        agent.close()
    served.close()


def test_a_session_closed_after_it_was_told_to_go_is_forgotten() -> None:
    served = Replicas([Counting()])
    agent = served.agent()
    agent.reset(Obs())
    [engine] = served.engines
    engine.drain_list.mark(set(engine.sessions.movable_by_connection(60)))
    agent.act(Obs())
    agent.close()
    assert len(engine.sessions) == 0
    served.close()
