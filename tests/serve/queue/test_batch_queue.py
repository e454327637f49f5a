"""The batch queue: work-conserving and ordered; and the policy's thread, which nothing stops."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from eval_fakes import wait_for
from in_flight import pending

from vlagents_ray.errors import DeadlineExceeded, PolicyFailed, PolicyUnavailable
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.queue.batch_queue import BatchQueue
from vlagents_ray.serve.requests import PendingRequest


@pytest.fixture
def queue() -> Iterator[Callable[[int], BatchQueue]]:
    made: list[BatchQueue] = []

    def make(max_batch_size: int) -> BatchQueue:
        made.append(BatchQueue(max_batch_size))
        made[-1].bind()
        return made[-1]

    yield make
    for one in made:
        one.release()


def put(queue: BatchQueue, name: str, **fields: float) -> PendingRequest:
    one = pending(name, Request("act", request_id=name, **fields), lambda _: None)  # type: ignore[arg-type]
    queue.put(one)
    return one


def test_a_lone_request_does_not_wait_for_others(queue: Callable[[int], BatchQueue]) -> None:
    waiting = queue(4)
    put(waiting, "a")
    taken = waiting.next()
    assert taken is not None
    assert len(taken.batch) == 1


def test_a_request_that_expired_or_was_given_up_never_reaches_the_policy(queue: Callable[[int], BatchQueue]) -> None:
    waiting = queue(4)
    late = put(waiting, "late", deadline_ms=1.0)
    late.deadline -= 1.0
    waiting.withdraw(put(waiting, "gone"))
    put(waiting, "good")
    taken = waiting.take()
    assert taken is not None
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
    quiet = BatchQueue(1, idle_s=0.05)
    quiet.bind()
    before_s, began = quiet.idle_time_s(), time.perf_counter()
    assert quiet.next() == ([], []), "its thread is told that nothing came for long"
    assert 0.05 <= quiet.idle_time_s() - before_s <= time.perf_counter() - began
    quiet.release()


# The policy's thread.


class Gated(Agent):
    """A policy that waits at a gate, and breaks if it is told to."""

    def __init__(self) -> None:
        self.gate, self.busy = threading.Event(), threading.Semaphore(0)
        self.threads: set[str] = set()

    def initialize(self) -> None:
        self.threads.add(threading.current_thread().name)

    def act_batch(self, obs: list[Obs], sessions: list[Agent]) -> list[Act]:  # type: ignore[override]
        self.threads.add(threading.current_thread().name)
        self.busy.release()
        assert self.gate.wait(10)
        if error := obs[0].info.get("raise"):
            raise SystemExit(1) if error == "exit" else RuntimeError("broken")
        return [Act(np.zeros(1))] * len(obs)


class Served:
    def __init__(self) -> None:
        self.policy = Gated()
        self.policy.gate.set()
        self.engine = Engine(self.policy, max_batch_size=4)
        self.engine.start()
        self.replies: dict[str, Reply] = {}
        for session in ("a", "b"):
            self.ask("reset", session)
            self.answered(session)

    def ask(self, op: str, session: str, done: Callable[[Reply], None] | None = None, **info: str) -> None:
        self.replies.pop(session, None)
        request = Request(op, Obs(info=info))  # type: ignore[arg-type]
        self.engine.submit([PendingRequest(session, request, done or (lambda r: self.replies.update({session: r})))])

    def answered(self, session: str) -> Reply:
        wait_for(lambda: session in self.replies)
        return self.replies[session]


@pytest.fixture
def served() -> Iterator[Served]:
    one = Served()
    yield one
    one.policy.gate.set()
    one.engine.close()
    assert not one.engine.alive


@pytest.mark.parametrize("kind", ["error", "exit"])
def test_a_policy_that_breaks_fails_its_batch_and_goes_on(served: Served, kind: str) -> None:
    served.ask("act", "a", **{"raise": kind})
    assert isinstance(served.answered("a").error, PolicyFailed)
    served.ask("act", "b")
    assert served.answered("b").error is None
    assert served.policy.threads == {"policy"}


def test_a_caller_that_cannot_take_its_reply_does_not_stop_the_queue(served: Served) -> None:
    def explode(_: Reply) -> None:
        raise ValueError("gone")

    served.ask("act", "a", explode)
    served.ask("act", "b")
    assert served.answered("b").error is None


def test_closing_answers_everyone(served: Served) -> None:
    served.policy.gate.clear()
    served.ask("act", "a")
    assert served.policy.busy.acquire(timeout=5)
    served.ask("act", "b")
    closer = threading.Thread(target=served.engine.close)
    closer.start()
    assert isinstance(served.answered("b").error, PolicyUnavailable)
    served.policy.gate.set()
    closer.join(5)
    assert served.answered("a").error is None
    served.ask("act", "b")
    assert isinstance(served.answered("b").error, PolicyUnavailable | PolicyFailed)


def test_a_deadline_that_passes_in_the_queue_is_answered(served: Served) -> None:
    served.policy.gate.clear()
    served.ask("act", "a")
    assert served.policy.busy.acquire(timeout=5)
    late = pending("b", Request("act", Obs(), deadline_ms=1.0), lambda reply: served.replies.update(b=reply))
    served.replies.clear()
    served.engine.submit([late])
    late.deadline -= 1.0
    served.policy.gate.set()
    assert isinstance(served.answered("b").error, DeadlineExceeded)
