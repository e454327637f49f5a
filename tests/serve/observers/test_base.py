"""What observers see, in which order, and that a message costs nothing without them."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from eval_fakes import wait_for

from vlagents_ray.errors import InvalidInput
from vlagents_ray.interface import Obs
from vlagents_ray.policies.noop import Noop
from vlagents_ray.protocol.frames import Decoded
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.observer import Observer, Observers
from vlagents_ray.serve.engine.sender import Sender
from vlagents_ray.serve.requests import Message, PendingRequest


class Noting(Observer):
    """Notes what it sees, and keeps the number of the request for the answer."""

    def __init__(self, seen: list[str], name: str = "") -> None:
        self.seen, self.name, self.requests = seen, name, 0

    def on_request(self, pending: PendingRequest) -> None:
        assert pending.request.obs is not None
        self.requests += 1
        pending.kept[self] = self.requests
        self.seen.append(f"{self.name}request of {pending.session_id}")

    def before_answer(self, pending: PendingRequest, reply: Reply) -> None:
        self.seen.append(f"{self.name}before {pending.session_id}")

    def on_answer(self, pending: PendingRequest, reply: Reply) -> None:
        self.seen.append(f"{self.name}answer {pending.kept[self]} to {pending.session_id}")


@pytest.fixture
def engine() -> Iterator[Engine]:
    one = Engine(Noop.from_config({}))
    one.start()
    yield one
    one.close()


def test_the_requests_of_a_message_are_seen_around_its_answer_without_those_that_could_not_be_read(
    engine: Engine,
) -> None:
    seen = list[str]()
    engine.observers.add(Noting(seen))
    sender = Sender(engine, "test", "a", caller=NoKey.INSIDE)

    def sent(_: Message) -> None:
        seen.append("sent")

    message = sender.message()
    requests = [Request("reset", Obs(), session=name) for name in "ab"]
    sender.send(message, Decoded(requests, {1: Reply(error=InvalidInput("no"))}), sent)
    wait_for(lambda: seen[-1:] == ["answer 2 to b"])
    assert message.replies[1].error is not None
    assert seen == [
        "request of a",
        "request of b",
        "before a",
        "before b",
        "sent",
        "answer 1 to a",
        "answer 2 to b",
    ]


def test_an_engine_is_observed_as_long_as_there_is_an_observer() -> None:
    observers, seen = Observers(), list[str]()
    one, two = Noting(seen, "one: "), Noting(seen, "two: ")
    for observer in (one, two):
        observers.add(observer)
    observers.remove(one)
    assert observers.any
    pending = PendingRequest("a", Request("act", Obs()), lambda _: None, kept={})
    observers.on_request(pending)
    assert seen == ["two: request of a"]
    observers.remove(one)
    observers.remove(two)
    assert observers.any is False
