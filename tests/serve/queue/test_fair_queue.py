"""The order in which waiting requests are passed to the policy."""

from __future__ import annotations

import math
import random
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence

import pytest
from gain_policies import Gain
from hypothesis import given, settings
from hypothesis import strategies as st
from in_flight import AnySession, ignore, message_of_one, pending, send
from in_memory_keys import ChangingKeys

from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.protocol.messages import Priority, Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import Sender
from vlagents_ray.serve.queue import batch_queue
from vlagents_ray.serve.queue.batch_queue import BatchQueue
from vlagents_ray.serve.queue.fair_queue import BEHIND_OTHERS_S, PATIENCE_S, FairQueue
from vlagents_ray.serve.queue.robots_load import IDLE, Room
from vlagents_ray.serve.requests import Origin, PendingRequest


def ticket(
    session: str, *, owner: str = "", priority: Priority = Priority.SIMULATION, arrived: float = 0.0
) -> PendingRequest:
    origin = Origin(connection=owner)
    return PendingRequest(
        session, Request("act"), message_of_one(), priority, arrived, origin=origin
    )


def filled(*tickets: PendingRequest) -> FairQueue:
    waiting = FairQueue()
    for one in tickets:
        waiting.add(one)
    return waiting


def bundle(owner: str, size: int) -> list[PendingRequest]:
    return [ticket(f"{owner}{i}", owner=owner) for i in range(size)]


def taken(waiting: FairQueue, size: int = 16, now: float = 0.0) -> list[str]:
    return [one.session_id for one in waiting.take(size, now)[0]]


@pytest.mark.parametrize("others", [0, 1])
def test_sessions_that_wait_are_counted_and_found_also_if_there_is_only_one(others: int) -> None:
    requests = [ticket(f"env{i}") for i in range(1 + others)]
    waiting = filled(*requests)
    assert waiting.sessions == 1 + others
    assert waiting.heads() == requests
    assert "env0" in waiting
    assert waiting.sessions == 1 + others


def test_a_large_bundle_delays_others_by_no_more_than_a_batch() -> None:
    waiting = filled(*bundle("learner", 512), *(ticket(f"env{i}") for i in range(10)))
    first = taken(waiting)
    assert {f"env{i}" for i in range(10)} <= set(first)
    assert len(first) == 16


@pytest.mark.parametrize("connected", [False, True])
@pytest.mark.parametrize("named", [False, True])
def test_keys_with_equal_names_of_sessions_have_turns_of_their_own(
    connected: bool, named: bool
) -> None:
    """Many sessions of another key, whose connection has the same name as the robot's, delay the
    robot by at most one batch.
    """
    keys, engine = ChangingKeys(), Engine(Gain())
    waiting = FairQueue()

    def submit(requests: Sequence[PendingRequest]) -> None:
        for request in requests:
            waiting.add(request)

    engine.intake.submit = submit  # type: ignore[method-assign]
    tokens = {key: keys.add(key) for key in ("other", "own")}

    def act(key: str, session: str) -> None:
        caller = keys.keys.check(tokens[key], "app")
        sender = Sender(
            engine, "http", "robot-1", caller=caller, has_left=None, connected=connected
        )
        send(sender, [Request("act", session=session)], ignore)

    for number in range(64):
        act("other", f"env-{number}")
    act("own", "robot-1" if named else "")
    assert "own/robot-1" in taken(waiting, 2)


def test_alone_a_bundle_fills_the_batch_in_its_order() -> None:
    waiting = filled(*bundle("a", 20))
    assert taken(waiting) == [f"a{i}" for i in range(16)]
    assert taken(waiting) == [f"a{i}" for i in range(16, 20)]


def test_bundles_share_batches_evenly() -> None:
    waiting = filled(*bundle("a", 512), *bundle("b", 40), *bundle("c", 512))
    for _ in range(5):
        counts = Counter(name[0] for name in taken(waiting))
        assert max(counts.values()) - min(counts.values()) <= 1


def test_the_turn_goes_on_where_the_last_batch_ended() -> None:
    waiting = filled(*(one for owner in "abc" for one in bundle(owner, 4)))
    assert taken(waiting, 2) == ["a0", "b0"]
    assert taken(waiting, 2) == ["c0", "a1"]


def test_pipelined_requests_of_one_session_take_one_slot_of_a_batch() -> None:
    waiting = filled(*(ticket("fast") for _ in range(100)), ticket("slow"))
    assert taken(waiting) == ["fast", "slow"]
    assert taken(waiting) == ["fast"]
    assert waiting.size == 98


def test_simulations_get_the_slots_that_robots_leave() -> None:
    waiting = filled(*(ticket(f"s{i}") for i in range(4)), ticket("r", priority=Priority.ROBOT))
    assert taken(waiting, 3) == ["r", "s0", "s1"]


def test_robots_without_end_do_not_starve_simulations() -> None:
    waiting, served, now = filled(ticket("s0"), ticket("s1")), [], 0.0
    for _ in range(60):
        waiting.add(ticket("r0", priority=Priority.ROBOT, arrived=now))
        waiting.add(ticket("r1", priority=Priority.ROBOT, arrived=now))
        now += 0.05
        served.append(taken(waiting, 1, now))
        if now <= PATIENCE_S:
            assert served[-1][0].startswith("r")
    order = [name for batch in served for name in batch]
    assert {"s0", "s1"} <= set(order)
    # A robot is served in between, even if a batch has only one row.
    assert order.index("s1") - order.index("s0") == 2


@settings(max_examples=100)
@given(st.integers(0, 2**32), st.integers(1, 9))
def test_every_ticket_is_taken_once_and_in_its_sessions_order(seed: int, size: int) -> None:
    choose = random.Random(seed)
    waiting, put, got = FairQueue(), defaultdict(list), defaultdict(list)
    for _ in range(200):
        if choose.random() < 0.7:
            name = f"s{choose.randrange(6)}"
            one = ticket(name, owner=f"o{int(name[1]) % 3}", priority=Priority(choose.randrange(2)))
            put[name].append(one)
            waiting.add(one)
        else:
            batch, _ = waiting.take(size, 0.0)
            assert len({one.session_id for one in batch}) == len(batch) <= size
            for one in batch:
                got[one.session_id].append(one)
    while waiting.size:
        for one in waiting.take(size, 0.0)[0]:
            got[one.session_id].append(one)
    assert {name: list(map(id, some)) for name, some in put.items()} == {
        name: list(map(id, some)) for name, some in got.items()
    }
    assert waiting.depth == [0, 0]


def test_a_simulation_that_is_over_does_not_take_the_turn_of_one_that_waits() -> None:
    waiting = filled(gone := ticket("gone"), ticket("waits"))
    for i in range(8):
        waiting.add(ticket(f"robot{i}", priority=Priority.ROBOT, arrived=PATIENCE_S))
    gone.over = True
    assert taken(waiting, 2, 2 * PATIENCE_S) == ["robot0", "robot1"]
    assert taken(waiting, 2, 2 * PATIENCE_S)[0] == "waits"


# The queue of an engine.


@pytest.fixture
def queue() -> Iterator[Callable[[int], BatchQueue]]:
    made: list[BatchQueue] = []

    def make(max_batch_size: int) -> BatchQueue:
        made.append(BatchQueue(max_batch_size, sessions=AnySession()))
        made[-1].bind()
        return made[-1]

    yield make
    for one in made:
        one.poller.close()


def put(queue: BatchQueue, name: str, **fields: float) -> PendingRequest:
    one = pending(name, Request("act", request_id=name, **fields), lambda _: None)  # type: ignore[arg-type]
    queue.put(one)
    return one


def test_a_lone_request_does_not_wait_for_others(queue: Callable[[int], BatchQueue]) -> None:
    waiting = queue(4)
    put(waiting, "a")
    taken = waiting.next()
    assert len(taken.batch) == 1


def test_a_request_that_expired_or_was_given_up_never_reaches_the_policy(
    queue: Callable[[int], BatchQueue],
) -> None:
    waiting = queue(4)
    late = put(waiting, "late", deadline_ms=1.0)
    late.deadline -= 1.0
    waiting.withdraw(put(waiting, "gone"))
    put(waiting, "good")
    taken = waiting.take()
    assert [one.request.request_id for one in taken.batch] == ["good"]
    assert taken.expired == [late]


def test_who_waits_when_it_closes_is_given_back(queue: Callable[[int], BatchQueue]) -> None:
    waiting = queue(4)
    one = put(waiting, "waiting")
    assert waiting.close() == [one]
    assert waiting.next() is None
    with pytest.raises(PolicyUnavailable):
        put(waiting, "after")


def test_the_time_spent_waiting_for_requests_counts_as_idle() -> None:
    quiet = BatchQueue(1, sessions=AnySession(), idle_s=0.05)
    quiet.bind()
    before_s, began = quiet.load_s()[0], time.perf_counter()
    assert quiet.next() == ([], []), "the queue's thread returns after a long time without requests"
    assert 0.05 <= quiet.load_s()[0] - before_s <= time.perf_counter() - began
    quiet.poller.close()


def test_held_requests_wait_for_a_robot_and_the_queue_counts_as_busy(
    queue: Callable[[int], BatchQueue], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch_queue, "_HELD_S", 0.05)
    waiting = queue(4)
    waiting.room = Room(4, 0, 0, 5.0, IDLE)
    simulation = ticket("env")
    waiting.put(simulation)
    idle_s = waiting.load_s()[0]
    assert waiting.next() == ([], []), "the needs of robots are read again"
    assert waiting.load_s()[0] == idle_s, "more replicas are needed"

    waiting._waiting._held_until = math.inf
    robot = urgent("robot", arrived=time.perf_counter())
    timer = threading.Timer(0.02, waiting.put, [robot])
    timer.start()
    assert waiting.next() == ([robot], [])
    timer.join()
    waiting.room = None
    assert waiting.next() == ([simulation], [])


def behind(session: str, *, arrived: float = 0.0) -> PendingRequest:
    """Return the request of a robot that is about to run out of rows, but waits behind others."""
    request = ticket(session, priority=Priority.ROBOT, arrived=arrived)
    request.needed = arrived + 1e-3
    request.waits_behind_others = True
    return request


def urgent(session: str, *, arrived: float = 0.0) -> PendingRequest:
    """Return the request of a robot that is about to run out of rows."""
    request = ticket(session, priority=Priority.ROBOT, arrived=arrived)
    request.needed = arrived + 1e-3
    return request


def test_a_lone_request_gives_the_next_impatient_simulation_its_slot() -> None:
    waiting = filled(ticket("env0"), ticket("robot0", priority=Priority.ROBOT))
    now = 2 * PATIENCE_S
    assert taken(waiting, 2, now) == ["env0", "robot0"]
    waiting.add(ticket("lone", priority=Priority.ROBOT, arrived=now))
    assert taken(waiting, 1, now) == ["lone"]
    waiting.add(ticket("env1"))
    waiting.add(ticket("robot1", priority=Priority.ROBOT, arrived=now))
    assert taken(waiting, 1, now) == ["env1"]


def test_robots_of_the_newest_episodes_wait_behind_all_others() -> None:
    waiting = FairQueue()
    waiting.costs_s = (0.0, 0.05, 0.06)
    patient = ticket("patient", priority=Priority.ROBOT)
    patient.needed = 9.0
    for request in (
        behind("late1"),
        behind("late2"),
        patient,
        ticket("without slack", priority=Priority.ROBOT),
        urgent("urgent"),
        ticket("env"),
    ):
        waiting.add(request)
    order = [taken(waiting, 1)[0] for _ in range(6)]
    assert order == ["urgent", "patient", "late1", "late2", "without slack", "env"]


@pytest.mark.parametrize("first", range(5))
@pytest.mark.parametrize("displaced", [0, 2])
@pytest.mark.parametrize(("alone", "beside"), [(0, 0), (0, 3), (2, 2), (4, 4)])
@pytest.mark.parametrize("kind", [Priority.ROBOT, Priority.SIMULATION])
def test_a_batch_is_filled_up_to_the_room_that_robots_leave(
    first: int, displaced: int, alone: int, beside: int, kind: Priority
) -> None:
    waiting = FairQueue()
    waiting.costs_s = (0.0, 0.05, 0.05, 0.05, 0.05)
    waiting.room = Room(3, alone, beside, 5.0, IDLE)
    waiting._held_until = math.inf
    for number in range(4):
        waiting.add(ticket(f"other{number}", priority=kind))
    for number in range(displaced):
        waiting.add(behind(f"displaced{number}"))
    for number in range(first):
        waiting.add(urgent(f"urgent{number}"))

    batch, _ = waiting.take(4, 0.0)
    robots = max(first, min(3, first + displaced))
    most = alone if robots == 0 else beside
    expected = robots if robots < first + displaced else max(robots, most)
    assert len(batch) == expected


@pytest.mark.parametrize("rows", range(1, 5))
@pytest.mark.parametrize("priority", list(Priority))
def test_no_other_row_makes_a_robot_late_that_is_otherwise_in_time(
    rows: int, priority: Priority
) -> None:
    waiting = FairQueue()
    waiting.costs_s = (0.0, 0.1, 0.2, 0.3, 0.4)
    robot = ticket("robot", priority=Priority.ROBOT)
    robot.needed = waiting.costs_s[rows] + 0.05
    waiting.add(robot)
    for number in range(4):
        other = ticket(f"other{number}", priority=priority)
        other.needed = 9.0 if priority is Priority.ROBOT else 0.0
        waiting.add(other)
    assert len(taken(waiting, 4)) == rows


def test_a_held_request_is_added_to_a_batch_of_robots_now_and_then() -> None:
    waiting = FairQueue()
    waiting.costs_s = (0.0, 0.05, 0.06, 0.07, 0.08)
    waiting.room = Room(4, 0, 0, 5.0, IDLE)
    now, held = 0.0, 0
    for number in range(16):
        waiting.add(ticket(f"env{number}"))
    while now < 100.0:
        assert waiting.is_held(now)
        assert waiting.take(4, now) == ([], [])
        waiting.add(urgent("robot", arrived=now))
        assert not waiting.is_held(now)
        names = taken(waiting, 4, now)
        assert names[0] == "robot"
        held += len(names) - 1
        for name in names[1:]:
            waiting.add(ticket(name, arrived=now))
        now += waiting.costs_s[len(names)]
    assert 19 <= held <= 21, "one in 5 s"


def test_requests_are_no_longer_held_when_the_robots_have_left() -> None:
    waiting = filled(ticket("env"))
    waiting.costs_s = (0.0, 0.05)
    waiting.room = Room(1, 0, 0, 5.0, IDLE)
    assert waiting.is_held(0.0)
    assert waiting.had_others()
    waiting.room = None
    assert not waiting.is_held(0.0)
    assert taken(waiting, 1) == ["env"]


@pytest.mark.parametrize("has_slack", [True, False])
def test_no_robot_waits_behind_others_for_ever(has_slack: bool) -> None:
    waiting = FairQueue()
    waiting.costs_s = (0.0, 0.05)
    waiting.add(behind("late") if has_slack else ticket("late", priority=Priority.ROBOT))
    answered = []
    for second in range(1, 70):
        waiting.add(urgent(f"urgent{second}", arrived=float(second)))
        waiting.add(urgent(f"also{second}", arrived=float(second)))
        answered += [(name, second) for name in taken(waiting, 1, now=float(second))]
        answered += [(name, second) for name in taken(waiting, 1, now=float(second))]
    [when] = [second for name, second in answered if name == "late"]
    assert BEHIND_OTHERS_S <= when <= BEHIND_OTHERS_S + 2
