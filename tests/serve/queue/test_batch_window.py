"""A batch waits for a group of sessions that will return soon. The tests use simulated time and the
queue's own bookkeeping.
"""

from __future__ import annotations

import heapq
import itertools
import random
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
from in_flight import AnySession, pending

from vlagents_ray.protocol.messages import Op, Priority, Request
from vlagents_ray.serve.queue.batch_window import BatchCost, BatchWindow
from vlagents_ray.serve.queue.fair_queue import FairQueue
from vlagents_ray.serve.requests import PendingRequest

SIZE = 16
Delay = Callable[[], float]


def fixed(size: int) -> float:
    """Return a batch's duration in s, of a policy for which waiting for a full batch mostly pays
    off.
    """
    return 0.020 + 0.001 * size


def ticket(
    session: str,
    arrived: float,
    priority: Priority = Priority.SIMULATION,
    op: Op = "act",
    **fields: float,
) -> PendingRequest:
    one = pending(session, Request(op, **fields), lambda _: None, arrived=arrived)  # type: ignore[arg-type]
    one.priority = priority
    return one


class AllButClosed(AnySession):
    """A table in which every session exists except "closed"."""

    def __contains__(self, session_id: object) -> bool:
        return session_id != "closed"


@dataclass
class World:
    """Clients with a given delay after each answer, a policy, and the queue between them."""

    delays: list[Delay]
    patience: float
    cost: Callable[[int], float] = fixed
    priorities: dict[int, Priority] = field(default_factory=dict)
    sizes: list[int] = field(default_factory=list)
    # (duration of each wait, duration of the batch before it)
    waits: list[tuple[float, float]] = field(default_factory=list)
    robots_waited: float = 0.0

    def run(self, batches: int) -> World:
        returning, waiting, now, took = (
            BatchWindow(self.patience, SIZE, AnySession()),
            FairQueue(),
            0.0,
            0.0,
        )
        order = itertools.count()
        # At the cold start, clients arrive one by one.
        coming = [(0.003 * i, next(order), i) for i in range(len(self.delays))]
        heapq.heapify(coming)

        def come() -> PendingRequest:
            at, _, number = heapq.heappop(coming)
            one = ticket(str(number), at, self.priorities.get(number, Priority.SIMULATION))
            returning.record_arrival(one)
            waiting.add(one)
            return one

        while len(self.sizes) < batches:
            while coming and (coming[0][0] <= now or not waiting.size):
                now = max(now, come().arrived)
            wait = returning.wait_s(now, waiting)
            if wait > 0:
                until, begun = now + wait, now
                now = until
                while coming and coming[0][0] <= until:
                    one = come()
                    if returning.ends_wait(one, waiting):
                        now = one.arrived
                        break
                self.waits.append((now - begun, took))
            batch, _ = waiting.take(SIZE, now)
            returning.record_start(batch)
            took = self.cost(len(batch))
            now += took
            returning.record_end(now, took)
            self.sizes.append(len(batch))
            for one in batch:
                heapq.heappush(
                    coming,
                    (now + self.delays[int(one.session_id)](), next(order), int(one.session_id)),
                )
        return self

    def mean(self) -> float:
        """Return the mean size of the batches in the second half of the run."""
        half = self.sizes[len(self.sizes) // 2 :]
        return sum(half) / len(half)


def soon(seed: int) -> Delay:
    """Return the delay of a simulation that calls again at once: the round trip and the time of one
    simulation step.
    """
    choose = random.Random(seed)
    return lambda: 0.001 + choose.uniform(0, 0.001)


@pytest.mark.parametrize("clients", [2, 3, 4, 8, 16])
def test_a_group_comes_together_and_stays(clients: int) -> None:
    delays = [soon(seed) for seed in range(clients)]
    assert World(delays, patience=0.0).run(200).mean() < 0.7 * clients
    assert World(delays, patience=0.15).run(200).mean() > 0.95 * clients


def large_model(size: int) -> float:
    """Return a batch's duration in s, of a policy for which one batch instead of two saves as much
    time as a robot may wait.
    """
    return 0.040 + 0.011 * size


def robot(seed: int, least: float = 0.003, most: float = 0.012) -> Delay:
    """Return the delay of one of several robots in a process, which encodes their images one after
    the other.
    """
    choose = random.Random(seed)
    return lambda: choose.uniform(least, most)


@pytest.mark.parametrize("robots", [2, 4, 8])
def test_robots_that_act_at_once_come_together(robots: int) -> None:
    world = {"delays": [robot(seed) for seed in range(robots)], "cost": large_model}
    priorities = dict.fromkeys(range(robots), Priority.ROBOT)
    assert World(**world, priorities=priorities, patience=0.0).run(200).mean() < 0.7 * robots
    together = World(**world, priorities=priorities, patience=0.1).run(200)
    assert together.mean() > 0.95 * robots
    assert all(wait < large_model(robots) / 2 for wait, _ in together.waits)


@pytest.mark.parametrize("others", [0, 1])
def test_a_robot_with_a_rate_of_its_own_neither_waits_nor_is_waited_for(others: int) -> None:
    delays = [robot(0, 0.1, 0.3), robot(1, 0.2, 0.4), *[robot(2)] * others]
    world = World(
        delays, patience=0.1, cost=large_model, priorities=dict.fromkeys(range(3), Priority.ROBOT)
    ).run(300)
    assert world.waits == []


def test_the_wait_is_bounded_by_the_batch_before() -> None:
    world = World([soon(seed) for seed in range(8)], patience=0.1).run(300)
    assert world.waits
    assert all(wait <= 0.1 * took + 1e-9 for wait, took in world.waits)


def test_a_lone_session_waits_for_nobody() -> None:
    assert World([soon(0)], patience=1.0).run(50).waits == []


def test_clients_that_are_usually_slow_are_not_waited_for() -> None:
    choose = random.Random(0)
    slow = [lambda: choose.uniform(0.05, 0.2) for _ in range(8)]
    world = World(list(slow), patience=0.15).run(300)
    assert sum(wait for wait, _ in world.waits) < 0.005 * sum(map(fixed, world.sizes))


def test_a_client_that_stops_is_waited_for_once() -> None:
    calls = itertools.count()
    world = World(
        [soon(0), soon(1), lambda: 0.0015 if next(calls) < 50 else 1e9], patience=0.15
    ).run(150)
    in_vain = [wait for wait, took in world.waits if wait > 0.15 * took - 1e-9]
    assert len(in_vain) <= 2
    assert world.sizes[-50:] == [2] * 50


def test_nobody_waits_where_batches_save_nothing() -> None:
    world = World(
        [soon(seed) for seed in range(4)], patience=0.3, cost=lambda size: 0.01 * size
    ).run(400)
    waited = sum(wait for wait, _ in world.waits)
    assert waited < 0.05 * sum(0.01 * size for size in world.sizes)


def answered_together(
    *names: str, patience: float = 0.1, robots: str = "", back_s: float = 0.002
) -> tuple[BatchWindow, FairQueue]:
    """Simulate three batches of 100 ms, the last of which ends at 2.0; after each of the others,
    all sessions returned after `back_s`.
    """
    returning = BatchWindow(patience, SIZE, AllButClosed())
    priorities = {name: Priority.ROBOT if name in robots else Priority.SIMULATION for name in names}
    tickets = [ticket(name, 0.0, priorities[name]) for name in names]
    for end in (0.0, 1.0, 2.0):  # the first batch shows that the policy is slow
        returning.record_start(tickets)
        returning.record_end(end, 0.1)
        tickets = [ticket(name, end + back_s, priorities[name]) for name in names]
        if end < 2.0:
            for one in tickets:
                returning.record_arrival(one)
    return returning, FairQueue()


def arrive(returning: BatchWindow, waiting: FairQueue, one: PendingRequest) -> None:
    returning.record_arrival(one)
    waiting.add(one)


def test_the_wait_ends_with_the_last_of_the_group() -> None:
    returning, waiting = answered_together("a", "b", "c")
    arrive(returning, waiting, ticket("a", 2.001))
    assert returning.wait_s(2.001, waiting) == pytest.approx(0.01)
    arrive(returning, waiting, b := ticket("b", 2.002))
    assert not returning.ends_wait(b, waiting)
    arrive(returning, waiting, c := ticket("c", 2.003))
    assert returning.ends_wait(c, waiting)


def test_a_robot_ends_the_wait_and_prevents_it() -> None:
    returning, waiting = answered_together("a", "b")
    arrive(returning, waiting, ticket("a", 2.001))
    assert returning.wait_s(2.001, waiting) > 0
    arrive(returning, waiting, robot := ticket("r", 2.002, Priority.ROBOT))
    assert returning.ends_wait(robot, waiting)
    assert returning.wait_s(2.002, waiting) == 0


def test_robots_wait_for_robots_alone() -> None:
    returning, waiting = answered_together("a", "b", "s", robots="ab")
    arrive(returning, waiting, ticket("a", 2.001, Priority.ROBOT))
    assert returning.wait_s(2.001, waiting) == pytest.approx(0.05)
    arrive(returning, waiting, simulation := ticket("s", 2.002))
    assert not returning.ends_wait(simulation, waiting)
    arrive(returning, waiting, b := ticket("b", 2.003, Priority.ROBOT))
    assert returning.ends_wait(b, waiting)
    returning, waiting = answered_together("a", "s", robots="a")
    arrive(returning, waiting, ticket("a", 2.001, Priority.ROBOT))
    assert returning.wait_s(2.001, waiting) == 0


def test_a_robot_that_came_for_the_first_time_ends_the_wait_of_robots() -> None:
    returning, waiting = answered_together("a", "b", "c", robots="abc")
    arrive(returning, waiting, ticket("a", 2.001, Priority.ROBOT))
    assert returning.wait_s(2.001, waiting) > 0
    arrive(returning, waiting, new := ticket("r", 2.002, Priority.ROBOT))
    assert returning.ends_wait(new, waiting)


def test_robots_do_not_wait_without_patience_or_for_longer_than_a_batch_saves() -> None:
    # half of the last batch's duration is 0.05 s
    for patience, back_s in ((0.0, 0.002), (0.1, 0.06)):
        returning, waiting = answered_together(
            "a", "b", patience=patience, robots="ab", back_s=back_s
        )
        arrive(returning, waiting, ticket("a", 2 + back_s, Priority.ROBOT))
        assert returning.wait_s(2 + back_s, waiting) == 0


def test_a_deadline_that_the_wait_would_endanger_prevents_it() -> None:
    # The batch takes 100 ms, the wait 10 ms.
    for deadline_ms, waits in ((105.0, False), (500.0, True)):
        returning, waiting = answered_together("a", "b", "c")
        arrive(returning, waiting, ticket("a", 2.001, deadline_ms=deadline_ms))
        assert (returning.wait_s(2.001, waiting) > 0) is waits
        returning, waiting = answered_together("a", "b", "c")
        arrive(returning, waiting, ticket("a", 2.001))
        assert returning.wait_s(2.001, waiting) > 0
        arrive(returning, waiting, b := ticket("b", 2.002, deadline_ms=deadline_ms))
        assert returning.ends_wait(b, waiting) is not waits


def test_a_full_batch_does_not_wait() -> None:
    names = [f"s{i}" for i in range(SIZE)]
    returning, waiting = answered_together(*names)
    for name in names[1:]:
        arrive(returning, waiting, ticket(name, 2.001))
    arrive(returning, waiting, ticket("another", 2.001))
    assert returning.wait_s(2.001, waiting) == 0


def test_sessions_that_are_closed_or_overdue_are_not_waited_for() -> None:
    returning, waiting = answered_together("a", "closed")
    arrive(returning, waiting, ticket("a", 2.001))
    assert returning.wait_s(2.001, waiting) == 0
    returning, waiting = answered_together("a", "b")
    arrive(returning, waiting, ticket("a", 2.05))
    assert returning.wait_s(2.05, waiting) == 0


def test_the_fixed_part_of_a_batch_is_found() -> None:
    cost = BatchCost()
    for size in (4, 4, 4):
        cost.add(size, fixed(size))
    assert cost.fixed_s() == float("inf")
    for size in (1, 8, 3, 16):
        cost.add(size, fixed(size))
    assert cost.fixed_s() == pytest.approx(0.020)


@pytest.mark.parametrize("op", ["reset", "close"])
def test_a_batch_with_another_operation_than_acts_does_not_count_for_the_durations(op: Op) -> None:
    returning, _ = answered_together("a", "b")
    before = returning.describe_costs()
    assert before is not None
    returning.record_start([ticket("a", 3.0), ticket("b", 3.0, op=op)])
    returning.record_end(10.0, 7.0)
    for _ in range(64):  # the durations are computed again after some batches
        returning.record_start([ticket("a", 11.0), ticket("b", 11.0)])
        returning.record_end(11.0, 0.1)
    assert returning.describe_costs() == before


@pytest.mark.parametrize("sizes", [[16], [4, 16], [2, 3, 16], [1, 16]])
def test_batches_smaller_than_all_that_ran_are_not_taken_for_slower(sizes: list[int]) -> None:
    cost = BatchCost()
    for size in sizes:
        assert cost.add(size, 0.02 + 0.01 * size)
        assert not cost.add(size, 0.02 + 0.01 * size)
    curve = cost.curve(16)
    assert curve is not None
    assert curve.cost_s(16) == pytest.approx(0.18)
    expected = 0.18 / 16 if len(sizes) == 1 else 0.03
    assert curve.cost_s(1) == pytest.approx(expected)
    assert len(curve.table) == len({1, *sizes})
