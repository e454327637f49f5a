"""Moves of sessions between replicas, without Ray: a session never exists twice, is never lost, and
an older state never replaces a newer one.
"""

from __future__ import annotations

import asyncio
import contextlib
import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from eval_fakes import wait_for
from in_flight import ask as ask_of
from in_flight import send
from in_process_replicas import Replicas, export

from vlagents_ray import Act, Agent, Obs
from vlagents_ray.errors import DeadlineExceeded, OutcomeUnknown, UnknownSession
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import Sender
from vlagents_ray.serve.requests import PendingRequest
from vlagents_ray.serve.scaling import session_migration
from vlagents_ray.serve.scaling.session_migration import HeldSessions, Peer
from vlagents_ray.serve.weights import Rest


class Counting(Agent):
    """A policy that returns its instruction and its number of acts, and waits at a gate if the
    observation requests it.
    """

    gate = threading.Event()
    entered: queue.SimpleQueue[str] = queue.SimpleQueue()

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.instruction, self.acts = instruction, 0
        self._wait(kwargs.get("wait"))
        return {}

    def act(self, obs: Obs) -> Act:
        self.acts += 1
        self._wait(obs.info.get("wait"))
        return Act(np.array([self.acts], np.float32), info={"obeys": self.instruction})

    def _wait(self, wait: Any) -> None:
        if wait:
            self.entered.put("")
            assert self.gate.wait(20)


@pytest.fixture
def replicas() -> Iterator[Callable[[int], Replicas]]:
    made: list[Replicas] = []
    Counting.gate.clear()
    Counting.entered = queue.SimpleQueue()

    def make(n: int) -> Replicas:
        made.append(Replicas([Counting() for _ in range(n)]))
        return made[-1]

    yield make
    Counting.gate.set()
    for each in made:
        each.close()


def begin(
    engine: Engine, op: Any, name: str = "robot-1", wait: bool = False, **fields: Any
) -> queue.SimpleQueue[Reply]:
    """Send a request like a plain HTTP client, and return the queue of the answer."""
    replies: queue.SimpleQueue[Reply] = queue.SimpleQueue()
    obs = Obs(info={"wait": True} if wait and op == "act" else {})
    if wait and op == "reset":
        fields["kwargs"] = {"wait": True}
    sender = Sender(engine, "http", name, connected=False, caller=NoKey.OPEN, has_left=None)
    send(sender, [Request(op, obs, **fields)], lambda answers: replies.put(answers[0]))
    return replies


def ask(engine: Engine, op: Any, name: str = "robot-1", **fields: Any) -> Reply:
    return begin(engine, op, name, **fields).get(timeout=20)


def obeys(engine: Engine, name: str = "robot-1") -> tuple[str, int]:
    reply = ask(engine, "act", name)
    if reply.error is not None:
        raise reply.error
    return reply.act.info["obeys"], int(reply.act.action[0])


def serve(replicas: Replicas, number: int, method: str, *args: Any) -> Any:
    """Call a method of a replica as another replica does."""
    work = getattr(HeldSessions, method)(replicas.migrators[number].sessions, *args)
    return asyncio.run_coroutine_threadsafe(work, replicas._loop).result(20)


@contextlib.contextmanager
def slow(engine: Engine, step: str) -> Iterator[tuple[queue.SimpleQueue[str], threading.Event]]:
    """Delay a step of taking over a session until the event is set. The queue receives an item when
    the step begins.
    """
    begun, release, work = queue.SimpleQueue[str](), threading.Event(), getattr(engine.moves, step)

    def waits(*args: Any) -> Any:
        begun.put("")
        assert release.wait(20)
        return work(*args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine.moves, step, waits)
        yield begun, release
        release.set()


def cut_off(replicas: Replicas) -> None:
    """Prevent all communication between the replicas."""

    async def nobody() -> Sequence[Peer]:
        return []

    for number in range(len(replicas.engines)):
        replicas.migrators[number]._peers = nobody


def test_an_older_episode_never_takes_the_place_of_a_newer_one_which_takes_its(
    replicas: Callable[[int], Replicas],
) -> None:
    served = replicas(3)
    cut_off(served)
    a, b, c = served.engines
    for engine in (a, c):
        ask(engine, "reset", instruction="episode 1")
    ask(b, "reset", instruction="episode 2")
    state = export(a, "robot-1")
    assert state is not None
    with pytest.raises(UnknownSession, match="newer"):
        b.moves.adopt("robot-1", state)
    assert obeys(b) == ("episode 2", 1)
    newer = export(b, "robot-1")
    assert newer is not None
    c.moves.adopt("robot-1", newer)
    assert obeys(c) == ("episode 2", 2)


def test_a_reset_under_way_is_not_overtaken_by_what_it_ends(
    replicas: Callable[[int], Replicas],
) -> None:
    served = replicas(2)
    cut_off(served)
    a, b = served.engines
    ask(a, "reset", instruction="episode 1")
    answers = begin(b, "reset", instruction="episode 2", wait=True)
    Counting.entered.get(timeout=20)
    state = export(a, "robot-1")
    assert state is not None
    with pytest.raises(UnknownSession):
        b.moves.adopt("robot-1", state)
    Counting.gate.set()
    assert answers.get(timeout=20).error is None
    assert obeys(b) == ("episode 2", 1)


@pytest.mark.parametrize("first", ["the late reset", "the newer episode"])
def test_a_reset_that_comes_late_ends_no_newer_episode(
    replicas: Callable[[int], Replicas], first: str
) -> None:
    """The newer episode survives, whichever of the two resets the replica handles first. Acts of
    the late episode are rejected.
    """
    served = replicas(2)
    cut_off(served)
    a, b = served.engines
    b.weights.rest(Rest("sleep", offload=False))  # requests wait
    late = begin(b, "reset", instruction="given up")
    ask(a, "reset", instruction="episode 2")
    state = export(a, "robot-1")
    assert state is not None
    if first == "the newer episode":
        b.moves.adopt("robot-1", state)
        b.weights.rest(Rest("wake"))
        assert isinstance(late.get(timeout=20).error, UnknownSession)
    else:
        with slow(b, "enter") as (begun, release):
            arrival = threading.Thread(target=b.moves.adopt, args=("robot-1", state))
            arrival.start()
            begun.get(timeout=20)
            b.weights.rest(Rest("wake"))
            reply = late.get(timeout=20)
            release.set()
            arrival.join(20)
        assert reply.error is None
        assert isinstance(ask(b, "act", step=reply.step).error, UnknownSession)
    assert [obeys(b), obeys(b)] == [("episode 2", 1), ("episode 2", 2)]


def test_a_session_that_was_closed_does_not_come_back(replicas: Callable[[int], Replicas]) -> None:
    served = replicas(2)
    cut_off(served)
    a, b = served.engines
    ask(a, "reset", instruction="episode 1")
    state = export(a, "robot-1")
    assert state is not None
    b.moves.adopt("robot-1", state)
    ask(b, "act")
    ask(b, "close")
    with pytest.raises(UnknownSession, match="newer"):
        b.moves.adopt("robot-1", state)
    assert len(b.sessions) == 0


def test_where_a_session_is_reset_the_others_forget_it(replicas: Callable[[int], Replicas]) -> None:
    served = replicas(3)
    for engine in served.engines:
        ask(engine, "reset", instruction="an episode")
    wait_for(lambda: [len(engine.sessions) for engine in served.engines] == [0, 0, 1])
    ask(served.engines[2], "reset", instruction="the next one")
    assert obeys(served.engines[0]) == ("the next one", 1)


def test_an_act_after_a_reset_is_of_the_new_episode_at_every_replica(
    replicas: Callable[[int], Replicas],
) -> None:
    """This also holds at a replica with the old episode, for a client that sends no step and acts
    at once.
    """
    served = replicas(3)
    for number in range(12):
        ask(served.engines[number % 3], "reset", instruction=f"episode {number}")
        # The replica with the old episode acts first.
        acting = [served.engines[(number + further) % 3] for further in (2, 1, 0)]
        assert [obeys(engine) for engine in acting] == [
            (f"episode {number}", acts) for acts in (1, 2, 3)
        ]


def test_a_replica_that_does_not_answer_delays_a_reset_only_a_little(
    replicas: Callable[[int], Replicas],
) -> None:
    served = replicas(2)
    served.frozen.add(1)
    assert ask(served.engines[0], "reset", instruction="episode 1").error is None


def test_a_reset_at_the_only_replica_does_not_wait_for_further_resets_to_announce(
    replicas: Callable[[int], Replicas], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session_migration, "_GATHER_S", 60.0)
    answers = begin(replicas(1).engines[0], "reset", instruction="episode 1")
    assert answers.get(timeout=20).error is None


@pytest.mark.parametrize("gather_s", [0.0, 60.0])
def test_a_reset_is_answered_if_its_replica_stops_meanwhile(
    replicas: Callable[[int], Replicas], gather_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The replica stops before or after it has queried the other replicas, one of which does not
    answer.
    """
    monkeypatch.setattr(session_migration, "_GATHER_S", gather_s)
    monkeypatch.setattr(session_migration, "_OTHERS_S", 60.0)
    served = replicas(2)
    served.frozen.add(1)
    answers = begin(served.engines[0], "reset", instruction="episode 1")
    migrator = served.migrators[0]
    wait_for(
        lambda: migrator._tasks and bool(migrator._unannounced) == bool(gather_s), every_s=0.001
    )
    asyncio.run_coroutine_threadsafe(served.migrators[0].close(), served._loop).result(20)
    assert answers.get(timeout=20).error is None


def test_clocks_that_differ_do_not_make_an_episode_old_that_its_client_knows_to_be_new(
    replicas: Callable[[int], Replicas],
) -> None:
    served = replicas(2)
    cut_off(served)
    a, b = served.engines
    a.sessions._clock = lambda: 2 * 10**18
    step = ask(a, "reset", instruction="episode 1").step
    newer = ask(b, "reset", instruction="episode 2", step=step).step
    assert step is not None
    assert newer is not None
    assert newer > step
    assert isinstance(ask(a, "act", step=newer).error, UnknownSession)
    assert ask(b, "act", step=newer).error is None


def test_of_two_states_that_a_fault_left_the_newest_moves(
    replicas: Callable[[int], Replicas],
) -> None:
    served = replicas(3)
    a, b, c = served.engines
    peers = served.migrators[0]._peers, served.migrators[1]._peers
    cut_off(served)
    for engine, text in ((a, "old"), (b, "new")):
        ask(engine, "reset", instruction=text)
    served.migrators[0]._peers, served.migrators[1]._peers = peers
    served.migrators[2]._peers = lambda: served._others(2)
    assert obeys(c) == ("new", 1)
    wait_for(lambda: len(a.sessions) == 0)
    assert len(b.sessions) == 0


@pytest.mark.slow
def test_a_session_whose_export_takes_too_long_stays(
    replicas: Callable[[int], Replicas], monkeypatch: pytest.MonkeyPatch
) -> None:
    served = replicas(2)
    a, b = served.engines
    monkeypatch.setattr(session_migration, "EXPORT_S", 0.1)
    ask(a, "reset", instruction="episode 1")
    ask(a, "reset", "other")
    busy = begin(a, "act", "other", wait=True)
    Counting.entered.get(timeout=20)
    assert isinstance(ask(b, "act").error, UnknownSession)
    version = a.sessions.versions_of(["robot-1"])["robot-1"]
    assert serve(served, 0, "release", "robot-1", version, "claim") is False
    Counting.gate.set()
    assert busy.get(timeout=20).error is None
    assert obeys(a) == ("episode 1", 1)


def test_a_release_that_the_policy_has_begun_is_answered_however_long_it_takes(
    replicas: Callable[[int], Replicas], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise the session would exist at no replica."""
    served = replicas(2)
    a, b = served.engines
    ask(a, "reset", instruction="episode 1")
    release, cancel, cancelled = a.sessions.release, a.queue.cancel, queue.SimpleQueue[bool]()

    def slow_release(*args: Any) -> bool:
        Counting.entered.put("")
        assert Counting.gate.wait(20)
        return release(*args)

    def record_cancel(pending: PendingRequest) -> bool:
        was_cancelled = cancel(pending)
        cancelled.put(was_cancelled)
        return was_cancelled

    monkeypatch.setattr(a.sessions, "release", slow_release)
    monkeypatch.setattr(a.queue, "cancel", record_cancel)
    monkeypatch.setattr(session_migration, "EXPORT_S", 0.5)
    act = begin(b, "act")
    Counting.entered.get(timeout=20)
    assert cancelled.get(timeout=20) is False
    Counting.gate.set()
    assert act.get(timeout=20).act.info["obeys"] == "episode 1"


def test_an_act_that_joins_a_search_is_not_answered_from_older_answers(
    replicas: Callable[[int], Replicas],
) -> None:
    """The session has acted at its replica after the replica sent its state."""
    served = replicas(2)
    a, b = served.engines
    first = ask(a, "reset", instruction="episode 1").step
    held, copied, go_on = served.migrators[0].sessions, threading.Event(), threading.Event()
    copy = held.copy

    async def slow_copy(*args: Any) -> Any:
        state = await copy(*args)
        copied.set()
        assert await asyncio.to_thread(go_on.wait, 20)
        return state

    held.copy = slow_copy  # type: ignore[method-assign]
    given_up = begin(b, "act", step=first + 7)  # no state has this step
    assert copied.wait(20)
    second = ask(a, "act", step=first).step
    joined = begin(b, "act", step=second)
    go_on.set()
    assert isinstance(given_up.get(timeout=20).error, UnknownSession)
    reply = joined.get(timeout=20)
    assert reply.error is None
    assert int(reply.act.action[0]) == 2


def test_a_session_that_goes_on_while_it_is_copied_is_not_released(
    replicas: Callable[[int], Replicas],
) -> None:
    served = replicas(2)
    a, _ = served.engines
    ask(a, "reset", instruction="episode 1")
    state = serve(served, 0, "copy", "robot-1")
    assert obeys(a) == ("episode 1", 1)
    assert serve(served, 0, "release", "robot-1", state.version, "claim") is False
    assert obeys(a) == ("episode 1", 2)


def test_what_comes_twice_or_late_changes_nothing(replicas: Callable[[int], Replicas]) -> None:
    served = replicas(3)
    a, b, c = served.engines
    ask(a, "reset", instruction="episode 1")
    state = serve(served, 0, "copy", "robot-1")
    assert serve(served, 1, "take_over", "robot-1", "0") is True
    assert serve(served, 0, "release", "robot-1", state.version, "late") is False
    assert serve(served, 1, "take_over", "robot-1", "0") is False  # the session is no longer there
    assert [len(engine.sessions) for engine in (a, b, c)] == [0, 1, 0]
    assert obeys(c) == ("episode 1", 1)  # fetched from the second replica
    with pytest.raises(UnknownSession, match="newer"):
        b.moves.adopt("robot-1", state)
    assert [len(engine.sessions) for engine in (a, b, c)] == [0, 0, 1]
    returned = serve(served, 2, "copy", "robot-1")
    assert serve(served, 2, "release", "robot-1", returned.version, "one") is True
    assert serve(served, 2, "release", "robot-1", returned.version, "another") is False
    assert serve(served, 2, "release", "robot-1", returned.version, "one") is True
    a.moves.adopt("robot-1", returned)
    serve(served, 0, "release", "robot-1", state.version, "one")
    assert obeys(a) == ("episode 1", 2)


def test_a_slow_replica_that_was_given_a_session_is_waited_for(
    replicas: Callable[[int], Replicas],
) -> None:
    served = replicas(3)
    a, b, c = served.engines
    for number in range(20):
        ask(a, "reset", f"robot-{number}", instruction=f"{number}")
    with slow(b, "prepare") as (begun, release):
        given = threading.Thread(target=served.hand_over, args=[0])
        given.start()
        wait_for(lambda: len(c.sessions) == 10 and begun.qsize() > 3)  # several sessions at a time
        release.set()
        given.join(20)
    assert [len(engine.sessions) for engine in (a, b, c)] == [0, 10, 10]
    for number in range(20):
        engine = b if f"robot-{number}" in b.sessions else c
        assert obeys(engine, f"robot-{number}") == (f"{number}", 1)


@pytest.mark.slow
def test_no_request_waits_for_a_replica_that_hangs_while_it_is_to_release_a_session(
    replicas: Callable[[int], Replicas], monkeypatch: pytest.MonkeyPatch
) -> None:
    served = replicas(2)
    a, b = served.engines
    ask(a, "reset", instruction="episode 1")
    monkeypatch.setattr(session_migration, "_ANSWER_S", 1.0)
    hangs, ends = threading.Event(), threading.Event()
    old = served.migrators[0].sessions
    release, held = old.release, old.versions_of

    async def hang() -> None:
        while hangs.is_set() and not ends.is_set():
            await asyncio.sleep(0.01)

    async def released(*args: Any) -> bool:
        hangs.set()
        await hang()
        return await release(*args)

    async def answered(*args: Any) -> Any:
        await hang()
        return await held(*args)

    monkeypatch.setattr(old, "release", released)
    monkeypatch.setattr(old, "versions_of", answered)
    try:
        # After this error a client begins its episode again.
        assert isinstance(ask(b, "act").error, UnknownSession)
        assert [len(engine.sessions) for engine in (a, b)] == [1, 0], "the copy still waits"
    finally:
        ends.set()
    wait_for(lambda: [len(engine.sessions) for engine in (a, b)] == [0, 1])
    assert obeys(b) == ("episode 1", 1)


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["dead", "frozen"])
@pytest.mark.parametrize("silent_s", [0.0, 60.0])
def test_no_search_asks_a_replica_that_was_silent_a_moment_ago(
    replicas: Callable[[int], Replicas],
    fault: str,
    silent_s: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(session_migration, "_ANSWER_S", 1.0)
    monkeypatch.setattr(session_migration, "_SILENT_S", silent_s)
    served = replicas(3)
    a, b, c = served.engines
    ask(b, "reset", name="robot-b", instruction="at b")
    ask(c, "reset", name="robot-c", instruction="at c")

    at_fault: set[int] = getattr(served, fault)
    at_fault.add(1)
    assert isinstance(ask(a, "act", "robot-b").error, UnknownSession)
    at_fault.clear()

    assert obeys(a, "robot-c") == ("at c", 1), "replicas that answer are queried at once"
    if silent_s:
        assert isinstance(ask(a, "act", "robot-b").error, UnknownSession)
        assert "robot-b" in b.sessions
    else:
        assert obeys(a, "robot-b") == ("at b", 1)


def test_a_session_on_its_way_to_another_replica_is_waited_for(
    replicas: Callable[[int], Replicas],
) -> None:
    served = replicas(3)
    a, b, c = served.engines
    ask(a, "reset", instruction="episode 1")
    with slow(b, "prepare") as (begun, release):
        given = threading.Thread(target=served.hand_over, args=[0])
        given.start()
        begun.get(timeout=20)
        answer = begin(c, "act")
        threading.Timer(0.5, release.set).start()
        assert answer.get(timeout=20).error is None
        given.join(20)
    assert [len(engine.sessions) for engine in (a, b, c)] == [0, 0, 1]


def test_an_act_whose_deadline_passed_while_its_session_was_fetched_is_not_executed(
    replicas: Callable[[int], Replicas],
) -> None:
    served = replicas(2)
    a, b = served.engines
    ask(a, "reset", instruction="episode 1")
    with slow(b, "prepare") as (_, release):

        async def late(timed: bool) -> list[Reply]:
            request = Request("act", Obs(), deadline_ms=50)
            sender = Sender(b, "http", "robot-1", connected=False, caller=NoKey.OPEN, has_left=None)
            if timed:  # like HTTP and the proxied WebSocket
                return await ask_of(sender, [request])
            # Like shared memory and the replica's own port.
            answers: queue.SimpleQueue[list[Reply]] = queue.SimpleQueue()
            send(sender, [request], answers.put)
            await asyncio.sleep(0.1)
            release.set()
            return answers.get(timeout=20)

        for timed in (True, False):
            [reply] = asyncio.run(late(timed))
            assert isinstance(reply.error, DeadlineExceeded)
            assert not isinstance(reply.error, OutcomeUnknown)
    wait_for(lambda: "robot-1" in b.sessions)
    assert obeys(b) == ("episode 1", 1)


def test_an_act_whose_client_has_gone_while_its_session_was_fetched_is_not_executed(
    replicas: Callable[[int], Replicas],
) -> None:
    a, b = replicas(2).engines
    ask(a, "reset", instruction="episode 1")
    with slow(b, "prepare") as (begun, release):

        async def go() -> None:
            sender = Sender(b, "http", "robot-1", connected=False, caller=NoKey.OPEN, has_left=None)
            # This request has no deadline.
            asked = asyncio.create_task(ask_of(sender, [Request("act", Obs())]))
            await asyncio.to_thread(begun.get, timeout=20)
            asked.cancel()
            await asyncio.wait([asked])
            release.set()

        asyncio.run(go())
    wait_for(lambda: "robot-1" in b.sessions)
    assert [obeys(b) for _ in range(3)] == [("episode 1", 1), ("episode 1", 2), ("episode 1", 3)]


def test_an_act_that_was_begun_before_its_deadline_is_said_to_be(
    replicas: Callable[[int], Replicas],
) -> None:
    engine = replicas(1).engines[0]
    ask(engine, "reset", instruction="episode 1")

    async def late(wait: bool) -> Reply:
        request = Request("act", Obs(info={"wait": wait}), deadline_ms=50)
        [reply] = await ask_of(
            Sender(engine, "http", "robot-1", connected=False, caller=NoKey.OPEN, has_left=None),
            [request],
        )
        return reply

    # On a busy machine the deadline may pass before the policy begins.
    while Counting.entered.empty():
        reply = asyncio.run(late(True))
    assert isinstance(reply.error, OutcomeUnknown)
    assert type(asyncio.run(late(False)).error) is DeadlineExceeded
    Counting.gate.set()
    assert obeys(engine) == ("episode 1", 2)


def test_made_up_sessions_keep_no_other_from_moving(
    replicas: Callable[[int], Replicas], monkeypatch: pytest.MonkeyPatch
) -> None:
    served = replicas(2)
    a, b = served.engines
    ask(a, "reset", instruction="episode 1")
    questions: list[int] = []
    held = a.sessions.versions_of

    def counted(names: Any) -> Any:
        questions.append(len(names))
        return held(names)

    monkeypatch.setattr(a.sessions, "versions_of", counted)
    made_up = [Request("act", Obs(), session=f"none-{i}") for i in range(400)]
    answers: queue.SimpleQueue[list[Reply]] = queue.SimpleQueue()
    sender = Sender(b, "websocket", "x", connected=True, caller=NoKey.OPEN, has_left=None)
    send(
        sender, [Request("reset", Obs()), *made_up], answers.put
    )  # the message begins with a reset of its own session, without which it may not act
    assert obeys(b) == ("episode 1", 1)
    replies = answers.get(timeout=20)
    assert sum(isinstance(reply.error, UnknownSession) for reply in replies) == 400
    assert len(questions) < 40, "each search sent separate queries"


def test_who_looks_for_too_many_sessions_is_refused_alone(
    replicas: Callable[[int], Replicas], monkeypatch: pytest.MonkeyPatch
) -> None:
    served = replicas(2)
    monkeypatch.setattr(session_migration, "_PENDING", 3)
    migrator, searched, answer = served.migrators[1], threading.Semaphore(0), threading.Event()
    peers = migrator._peers

    async def when_told() -> Sequence[Peer]:
        while not answer.is_set():
            await asyncio.sleep(0.01)
        return await peers()

    migrator._peers = when_told
    assert [migrator.fetch(f"none-{i}", searched.release, "one") for i in range(5)] == [
        True
    ] * 3 + [False] * 2
    assert migrator.fetch("none-0", searched.release, "another")
    answer.set()
    for _ in range(4):
        assert searched.acquire(timeout=20)
    assert migrator.fetch("none-5", searched.release, "one")
    assert searched.acquire(timeout=20)
