"""What observers see, in which order, and that a message costs nothing without them."""

from __future__ import annotations

import threading

from vlagents_ray.errors import InvalidInput
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.responses import Watchers
from vlagents_ray.serve.observers.base import Observer, Observers, Pending, Worker


class Noting(Observer):
    """Notes what it sees, and keeps the number of the request for the answer."""

    def __init__(self, seen: list[str], name: str = "") -> None:
        self.seen, self.name, self.requests = seen, name, 0

    def on_request(self, pending: Pending) -> None:
        assert pending.request.obs is not None
        self.requests += 1
        pending.kept[self] = self.requests
        self.seen.append(f"{self.name}request of {pending.session_id}")

    def before_answer(self, pending: Pending, reply: Reply) -> None:
        self.seen.append(f"{self.name}before {pending.session_id}")

    def on_answer(self, pending: Pending, reply: Reply) -> None:
        self.seen.append(f"{self.name}answer {pending.kept[self]} to {pending.session_id}")


def test_a_message_is_seen_around_its_answer_without_the_requests_that_could_not_be_read() -> None:
    watchers, seen = Watchers(), list[str]()
    observers = Observers(watchers)
    observers.add(Noting(seen))
    assert watchers.one is not None
    refused = Reply(error=InvalidInput("no"))
    items = [Request("act", Obs()), refused, Request("act", Obs())]
    done = watchers.one.note(["a", "", "b"], items, {}, lambda _: seen.append("sent"))
    done([Reply(), refused, Reply()])
    assert seen == [
        "request of a",
        "request of b",
        "before a",
        "before b",
        "sent",
        "answer 1 to a",
        "answer 2 to b",
    ]


def test_an_engine_has_no_watcher_unless_there_is_an_observer() -> None:
    watchers, seen = Watchers(), list[str]()
    observers, one, two = Observers(watchers), Noting(seen, "one: "), Noting(seen, "two: ")
    for observer in (one, two):
        observers.add(observer)
    observers.remove(one)
    assert watchers.one is not None
    watchers.one.note(["a"], [Request("act", Obs())], {}, lambda _: None)
    assert seen == ["two: request of a"]
    observers.remove(one)
    observers.remove(two)
    assert watchers.one is None


def test_a_worker_goes_on_after_an_error_and_makes_the_calls_that_wait_before_it_ends() -> None:
    worker, made, go_on = Worker("test"), list[int](), threading.Event()

    def wait() -> None:
        assert go_on.wait(10)
        made.append(1)

    worker.put(wait)
    worker.put(lambda: made.append(1 // 0))
    worker.put(lambda: made.append(3))
    go_on.set()
    worker.close()
    assert made == [1, 3]
