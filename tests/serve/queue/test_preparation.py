"""Observations are prepared on other threads than the policy's, with the same actions as without
preparation.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from eval_fakes import wait_for
from in_flight import submit

from vlagents_ray.errors import PolicyFailed, PolicyUnavailable
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings

Answer = queue.SimpleQueue[Reply]


class Preparing(Agent):
    """A policy that returns the prepared value: the session's instruction and the thread of the
    preparation.
    """

    shared = ("gates",)

    def __init__(self) -> None:
        self.gates = {name: threading.Event() for name in ("act", "prepare")}
        self.instruction: str | None = None

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.instruction = instruction
        return {}

    def prepare(self, obs: Obs) -> Any:
        if obs.info.get("wrong"):
            raise ValueError("not an observation")
        thread = threading.current_thread().name.partition("_")[0]
        obs.info["begun"].set()
        if thread == "prepare":
            self.gates["prepare"].wait(30)
        return f"{self.instruction}: {thread}"

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        if "hold" in obs[0].info:
            obs[0].info["hold"].set()
            self.gates["act"].wait(30)
        time.sleep(0.02)  # a slow policy
        return [Act(np.zeros(1), info={"prepared": one.prepared}) for one in obs]


class Serving:
    """An engine with a slow policy that acts on a request until a test opens the gate."""

    def __init__(self, sessions: int) -> None:
        self.agent = Preparing()
        self.engine = Engine(self.agent, EngineSettings(max_batch_size=32))
        self.engine.start()
        self.names = [f"s{number}" for number in range(sessions)]
        for name in self.names:
            prepared(self.submit(name, "reset", instruction=name))
        self.agent.gates["prepare"].set()
        for name in self.names[:2]:  # after these acts the queue considers the policy slow
            prepared(self.submit(name, "act"))
        self.agent.gates["prepare"].clear()
        held = threading.Event()
        self.first = self.submit(self.names[0], "act", hold=held)
        assert held.wait(30)

    def submit(self, session: str, op: str, instruction: str | None = None, **info: Any) -> Answer:
        replies: Answer = queue.SimpleQueue()
        info.setdefault("begun", threading.Event())
        submit(self.engine, session, Request(op, Obs(info=info), instruction), replies.put)  # type: ignore[arg-type]
        return replies


def prepared(answer: Answer) -> Any:
    """Return the prepared value that the policy received with the observation."""
    reply = answer.get(timeout=30)
    assert reply.error is None, reply.error
    return None if reply.act is None else reply.act.info["prepared"]


@pytest.fixture
def serving() -> Iterator[Callable[[int], Serving]]:
    made: list[Serving] = []

    def make(sessions: int) -> Serving:
        made.append(Serving(sessions))
        return made[-1]

    yield make
    for one in made:
        for gate in one.agent.gates.values():
            gate.set()
        one.engine.close()
    wait_for(lambda: not [one for one in threading.enumerate() if one.name.startswith("prepare_")])


def test_the_next_batch_is_prepared_while_the_policy_acts(
    serving: Callable[[int], Serving],
) -> None:
    one, begun = serving(3), threading.Event()
    one.agent.gates["prepare"].set()
    answers = [one.submit(name, "act", begun=begun) for name in one.names[1:]]
    assert begun.wait(30), "while the policy is held"
    one.agent.gates["act"].set()
    assert min(map(prepared, answers)) == "s1: prepare"


def test_the_policy_prepares_itself_what_has_not_begun(serving: Callable[[int], Serving]) -> None:
    one = serving(16)  # more sessions than threads
    begun = [threading.Event() for _ in one.names[1:]]
    answers = [
        one.submit(name, "act", begun=event)
        for name, event in zip(one.names[1:], begun, strict=True)
    ]
    assert begun[0].wait(30)
    one.agent.gates["act"].set()
    assert begun[-1].wait(30), "although all threads are busy"
    one.agent.gates["prepare"].set()
    found = list(map(prepared, answers))
    assert (found[0], found[-1]) == ("s1: prepare", "s15: policy")
    assert [text.partition(":")[0] for text in found] == one.names[1:]


@pytest.mark.parametrize("sessions", [3, 16], ids=["on another thread", "on the policy's thread"])
def test_an_error_of_a_preparation_is_that_of_its_request_alone(
    serving: Callable[[int], Serving], caplog: pytest.LogCaptureFixture, sessions: int
) -> None:
    one, begun = serving(sessions), threading.Event()
    others = [one.submit(name, "act", begun=begun) for name in one.names[1:-1]]
    assert begun.wait(30)
    answer = one.submit(one.names[-1], "act", wrong=True)
    one.agent.gates["prepare"].set()
    one.agent.gates["act"].set()
    error = answer.get(timeout=30).error
    assert isinstance(error, PolicyFailed)
    assert "the policy raised ValueError (test_preparation.py:" in str(error)
    assert "not an observation" not in str(error)  # the message is only logged
    assert "not an observation" in caplog.text
    assert [prepared(other).partition(":")[0] for other in others] == one.names[1:-1]
    prepared(one.submit(one.names[-1], "act"))  # the session continues


def test_what_was_prepared_for_the_episode_before_is_not_used(
    serving: Callable[[int], Serving],
) -> None:
    one, begun = serving(2), threading.Event()
    one.agent.gates["prepare"].set()
    again = one.submit("s1", "reset", instruction="another")
    answer = one.submit("s1", "act", begun=begun)
    assert begun.wait(30), "prepared for the episode that continues"
    one.agent.gates["act"].set()
    assert prepared(again) is None
    assert prepared(answer) is None


def test_a_request_that_is_withdrawn_is_not_prepared(serving: Callable[[int], Serving]) -> None:
    one = serving(16)
    begun = [threading.Event() for _ in one.names[1:]]
    for name, event in zip(one.names[1:], begun, strict=True):
        ticket = submit(
            one.engine, name, Request("act", Obs(info={"begun": event})), lambda _: None
        )
        ticket.fail(PolicyUnavailable("it is late"))
    one.agent.gates["prepare"].set()
    one.agent.gates["act"].set()
    prepared(one.first)
    assert not begun[-1].is_set()
