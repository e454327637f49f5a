"""The batch queue: work-conserving, ordered, and never stuck."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence

import pytest
from eval_fakes import wait_for

from vlagents_ray.errors import DeadlineExceeded, PolicyFailed, PolicyUnavailable
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.queue.batch_queue import BatchQueue, PendingRequest, Rank


class Harness:
    """A queue whose policy waits at a gate, so that a test decides what waits together."""

    def __init__(self, max_batch_size: int = 4) -> None:
        self.batches: list[list[str]] = []
        self.replies: dict[str, Reply] = {}
        self.gate = threading.Semaphore(0)
        self.busy = threading.Semaphore(0)
        self.answered = threading.Condition()
        self.fail: BaseException | None = None
        self.queue = BatchQueue(self._run, max_batch_size)
        self.queue.start()

    def _run(self, batch: Sequence[PendingRequest]) -> None:
        self.batches.append([ticket.request.request_id for ticket in batch])
        self.busy.release()
        self.gate.acquire()
        if self.fail is not None:
            error, self.fail = self.fail, None
            raise error
        for ticket in batch:
            ticket.answer(Reply(ticket.request.request_id))

    def put(
        self, name: str, session: str | None = None, rank: Rank = Rank.SIMULATION, **fields: float
    ) -> PendingRequest:
        def done(reply: Reply) -> None:
            with self.answered:
                self.replies[name] = reply
                self.answered.notify_all()

        ticket = PendingRequest(session or name, Request("act", request_id=name, **fields), done, rank)  # type: ignore[arg-type]
        self.queue.put(ticket)
        return ticket

    def occupy(self) -> None:
        """Make the policy busy with a request of its own."""
        self.put("first")
        assert self.busy.acquire(timeout=5)

    def finish(self, *names: str) -> None:
        """Open the gate until these have replies."""
        with self.answered:
            self.gate.release(100)
            assert self.answered.wait_for(lambda: all(n in self.replies for n in names), timeout=5), self.replies


@pytest.fixture
def harness() -> Iterator[Callable[..., Harness]]:
    made: list[Harness] = []

    def make(**options: int) -> Harness:
        made.append(Harness(**options))
        return made[-1]

    yield make
    for one in made:
        one.gate.release(100)
        one.queue.close(timeout_s=5)
        assert not one.queue.alive()


def test_what_waits_is_taken_together_up_to_the_limit(harness: Callable[..., Harness]) -> None:
    h = harness(max_batch_size=3)
    h.occupy()
    for name in "abcd":
        h.put(name)
    h.finish(*"abcd")
    assert h.batches == [["first"], ["a", "b", "c"], ["d"]]


def test_a_lone_request_does_not_wait_for_others(harness: Callable[..., Harness]) -> None:
    h = harness()
    h.put("a")
    h.finish("a")
    assert h.batches == [["a"]]


def test_robots_go_before_simulations(harness: Callable[..., Harness]) -> None:
    h = harness(max_batch_size=2)
    h.occupy()
    for name in "abc":
        h.put(name)
    h.put("robot", rank=Rank.ROBOT)
    h.finish(*"abc", "robot")
    assert h.batches[1] == ["robot", "a"]


def test_a_session_is_in_a_batch_once_and_in_order(harness: Callable[..., Harness]) -> None:
    h = harness()
    h.occupy()
    for name in ("a1", "a2", "a3", "b1"):
        h.put(name, session=name[0])
    h.finish("a1", "a2", "a3", "b1")
    assert h.batches[1:] == [["a1", "b1"], ["a2"], ["a3"]]


def test_an_expired_request_never_reaches_the_policy(harness: Callable[..., Harness]) -> None:
    h = harness()
    h.occupy()
    ticket = h.put("late", deadline_ms=1.0)
    ticket.arrived -= 1.0  # a second ago
    h.put("good")
    h.finish("late", "good")
    assert isinstance(h.replies["late"].error, DeadlineExceeded)
    assert h.batches[1:] == [["good"]]


def test_a_cancelled_request_never_reaches_the_policy(harness: Callable[..., Harness]) -> None:
    h = harness()
    h.occupy()
    h.put("gone").cancelled = True
    h.put("good")
    h.finish("good")
    assert h.batches[1:] == [["good"]]
    assert "gone" not in h.replies


@pytest.mark.parametrize("error", [RuntimeError("broken"), SystemExit(1)])
def test_a_policy_that_breaks_fails_its_batch_and_goes_on(
    harness: Callable[..., Harness], error: BaseException
) -> None:
    h = harness()
    h.fail = error
    h.put("bad")
    h.finish("bad")
    assert isinstance(h.replies["bad"].error, PolicyFailed)
    h.put("good")
    h.finish("good")
    assert h.replies["good"].error is None


def test_a_caller_that_cannot_take_its_reply_does_not_stop_the_queue(harness: Callable[..., Harness]) -> None:
    h = harness()

    def explode(_: Reply) -> None:
        raise ValueError("gone")

    h.queue.put(PendingRequest("x", Request("act", request_id="x"), explode))
    h.put("good")
    h.finish("good")
    assert h.replies["good"].error is None


def test_closing_answers_everyone(harness: Callable[..., Harness]) -> None:
    h = harness()
    h.occupy()
    h.put("waiting")
    closer = threading.Thread(target=h.queue.close)
    closer.start()
    wait_for(lambda: h.queue._closed)
    h.finish("first", "waiting")
    closer.join(5)
    assert isinstance(h.replies["waiting"].error, PolicyUnavailable)
    with pytest.raises(PolicyUnavailable):
        h.put("after")


def test_what_prepare_raises_is_raised_by_start() -> None:
    def prepare() -> None:
        raise FileNotFoundError("no weights")

    with pytest.raises(FileNotFoundError, match="no weights"):
        BatchQueue(lambda _: None, 1, prepare=prepare).start()


def test_idle_is_called_when_nothing_comes() -> None:
    called = threading.Event()
    queue = BatchQueue(lambda _: None, 1, idle=called.set, idle_s=0.01)
    queue.start()
    assert called.wait(5)
    queue.close(timeout_s=5)


def test_prepare_runs_where_the_policy_runs() -> None:
    threads: list[int] = []
    done = threading.Event()

    def run(batch: Sequence[PendingRequest]) -> None:
        threads.append(threading.get_ident())
        done.set()

    queue = BatchQueue(run, 1, prepare=lambda: threads.append(threading.get_ident()))
    queue.start()
    queue.put(PendingRequest("s", Request("act"), lambda _: None))
    assert done.wait(5)
    queue.close(timeout_s=5)
    assert threads[0] == threads[1] != threading.get_ident()


def test_the_queue_costs_a_lone_request_little() -> None:
    """Against a bare hand-over to a thread and back, in the same run."""

    def median(run: Callable[[], None]) -> float:
        times = []
        for _ in range(300):
            begun = time.perf_counter()
            run()
            times.append(time.perf_counter() - begun)
        return sorted(times)[150]

    queue = BatchQueue(lambda batch: [t.answer(Reply()) for t in batch] and None, 16)
    queue.start()

    def through_queue() -> None:
        done = threading.Event()
        queue.put(PendingRequest("s", Request("act"), lambda _: done.set()))
        done.wait(5)

    there, back, stop = threading.Semaphore(0), threading.Semaphore(0), threading.Event()

    def echo() -> None:
        while not stop.is_set():
            there.acquire()
            back.release()

    thread = threading.Thread(target=echo)
    thread.start()

    def bare() -> None:
        there.release()
        back.acquire()

    rounds = [(median(bare), median(through_queue)) for _ in range(5)]
    bare_s, queued_s = map(min, zip(*rounds, strict=True))
    stop.set()
    bare()
    thread.join(5)
    queue.close(timeout_s=5)
    assert queued_s < 10 * bare_s, (queued_s, bare_s)
