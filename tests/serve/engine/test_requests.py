"""Requests in flight: the effects of a request that its sender abandons, and of a message that
cannot be answered.
"""

from __future__ import annotations

import asyncio
import queue
import threading
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from eval_fakes import wait_for
from in_flight import Calls, answered, arrived, ask, pending, send

from vlagents_ray.errors import (
    DeadlineExceeded,
    InvalidInput,
    MessageTooLarge,
    PolicyFailed,
    PolicyUnavailable,
    UnknownSession,
)
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol import frames
from vlagents_ray.protocol.frames import Decoded, decode_replies
from vlagents_ray.protocol.messages import (
    IMMEDIATE_OPS,
    INNER_OPS,
    MessageLimits,
    Op,
    Reply,
    Request,
)
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints import answers
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.metrics_buffer import MetricsBuffer
from vlagents_ray.serve.engine.observer import Observer
from vlagents_ray.serve.engine.sender import Sender
from vlagents_ray.serve.requests import IncomingMessage, Origin, PendingRequest


class Gated(Agent):
    """A policy that acts when the gate is open, and raises the error in the observation."""

    gate = threading.Event()
    busy = threading.Semaphore(0)

    def act(self, obs: Obs) -> Act:
        Gated.busy.release()
        assert Gated.gate.wait(10)
        return Act(np.zeros(1))

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        if "error" in obs[0].info:
            raise obs[0].info["error"]
        return super().act_batch(obs, sessions)


def test_a_misspelt_option_of_a_reset_is_refused() -> None:
    """The policy would ignore it, and act with other settings than the client believes."""
    engine = Engine(Gated())
    engine.start()
    try:
        request = Request("reset", obs=Obs(), kwargs={"chekpoint_step": 600})
        error = answered(engine, "robot", request).error
        assert isinstance(error, InvalidInput)
        assert "did you mean 'checkpoint_step'" in str(error)
        assert answered(engine, "robot", Request("reset", obs=Obs())).error is None
    finally:
        engine.close()


class Served:
    def __init__(self) -> None:
        Gated.gate.set()
        Gated.busy = threading.Semaphore(0)
        self.engine = Engine(Gated())
        self.engine.start()
        self.first = self.sender("first")
        self.ask(self.first, "reset")

    def sender(self, name: str, *, connected: bool = True) -> Sender:
        return Sender(
            self.engine, "test", name, caller=NoKey.OPEN, has_left=None, connected=connected
        )

    def put(
        self, sender: Sender, op: str, info: dict[str, object] | None = None, **fields: Any
    ) -> queue.SimpleQueue[list[Reply]]:
        replies: queue.SimpleQueue[list[Reply]] = queue.SimpleQueue()
        send(sender, [Request(op, Obs(info=info or {}), **fields)], replies.put)  # type: ignore[arg-type]
        return replies

    def ask(self, sender: Sender, op: str, **fields: Any) -> Reply:
        [reply] = self.put(sender, op, **fields).get(timeout=10)
        assert reply.error is None
        return reply

    def occupy(self) -> None:
        """Occupy the policy until `go_on`."""
        Gated.gate.clear()
        self.put(self.first, "act")
        assert Gated.busy.acquire(timeout=10)

    def go_on(self) -> None:
        Gated.gate.set()
        self.ask(self.first, "act")


@pytest.fixture
def served() -> Iterator[Served]:
    one = Served()
    yield one
    Gated.gate.set()
    one.engine.close()


def test_a_reset_that_waits_when_its_connection_ends_leaves_no_session(served: Served) -> None:
    served.occupy()
    other = served.sender("other")
    reset = served.put(other, "reset")
    other.release()
    served.go_on()
    assert reset.get(timeout=10)[0].error is not None
    assert served.engine.sessions.ids() == ["first"]


def test_a_close_that_comes_too_late_leaves_the_session_to_the_end_of_its_connection(
    served: Served,
) -> None:
    other = served.sender("other")
    served.ask(other, "reset")
    served.occupy()
    close = served.put(other, "close", deadline_ms=1.0)
    threading.Event().wait(0.01)
    served.go_on()
    assert isinstance(close.get(timeout=10)[0].error, DeadlineExceeded)
    assert "other" in served.engine.sessions
    other.release()
    assert "other" not in served.engine.sessions


def test_a_connection_acts_in_the_episode_that_it_began_before_its_close_was_executed(
    served: Served,
) -> None:
    other = served.sender("other")
    served.ask(other, "reset")
    served.occupy()
    waiting = [served.put(other, op) for op in ("close", "reset")]
    served.go_on()
    assert [replies.get(timeout=10)[0].error for replies in waiting] == [None, None]
    served.ask(other, "act")
    other.release()
    assert "other" not in served.engine.sessions, "the session ends with its connection"


@pytest.mark.parametrize("was_in", ["none", "the episode before"])
@pytest.mark.parametrize("with_step", [False, True])
def test_what_comes_late_over_an_old_connection_neither_acts_in_nor_ends_a_newer_episode(
    served: Served, was_in: str, with_step: bool
) -> None:
    """The client has closed the old connection, and has reset the session over a new one."""
    old = served.sender("other")
    before = served.ask(old if was_in == "the episode before" else served.sender("other"), "reset")
    new = served.sender("other")
    served.ask(new, "reset", session="other")
    step = before.step if with_step else None
    late = served.put(old, "act", session="other", step=step).get(timeout=10)[0]
    assert isinstance(late.error, UnknownSession)
    old.release()
    served.ask(new, "act", session="other")


@pytest.mark.parametrize("reset_over_http", [True, False])
def test_a_connection_acts_without_a_step_in_an_episode_that_had_begun_when_it_was_opened(
    served: Served, reset_over_http: bool
) -> None:
    """This happens after a hand-over. A later reset that is withdrawn changes nothing."""
    served.ask(served.sender("other", connected=not reset_over_http), "reset")
    new = served.sender("new")
    served.occupy()
    [withdrawn] = send(
        served.sender("other", connected=False), [Request("reset", Obs())], lambda _: None
    )
    served.engine.intake.withdraw(withdrawn)
    act = served.put(new, "act", session="other")
    served.go_on()
    assert act.get(timeout=10)[0].error is None
    new.release()
    assert "other" not in served.engine.sessions, (
        "the session ends with the connection that used it last"
    )


@pytest.mark.parametrize("error", [RuntimeError("broken"), SystemExit(1)], ids=repr)
def test_a_policy_that_breaks_fails_its_batch_and_goes_on(
    served: Served, error: BaseException
) -> None:
    assert isinstance(
        served.put(served.first, "act", {"error": error}).get(timeout=10)[0].error, PolicyFailed
    )
    served.ask(served.first, "act")


def test_a_caller_that_cannot_take_its_reply_does_not_stop_the_queue(served: Served) -> None:
    def explode(_: list[Reply]) -> None:
        raise ValueError("gone")

    send(served.first, [Request("act", Obs())], explode)
    served.ask(served.first, "act")


def test_closing_answers_everyone_and_so_does_a_deadline_that_passes_in_the_queue(
    served: Served,
) -> None:
    other = served.sender("other")
    served.ask(other, "reset")
    Gated.gate.clear()
    running = served.put(served.first, "act")
    assert Gated.busy.acquire(timeout=10)
    late = served.put(other, "act", deadline_ms=1.0)
    threading.Event().wait(0.01)
    Gated.gate.set()
    assert isinstance(late.get(timeout=10)[0].error, DeadlineExceeded)
    assert running.get(timeout=10)[0].error is None
    Gated.gate.clear()
    running = served.put(served.first, "act")
    assert Gated.busy.acquire(timeout=10)
    waiting = served.put(other, "act")
    closer = threading.Thread(target=served.engine.close)
    closer.start()
    assert isinstance(waiting.get(timeout=10)[0].error, PolicyUnavailable)
    Gated.gate.set()
    closer.join(10)
    assert running.get(timeout=10)[0].error is None
    assert not served.engine.health.alive
    assert isinstance(
        served.put(other, "act").get(timeout=10)[0].error, PolicyUnavailable | PolicyFailed
    )


@pytest.mark.parametrize("for_good", [True, False])
def test_a_connection_to_a_draining_replica_leaves_its_sessions_to_another_one(
    served: Served, for_good: bool
) -> None:
    other = served.sender("other")
    served.ask(other, "reset")
    served.engine.drain_list.drain()
    other.release(for_good=for_good)
    assert ("other" in served.engine.sessions) is not for_good


@pytest.mark.parametrize("began", [True, False])
def test_a_reset_whose_caller_is_gone_is_as_if_it_had_never_been(
    served: Served, began: bool
) -> None:
    other = served.sender("other", connected=False)
    if began:
        served.ask(other, "reset")
    before = served.engine.sessions.versions()
    served.occupy()

    async def give_up() -> None:
        asked = asyncio.create_task(ask(other, [Request("reset", Obs())]))
        while served.engine.queue.depth() == 0:
            await asyncio.sleep(0.001)
        asked.cancel()
        await asyncio.wait([asked])

    asyncio.run(give_up())
    served.go_on()
    wait_for(lambda: served.engine.queue.depth() == 0)
    after = served.engine.sessions.versions()
    assert after.keys() == before.keys()
    assert after.get("other") == before.get("other")


def test_too_many_replies_for_one_frame_are_errors_and_recorded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(frames, "DEFAULT_LIMITS", MessageLimits(body_bytes=2000))
    stats = MetricsBuffer()
    stats.enable()
    message = IncomingMessage("test")
    message.decoded_alike(2)
    message.replies = [
        Reply(act=Act(np.zeros(300, np.float32)), timing={"queue_ms": 1.0}) for _ in range(2)
    ]
    frame = answers.as_frame(message)
    stats.record(message)
    assert all(isinstance(reply.error, MessageTooLarge) for reply in decode_replies(frame))
    assert sum(sample.count for sample in stats.collect().requests.values()) == 2


def test_an_observer_that_fails_costs_no_answer(
    served: Served, caplog: pytest.LogCaptureFixture
) -> None:
    class Broken(Observer):
        def on_request(self, pending: PendingRequest) -> None:
            raise RuntimeError("request")

        def before_answer(self, pending: PendingRequest, reply: Reply) -> None:
            raise RuntimeError("before")

        def on_answer(self, pending: PendingRequest, reply: Reply) -> None:
            raise RuntimeError("after")

    served.engine.observers.add(Broken())
    assert served.ask(served.first, "act").act is not None
    assert "Broken: the observer has failed and left out a request" in caplog.text


class Noting(Observer):
    """An observer that records its calls, and attaches a number to each request that it receives
    back with the answer.
    """

    def __init__(self, seen: list[str]) -> None:
        self.seen, self.requests = seen, 0

    def on_request(self, pending: PendingRequest) -> None:
        assert pending.request.obs is not None
        self.requests += 1
        pending.observer_data[self] = self.requests
        self.seen.append(f"request of {pending.session_id}")

    def before_answer(self, pending: PendingRequest, reply: Reply) -> None:
        self.seen.append(f"before {pending.session_id}")

    def on_answer(self, pending: PendingRequest, reply: Reply) -> None:
        self.seen.append(f"answer {pending.observer_data[self]} to {pending.session_id}")


def test_the_requests_of_a_message_are_seen_around_its_answer_without_those_that_could_not_be_read(
    served: Served,
) -> None:
    seen = list[str]()
    served.engine.observers.add(Noting(seen))
    sender = served.sender("a")

    message = arrived(sender)
    requests = [Request("reset", Obs(), session=name) for name in "ab"]
    decoded = Decoded(requests, {1: Reply(error=InvalidInput("no"))})
    sender.send(message, decoded, Calls(lambda _: seen.append("sent")))
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


class Listed(Agent):
    """A policy that records the operations that it executes."""

    def __init__(self) -> None:
        self.executed = Executed()

    def shared_objects(self) -> list[object]:
        return [self.executed]

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict[str, object]:
        self.executed.append("reset")
        return {}

    def act(self, obs: Obs) -> Act:
        self.executed.append("act")
        return Act(np.zeros(1))


class Executed(list[str]):
    """Executed operations of all sessions."""


STEPS = {"reset": ("take", "run", "reset"), "act": ("take", "run", "ready", "act")}


@pytest.mark.parametrize(
    ("op", "step"), [(op, step) for op, steps in STEPS.items() for step in steps]
)
def test_no_request_is_executed_of_which_a_deadline_said_that_it_never_will_be(
    op: str, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The deadline passes at each step between the queue and the policy."""
    policy = Listed()
    engine = Engine(policy)
    engine.start()
    sender = Sender(engine, "test", "robot-1", caller=NoKey.OPEN, has_left=None, connected=False)
    replies: queue.SimpleQueue[list[Reply]] = queue.SimpleQueue()
    send(sender, [Request("reset", Obs())], replies.put)
    assert replies.get(timeout=10)[0].error is None
    policy.executed.clear()
    owner, method = {
        "take": (engine.queue, "take"),
        "run": (engine.runner, "_run"),
        "reset": (engine.runner, "_reset"),
        "ready": (engine.runner, "_ready"),
        "act": (engine.runner, "_act"),
    }[step]
    original = getattr(owner, method)
    sent: list[PendingRequest] = []
    queued = threading.Event()
    said_never: list[bool] = []

    def late(*arguments: object) -> object:
        if queued.wait(10) and not said_never:  # like `Sender._expire` on another thread
            engine.intake.withdraw(*sent)
            said_never.append(not sent[0].begun)
        return original(*arguments)

    monkeypatch.setattr(owner, method, late)
    sent += send(sender, [Request(op, Obs())], replies.put)  # type: ignore[arg-type]
    queued.set()
    wait_for(lambda: said_never)
    engine.close()
    assert said_never == [step == "take"]
    assert policy.executed == ([] if step == "take" else [op])


@pytest.mark.parametrize("op", [op for op in INNER_OPS if op not in (*IMMEDIATE_OPS, "close")])
@pytest.mark.parametrize("owner", ["connection", ""])
def test_no_connection_has_a_session_before_its_request_is_executed(
    served: Served, op: Op, owner: str
) -> None:
    origin = Origin(owner=owner)
    request = pending("first", Request(op, Obs(), session="first"), origin=origin)
    served.engine.intake.reserve(request)
    assert origin.sessions == {}
    assert served.engine.sessions.get("first").origin is served.first._origin


@pytest.mark.parametrize("op", [op for op in INNER_OPS if not op.startswith("gpu_")])
def test_an_engine_that_is_closed_refuses_each_operation_by_the_same_error(
    served: Served, op: Op
) -> None:
    obs = Obs() if op in ("reset", "act", "prepare") else None
    request = Request(op, session="first", obs=obs, kwargs={"number": 1} if obs else {})
    served.engine.close()
    replies: list[Reply] = []
    served.engine.intake.submit([pending("first", request, replies.append)])
    wait_for(lambda: bool(replies))
    assert isinstance(replies[0].error, PolicyUnavailable)
