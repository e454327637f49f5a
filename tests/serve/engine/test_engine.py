"""The engine: requests and replies, and the isolation of sessions."""

from __future__ import annotations

import queue
import random
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np
import pytest
from in_flight import answered, submit

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.errors import (
    ContractMismatch,
    InvalidAction,
    InvalidObservation,
    NotOffered,
    NotReset,
    PolicyFailed,
    PolicyUnavailable,
    UnknownSession,
)
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.engine import Engine


class Echo(Agent):
    """A policy that returns the session's instruction, seed and number of steps."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        if kwargs.get("fail"):
            raise RuntimeError("secret /path/of/the/server")
        self.instruction, self.seed, self.step = instruction, kwargs.get("seed", 0), 0
        return {"hello": instruction}

    def act(self, obs: Obs) -> Act:
        self.step += 1
        if obs.info.get("fail"):
            raise RuntimeError("secret /path/of/the/server")
        if obs.info.get("nan"):
            return Act(np.array([np.nan]))
        if obs.info.get("odd"):
            return {"action": [1]}  # type: ignore[return-value]
        if obs.info.get("unsendable"):
            return Act(np.zeros(1), info={"x": object()})
        return Act(
            np.array([self.seed, self.step]),
            info={"instruction": self.instruction, "value": obs.info.get("value")},
        )


def ask(
    engine: Engine, session: str, op: Any, info: dict[str, Any] | None = None, **fields: Any
) -> Reply:
    return answered(engine, session, Request(op, Obs(info=info or {}), **fields))


def test_sessions_interleaved_at_random_never_mix(serving: Callable[..., Engine]) -> None:
    engine = serving(Echo())
    steps = dict.fromkeys(("a", "b", "c"), 0)
    for seed, name in enumerate(steps):
        assert ask(
            engine, name, "reset", instruction=f"task {name}", kwargs={"seed": seed}
        ).info == {"hello": f"task {name}"}
    choose = random.Random(0)
    for value in range(1000):
        name = choose.choice(sorted(steps))
        steps[name] += 1
        act = ask(engine, name, "act", {"value": value}).act
        assert act.info.pop("policy") == {"version": 0, "fingerprint": ""}
        assert act.info == {"instruction": f"task {name}", "value": value}
        assert act.action.tolist() == [sorted(steps).index(name), steps[name]]


def test_an_act_before_a_reset_or_after_a_close_is_refused(serving: Callable[..., Engine]) -> None:
    engine = serving(Echo())
    with pytest.raises(UnknownSession):
        ask(engine, "nobody", "act")
    assert isinstance(ask(engine, "a", "reset", kwargs={"fail": True}).error, PolicyFailed)
    assert isinstance(ask(engine, "a", "act").error, NotReset)
    for _ in range(2):
        ask(engine, "a", "reset")
        reply = ask(engine, "a", "act")
        assert reply.act.action[1] == 1, "a reset clears the state of the session"
    ask(engine, "a", "close")
    with pytest.raises(UnknownSession):
        ask(engine, "a", "act")


@pytest.mark.parametrize(
    ("info", "error"),
    [
        ({"fail": True}, PolicyFailed),
        ({"nan": True}, InvalidAction),
        ({"odd": True}, PolicyFailed),
        ({"unsendable": True}, PolicyFailed),
    ],
)
def test_a_failing_act_fails_alone_and_what_the_policy_raised_stays_on_the_server(
    serving: Callable[..., Engine], info: dict[str, Any], error: type[Exception]
) -> None:
    engine = serving(Echo())
    ask(engine, "a", "reset")
    failed = ask(engine, "a", "act", info, request_id="r1").error
    assert isinstance(failed, error)
    assert "secret" not in str(failed)
    assert "/path" not in str(failed)
    assert "r1" in str(failed) or "fail" not in info
    assert ask(engine, "a", "act").error is None


class Contracted(Echo):
    @property
    def contract(self) -> Contract:
        return Contract(
            {"front": CameraSpec(4, 4)}, {"joints": StateSpec(2)}, action=ActionSpec(dim=2)
        )


def test_what_the_policy_does_not_offer_is_refused_before_it_acts(
    serving: Callable[..., Engine],
) -> None:
    engine = serving(Echo())
    ask(engine, "a", "reset")
    with pytest.raises(NotOffered, match=r"expected only \[\], .*, got \['logprob'\]"):
        ask(engine, "a", "act", {"want": ["logprob"]})
    act = ask(engine, "a", "act").act
    assert act.action[1] == 1, "the policy counts the step"


def test_an_observation_or_a_contract_that_does_not_fit_is_refused_before_it_joins_a_batch(
    serving: Callable[..., Engine],
) -> None:
    engine = serving(Contracted())
    with pytest.raises(InvalidObservation):
        ask(engine, "a", "reset")
    with pytest.raises(ContractMismatch, match=r"action\.dim"):
        ask(engine, "a", "reset", contract={"action": {"dim": 7}})


class Batched(Echo):
    def initialize(self) -> None:
        self.sizes: list[int] = []

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        self.sizes.append(len(obs))
        if any(one.info.get("short") for one in obs):
            return []
        return [session.act(one) for session, one in zip(sessions, obs, strict=True)]


def test_a_batch_goes_to_the_initialized_agent_in_one_call(serving: Callable[..., Engine]) -> None:
    agent = Batched()
    engine = serving(agent, max_batch_size=8)
    names = [f"s{i}" for i in range(8)]
    for name in names:
        ask(engine, name, "reset", instruction=name)
    replies: queue.SimpleQueue[Reply] = queue.SimpleQueue()
    for _ in range(20):
        for name in names:
            submit(engine, name, Request("act", Obs(), request_id=name), replies.put)
    answers = [replies.get(timeout=10) for _ in range(160)]
    assert all(
        reply.act is not None and reply.act.info["instruction"] == reply.request_id
        for reply in answers
    )
    assert sum(agent.sizes) == 160
    assert max(agent.sizes) <= 8


def test_a_batch_of_the_wrong_length_is_the_policys_fault(serving: Callable[..., Engine]) -> None:
    engine = serving(Batched())
    ask(engine, "a", "reset")
    assert isinstance(ask(engine, "a", "act", {"short": True}).error, PolicyFailed)


class Held(Agent):
    """A policy that acts for 20 ms, and longer until the test releases it."""

    shared: ClassVar = ("go",)

    def __init__(self) -> None:
        self.go = threading.Event()

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {}

    def act(self, obs: Obs) -> Act:
        time.sleep(0.02)
        self.go.wait()
        return Act(np.zeros(1))


@pytest.mark.parametrize(
    ("priority", "computes", "beside"),
    [("simulation", True, True), ("robot", False, True), ("robot", True, False)],
)
def test_replies_are_sent_beside_the_next_full_batch_unless_a_robot_would_wait(
    serving: Callable[..., Engine],
    monkeypatch: pytest.MonkeyPatch,
    priority: Any,
    computes: bool,
    beside: bool,
) -> None:
    monkeypatch.setattr(time, "thread_time", time.perf_counter if computes else float)
    agent = Held()
    engine, threads = serving(agent, max_batch_size=1), queue.SimpleQueue[str]()
    for session in "ab":
        ask(engine, session, "reset")
    agent.go.set()
    for _ in range(5):  # until the queue has measured that batches are slow
        ask(engine, "a", "act")
    agent.go.clear()
    for session in "ab":
        submit(
            engine,
            session,
            Request("act", Obs(), priority=priority),
            lambda _: threads.put(threading.current_thread().name),
        )
    while engine.queue.depth() != 1:
        pass
    agent.go.set()
    assert ("answers" in threads.get(timeout=30)) is beside
    assert "answers" not in threads.get(timeout=30), "nothing waits"


def test_a_loading_policy_is_unavailable_and_a_broken_one_says_why() -> None:
    class Broken(Agent):
        def initialize(self) -> None:
            raise FileNotFoundError("no such checkpoint")

    engine = Engine(Broken())
    with pytest.raises(PolicyUnavailable):
        engine.health.require_ready()
    with pytest.raises(PolicyFailed, match=r"no such checkpoint \(test_engine.py:\d+\)$"):
        engine.start()
    # Paths never leave the server.
    with pytest.raises(PolicyUnavailable, match="did not load: FileNotFoundError; the server"):
        ask(engine, "a", "reset")


def test_close_closes_the_agent_once() -> None:
    closed: list[int] = []

    class Closing(Echo):
        def close(self) -> None:
            closed.append(1)

    engine = Engine(Closing())
    engine.start()
    ask(engine, "a", "reset")
    engine.close()
    assert closed == [1]
