"""The thread that polls the local endpoints while the policy runs, and the events between two
batches.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from eval_fakes import wait_for
from in_flight import answered, pending
from open_resources import descriptors, running_threads

from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.messages import PriorityName, Reply, Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.queue import batch_queue
from vlagents_ray.serve.queue.poller import Poller

SLOW_S = 0.02  # the shortest batch that the queue considers slow


class _Policy(Agent):
    def __init__(self, test: Slow) -> None:
        self.test = test

    def __deepcopy__(self, memo: object) -> _Policy:
        return _Policy(self.test)

    def act_batch(self, obs: list[Obs], sessions: list[Agent]) -> list[Act]:  # type: ignore[override]
        gate = self.test.open
        self.test.events.append("batch " + " ".join(sorted(one.info["name"] for one in obs)))
        self.test.busy.set()
        time.sleep(SLOW_S)
        assert gate.wait(10)
        return [Act(np.zeros(1))] * len(obs)


NAMES = ("a", "b", "c", "d", "e", "f", "r", "robot", "heard", "other")


class Slow:
    """A policy whose batches take at least `SLOW_S`, and then wait while the gate is closed, with
    its engine and queue.
    """

    def __init__(self, size: int = 2, patience: float = 0.0) -> None:
        self.events: list[str] = []
        self.open = threading.Event()
        self.open.set()
        self.busy = threading.Event()
        self.answered_by: dict[str, str] = {}  # name of the answering thread, by session
        self.engine = Engine(_Policy(self), EngineSettings(max_batch_size=size, patience=patience))
        self.queue = self.engine.queue

    def start(self) -> None:
        self.engine.start()
        for name in NAMES:
            reset = Request("reset", Obs(), priority="simulation")
            assert answered(self.engine, name, reset).error is None

    def put(self, *sessions: str, priority: PriorityName = "simulation") -> None:
        """Queue one request of each session at the same time."""

        def done(session: str) -> Callable[[Reply], None]:
            def note(reply: Reply) -> None:
                self.answered_by[session] = threading.current_thread().name.partition("_")[0]
                self.events.append(f"{'answer' if reply.error is None else 'error'} {session}")

            return note

        self.engine.intake.submit(
            [
                pending(s, Request("act", Obs(info={"name": s}), priority=priority), done(s))
                for s in sessions
            ]
        )

    def called(self, *events: str) -> bool:
        """Return whether these events have happened."""
        return set(events) <= set(self.events)

    def learn(self, *sessions: str) -> None:
        """Let the queue measure that the policy is slow, and that these sessions return together
        immediately.
        """
        for _ in range(3):
            self.events.clear()
            self.put(*sessions)
            wait_for(lambda: self.called(*(f"answer {s}" for s in sessions)))
        self.events.clear()

    def hold(self, *sessions: str) -> None:
        """Begin a batch of these sessions, which runs until `open` is set."""
        self.open.clear()
        self.busy.clear()
        self.put(*sessions)
        assert self.busy.wait(10)


@pytest.fixture
def slow() -> Iterator[Callable[..., Slow]]:
    made: list[Slow] = []

    def make(**options: float) -> Slow:
        made.append(Slow(**options))  # type: ignore[arg-type]
        return made[-1]

    yield make
    for one in made:
        one.open.set()
        one.engine.close()
        assert not one.engine.health.alive


def test_messages_are_heard_beside_a_batch_and_never_on_two_threads_at_once(
    slow: Callable[..., Slow],
) -> None:
    one = slow()
    ours, theirs = socket.socketpair()
    threads: list[str] = []
    inside = threading.Lock()

    def ready() -> None:
        assert inside.acquire(blocking=False)
        ours.recv(1)
        threads.append(threading.current_thread().name)
        inside.release()

    one.queue.poller.watch(ours, ready)
    one.start()
    one.learn("a", "b")
    theirs.send(b"x")
    wait_for(lambda: threads == ["policy"])
    one.hold("a", "b")
    theirs.send(b"x")
    wait_for(lambda: threads == ["policy", "policy-reader"])
    one.open.set()
    for _ in range(20):
        one.put("a", "b")
        for _ in range(10):
            theirs.send(b"x")
            time.sleep(0.001)
    wait_for(lambda: len(threads) == 202)
    theirs.close()
    one.engine.close()
    ours.close()


def test_nobody_listens_beside_a_lone_session(
    slow: Callable[..., Slow], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second thread polls only if a batch is long, which any batch may be on a busy machine."""
    monkeypatch.setattr(batch_queue, "_LONG_BATCH_S", 60.0)
    one, lent = slow(), list[str]()
    one.start()
    # On a busy machine the resets of the other sessions are slow enough for the second thread.
    one.learn("robot")
    monkeypatch.setattr(one.queue.poller, "hand_to_reader", lambda: lent.append("lent"))
    one.learn("robot")
    assert lent == []


def test_another_thread_listens_beside_a_long_batch_of_a_lone_session(
    slow: Callable[..., Slow],
) -> None:
    one, heard = slow(), threading.Event()
    ours, theirs = socket.socketpair()
    one.queue.poller.watch(ours, lambda: (ours.recv(1), heard.set()))
    one.start()
    one.learn("robot")
    one.hold("robot")
    theirs.send(b"x")
    assert heard.wait(60)
    one.open.set()
    wait_for(lambda: one.called("answer robot"))
    one.put("robot")  # now the policy's thread polls again
    theirs.close()
    one.engine.close()
    ours.close()


def test_timers_run_in_order_on_the_thread_that_polls_even_beside_a_batch(
    slow: Callable[..., Slow],
) -> None:
    one = slow()
    ran: list[tuple[str, str]] = []

    def set_timers(*delays: float) -> None:
        for delay_s in delays:
            one.queue.poller.call_later(
                delay_s, lambda s=delay_s: ran.append((f"{s:g}", threading.current_thread().name))
            )

    one.start()
    one.queue.poller.call_soon(lambda: set_timers(0.1, 0.05))
    wait_for(lambda: ran == [("0.05", "policy"), ("0.1", "policy")])
    one.learn("a", "b")
    one.hold("a", "b")
    one.queue.poller.call_soon(lambda: set_timers(0.2))
    wait_for(lambda: ran[2:] == [("0.2", "policy-reader")])
    one.open.set()
    wait_for(lambda: one.called("answer a", "answer b"))
    # The timer is set before the reader thread polls again.
    one.queue.poller.call_soon(lambda: set_timers(0.5))
    one.hold("a", "b")
    wait_for(lambda: len(ran) == 4)
    one.open.set()


def test_a_callback_may_end_its_watch_beside_a_batch(slow: Callable[..., Slow]) -> None:
    one = slow()
    ours, theirs = socket.socketpair()
    ended = threading.Event()

    def ready() -> None:
        one.queue.poller.unwatch(ours)
        ours.close()
        ended.set()

    one.queue.poller.watch(ours, ready)
    one.start()
    one.learn("a", "b")
    one.hold("a", "b")
    theirs.close()
    assert ended.wait(5)
    one.open.set()
    wait_for(lambda: one.called("answer a", "answer b"))


def test_answers_come_while_the_next_batch_runs_and_when_the_queue_closes(
    slow: Callable[..., Slow],
) -> None:
    one = slow()
    one.start()
    one.learn("a", "b")
    one.hold("a", "b")
    one.put("c", "d")
    one.busy.clear()
    gate, one.open = one.open, threading.Event()
    gate.set()
    assert one.busy.wait(5)
    wait_for(lambda: one.called("answer a", "answer b"))
    assert not one.called("answer c")
    one.put("e", "f")
    closer = threading.Thread(target=one.engine.close)
    closer.start()
    wait_for(lambda: one.queue._closed)
    one.open.set()
    closer.join(5)
    assert one.called("answer c", "answer d", "error e", "error f")


def test_a_robot_is_answered_before_the_next_batch(slow: Callable[..., Slow]) -> None:
    one = slow()
    one.start()
    one.learn("a", "b")
    one.open.clear()
    one.busy.clear()
    one.put("r", priority="robot")
    assert one.busy.wait(5)
    one.put("c", "d")
    one.open.set()
    wait_for(lambda: one.called("answer r", "answer c"))
    assert one.events.index("answer r") < one.events.index("batch c d")
    assert one.answered_by["r"] == "policy"


ENDLESS = 1e6  # times the duration of the last batch: a request waits until an event ends the wait


def test_a_batch_waits_for_the_rest_of_its_group_or_the_end(slow: Callable[..., Slow]) -> None:
    one = slow(size=8, patience=ENDLESS)
    one.start()
    one.learn("a", "b")
    one.put("a")
    wait_for(lambda: one.queue._gathering)
    assert one.events == []
    one.put("b")
    wait_for(lambda: one.called("answer a", "answer b"))
    assert one.events[0] == "batch a b"
    one.events.clear()
    one.put("a")
    wait_for(lambda: one.queue._gathering)
    one.engine.close()
    assert one.events == ["error a"]


def test_who_was_unwatched_a_moment_ago_is_not_called(caplog: pytest.LogCaptureFixture) -> None:
    """The callback that runs first removes the other socket, although both are ready."""
    poller = Poller()
    pairs = [socket.socketpair() for _ in range(2)]
    called: list[int] = []

    def ready(which: int) -> None:
        called.append(which)
        poller.unwatch(pairs[1 - which][0])

    for which, (ours, theirs) in enumerate(pairs):
        poller.watch(ours, lambda which=which: ready(which))  # type: ignore[misc]
        theirs.send(b"x")
    assert poller.poll(1)
    assert len(called) == 1
    poller.close()
    for pair in pairs:
        for one in pair:
            one.close()
    assert not caplog.records


def test_a_file_whose_callback_failed_is_not_polled_again(caplog: pytest.LogCaptureFixture) -> None:
    poller = Poller()
    ours, theirs = socket.socketpair()

    def fail() -> None:
        raise OSError("broken")

    poller.watch(ours, fail)
    theirs.send(b"x")
    assert poller.poll(1)
    assert "the callback of a watched file failed" in caplog.text
    assert not poller.poll(0)
    poller.close()
    ours.close()
    theirs.close()


def test_only_other_threads_wake_the_queue(
    slow: Callable[..., Slow], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The queue's own thread is awake when it reads a request."""
    one = slow()
    ours, theirs = socket.socketpair()
    woken: list[str] = []
    wake = one.queue.poller.wake

    def by_whom() -> None:
        woken.append(threading.current_thread().name)
        wake()

    monkeypatch.setattr(one.queue.poller, "wake", by_whom)

    def ready() -> None:
        ours.recv(1)
        one.put("heard")

    one.queue.poller.watch(ours, ready)
    one.start()
    woken.clear()
    theirs.send(b"x")
    wait_for(lambda: one.called("answer heard"))
    assert woken == []
    wait_for(lambda: one.queue._asleep)
    one.put("other")
    wait_for(lambda: one.called("answer other"))
    assert woken == [threading.current_thread().name]
    one.engine.close()
    ours.close()
    theirs.close()


@pytest.mark.own_process
def test_no_descriptor_and_no_thread_is_left() -> None:
    files, running = descriptors(), running_threads()
    for lend in (False, True):
        poller = Poller()
        if lend:
            poller.hand_to_reader()
            poller.reclaim()
        poller.close()
    assert not descriptors() - files
    assert not running_threads() - running


def test_who_wakes_a_closed_poller_writes_into_no_other_file() -> None:
    poller = Poller()
    poller.close()
    # These may have the same descriptor numbers as the closed sockets.
    ours, theirs = socket.socketpair()
    poller.wake()
    ours.setblocking(False)
    theirs.setblocking(False)
    for one in (ours, theirs):
        with pytest.raises(BlockingIOError):
            one.recv(1)
    ours.close(), theirs.close()
