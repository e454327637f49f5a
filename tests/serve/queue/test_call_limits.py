"""The reasons that make a replica unhealthy: a policy's call that does not return, a failed
accelerator, or failures of all batches.
"""

from __future__ import annotations

import os
import queue
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from typing import Any

import numpy as np
import psutil
import pytest
from eval_fakes import Clock, wait_for
from in_flight import answered, asked, pending
from shm_client import call, client, request
from starlette.testclient import TestClient

from vlagents_ray.abilities import Observes
from vlagents_ray.errors import InvalidObservation, OutcomeUnknown, PolicyFailed, PolicyUnavailable
from vlagents_ray.interface import TICKS, Act, Agent, Obs
from vlagents_ray.protocol.messages import MessageLimits, Reply, Request
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.endpoints.shm import ShmServer
from vlagents_ray.serve.engine.ability_call import AbilityCall
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.queue.call_limits import (
    FAILED_BATCHES,
    LOAD,
    CallLimits,
    PolicyCall,
    PolicyCalls,
)

LIMITS = CallLimits(act_s=10.0, warm_up_s=100.0, load_s=1000.0)


class Hanging(Agent):
    """A policy that hangs in the requested call until `over` is set."""

    shared = ("over",)

    def __init__(self) -> None:
        self.over = threading.Event()
        self.hangs_at = ""

    def _hang(self, op: str) -> None:
        if self.hangs_at == op:
            self.over.wait(20)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.hangs_at = kwargs.get("hangs_at", "")
        self._hang("reset")
        return {}

    def observe(self, obs: Obs) -> None:
        self._hang("observe")

    def act(self, obs: Obs) -> Act:
        self._hang("act")
        return Act(np.zeros(1, np.float32))

    def __getstate__(self) -> dict[str, Any]:
        self._hang("export")
        return self.__dict__


@pytest.fixture
def agent() -> Iterator[Hanging]:
    agent = Hanging()
    yield agent
    agent.over.set()


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def engine(agent: Hanging, clock: Clock) -> Iterator[Engine]:
    engine = Engine(agent, EngineSettings(limits=LIMITS))
    engine.calls.clock = clock
    engine.start()
    yield engine
    agent.over.set()
    engine.close()


def request_of(op: Any, **kwargs: Any) -> Request:
    """Return a request of a client, or the call of `observe` by another process."""
    if op == "observe":
        call, obs = AbilityCall.from_arguments(Observes, "observe", (Obs(),), {})
        return Request("call", obs, kwargs=asdict(call))
    return Request(op, Obs(), kwargs=kwargs)


def put(engine: Engine, session: str, op: Any, **kwargs: Any) -> queue.SimpleQueue[Reply]:
    return asked(engine, session, request_of(op, **kwargs))


def ask(engine: Engine, session: str, op: Any, **kwargs: Any) -> Reply:
    reply = put(engine, session, op, **kwargs).get(timeout=10)
    assert reply.error is None
    return reply


def hang(engine: Engine, op: str) -> queue.SimpleQueue[Reply]:
    """Begin a call of that kind that does not return, after its warm-up."""
    ask(engine, "good", "reset")
    for session in ("a", "b"):
        ask(engine, session, "reset")
        ask(engine, session, "observe")
        ask(engine, session, "act")
        ask(engine, session, "export")
    if op == "reset":
        replies = put(engine, "bad", "reset", hangs_at="reset")
    else:
        ask(engine, "bad", "reset", hangs_at=op)
        replies = put(engine, "bad", op)
    wait_for(lambda: engine.calls.under_way)
    return replies


def act_with_report() -> Request:
    return Request("act", Obs(info={TICKS: [5, 2]}))


def test_the_ticks_of_a_request_behind_a_hung_call_count_once_with_the_answer_that_it_gets_later(
    engine: Engine, agent: Hanging, clock: Clock
) -> None:
    """The error of the request asks its client to repeat it, so its ticks count only with the later
    answer.
    """
    engine.stats.enable()
    ask(engine, "bad", "reset", hangs_at="act")
    ask(engine, "good", "reset")
    hung = asked(engine, "bad", act_with_report())
    wait_for(lambda: engine.calls.under_way)
    behind = asked(engine, "good", act_with_report())
    clock.now += 1000.0
    engine.notice_hung()
    assert isinstance(hung.get(timeout=10).error, OutcomeUnknown)
    assert isinstance(behind.get(timeout=10).error, PolicyUnavailable)
    # The ticks of the hung call, which is not repeated.
    assert engine.stats.collect().ticks == {"robot": 5}

    agent.over.set()
    wait_for(lambda: not engine.calls.under_way)
    engine.notice_hung()
    assert answered(engine, "good", act_with_report()).error is None
    assert engine.stats.collect().ticks == {"robot": 5}
    shares = [session.times.lately(engine.clock()) for session in engine.sessions.all()]
    assert [share.ticks for share in shares] == [5, 5]


def test_the_ticks_of_an_act_that_is_checked_twice_count_once(engine: Engine) -> None:
    """After the search for its session, a call is checked a second time and queued."""
    ask(engine, "good", "reset")
    replies: queue.SimpleQueue[Reply] = queue.SimpleQueue()
    act = pending("good", act_with_report(), replies.put)
    act.reserved = engine.intake.reserve(act)
    engine.intake.retry(act)
    assert replies.get(timeout=10).error is None
    [session] = engine.sessions.all()
    assert session.times.lately(engine.clock())[:2] == (5, 2)


OPS = ["reset", "act", "observe", "export"]


@pytest.mark.parametrize("op", OPS)
def test_a_call_over_its_limit_is_unhealthy_those_who_wait_for_it_are_answered_and_no_others_are_let_in(
    engine: Engine, agent: Hanging, clock: Clock, op: str, caplog: pytest.LogCaptureFixture
) -> None:
    engine.stats.enable()
    begun, behind = hang(engine, op), put(engine, "good", "act")
    clock.now += 9.9
    engine.notice_hung()
    assert engine.health.ready
    assert begun.empty()
    assert behind.empty()
    clock.now += 0.2
    assert not engine.health.ready
    with pytest.raises(
        PolicyUnavailable, match=rf"not returned from '{op}' for 10.1 s; its limit is 10 s"
    ):
        engine.health.check()
    engine.notice_hung()
    engine.notice_hung()
    # The hanging call must not be repeated at another replica, which would also hang. A call that
    # has not begun may be repeated.
    assert isinstance(begun.get(timeout=10).error, OutcomeUnknown)
    assert isinstance(behind.get(timeout=10).error, PolicyUnavailable)
    late: queue.SimpleQueue[Reply] = queue.SimpleQueue()  # this request was checked just before
    engine.queue.put(pending("good", Request("act", Obs()), late.put))
    engine.notice_hung()
    assert isinstance(late.get(timeout=10).error, PolicyUnavailable)
    with pytest.raises(PolicyUnavailable, match="another replica"):
        put(engine, "good", "act")
    assert engine.stats.collect().hung == {op: 1}
    assert caplog.text.count("not returned from") == 1
    assert "self.over.wait" in caplog.text  # the line at which the call hangs
    agent.over.set()
    wait_for(lambda: not engine.calls.under_way)
    engine.notice_hung()
    assert engine.health.ready
    assert "has returned" in caplog.text
    ask(engine, "good", "act")
    assert begun.empty()


def test_every_batch_size_may_compile_where_batches_have_fixed_sizes(
    agent: Hanging, clock: Clock
) -> None:
    engine = Engine(agent, EngineSettings(limits=LIMITS, batch_sizes=[1, 2], max_batch_size=2))
    engine.calls.clock = clock
    engine.start()
    hang(engine, "act")
    [call] = engine.calls.under_way
    model = engine.model.loaded
    assert call is model.call("act", 1)
    assert (call.limit_s, model.call("act", 2).limit_s) == (10.0, 100.0)
    agent.over.set()
    engine.close()


def test_a_slow_policy_has_ten_times_its_longest_call(clock: Clock) -> None:
    call = PolicyCall(PolicyCalls(LIMITS, clock), "act")
    limits = []
    for took_s in (300.0, 40.0, 50.0, 0.0):  # the first call included compilation
        limits.append(call.limit_s)
        with call:
            clock.now += took_s
    assert limits == [100.0, 100.0, 400.0, 500.0]
    assert PolicyCall(PolicyCalls(LIMITS, clock), LOAD).limit_s == 1000.0


def test_a_policy_that_never_loads_has_failed() -> None:
    class Loading(Hanging):
        def initialize(self) -> None:
            self.over.wait(60)

    agent = Loading()
    engine = Engine(agent, EngineSettings(limits=CallLimits(load_s=0.05)))
    with pytest.raises(PolicyFailed, match=r"not loaded within 0.05 s"):
        engine.start()
    with pytest.raises(PolicyFailed, match="did not load"):
        engine.health.check()
    agent.over.set()


def test_an_engine_whose_policy_hangs_ends_all_the_same(
    agent: Hanging, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    engine = Engine(agent)
    engine.start()
    # Without this, `stop` would wait for the batch, although not forever.
    monkeypatch.setattr(engine, "stop", lambda **_: None)
    monkeypatch.setattr("vlagents_ray.serve.models.served_model._CLOSE_S", 0.05)
    ask(engine, "bad", "reset", hangs_at="act")
    put(engine, "bad", "act")
    wait_for(lambda: engine.calls.under_way)
    engine.close()
    assert "still busy" in caplog.text


@pytest.mark.parametrize("hangs", [True, False])
def test_health_answers_at_once_though_the_policys_own_check_hangs(
    engine: Engine, agent: Hanging, monkeypatch: pytest.MonkeyPatch, hangs: bool
) -> None:
    monkeypatch.setattr("vlagents_ray.serve.endpoints.http._HEALTH_S", 0.05 if hangs else 30.0)

    def check_health(agent: Hanging) -> None:
        if hangs:
            agent.over.wait(60)

    monkeypatch.setattr(Hanging, "check_health", check_health, raising=False)
    with TestClient(build_http_app(engine, dict, MessageLimits())) as client:
        assert client.get("/healthz").status_code == (503 if hangs else 200)
        agent.over.set()


def test_a_local_client_is_refused_though_the_thread_that_reads_its_requests_hangs(
    engine: Engine, clock: Clock
) -> None:
    endpoint = ShmServer(engine, MessageLimits(), NoKey.OPEN)
    endpoint.open()
    waiting = client(endpoint)
    assert call(waiting, request("reset"), 60).error is None
    hang(engine, "act")
    with ThreadPoolExecutor(1) as threads:
        asked = threads.submit(call, waiting, request("act"), 60)
        clock.now += 11.0
        engine.notice_hung()
        assert isinstance(asked.result().error, PolicyUnavailable)
    assert isinstance(call(waiting, request("reset"), 60).error, PolicyUnavailable)
    assert engine.calls.under_way
    waiting.close()
    endpoint.close()


class Forking(Agent):
    """A policy that forks in each call. The child `ends` like a successful call, or raises
    SystemExit.
    """

    shared = ("children",)

    def __init__(self, ends: str) -> None:
        self.children: queue.SimpleQueue[int] = queue.SimpleQueue()
        self.ends = ends

    def _fork(self) -> None:
        with warnings.catch_warnings():  # Python warns because the process has threads
            warnings.simplefilter("ignore", DeprecationWarning)
            child = os.fork()
        if child:
            self.children.put(child)
        elif self.ends == "exits":
            sys.exit(0)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self._fork()
        return {}

    def observe(self, obs: Obs) -> None:
        self._fork()

    def act(self, obs: Obs) -> Act:
        self._fork()
        return Act(np.zeros(1, np.float32))

    def __getstate__(self) -> dict[str, Any]:
        self._fork()
        return self.__dict__


@pytest.mark.slow
@pytest.mark.parametrize("ends", ["returns", "exits"])
@pytest.mark.parametrize("op", OPS)
def test_a_child_that_the_policy_forks_ends_with_the_call_and_answers_nobody(
    op: str, ends: str
) -> None:
    """Otherwise the child would continue with the clients' sockets and with an older state of their
    sessions.
    """
    agent = Forking(ends)
    engine = Engine(agent)
    engine.start()
    ask(engine, "one", "reset")
    if op != "reset":
        ask(engine, "one", op)
    children = [psutil.Process(agent.children.get()) for _ in range(agent.children.qsize())]
    ended, alive = psutil.wait_procs(children, 10)
    for child in alive:
        child.kill()
    engine.close()
    assert not alive
    assert {child.returncode for child in ended} == {1}


# A policy whose accelerator has failed, or whose batches all fail.


ASSERT = "CUDA error: device-side assert triggered"


class Failing(Agent):
    """A policy that raises the error set for a call."""

    shared = ("errors",)

    def __init__(self) -> None:
        # Errors by operation; an empty dict would not be shared.
        self.errors: dict[str, Exception] = {"none": ValueError()}

    def _raise(self, op: str) -> None:
        if op in self.errors:
            raise self.errors[op]

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self._raise("reset")
        return {}

    def observe(self, obs: Obs) -> None:
        self._raise("observe")

    def act(self, obs: Obs) -> Act:
        self._raise("act")
        return Act(np.zeros(1, np.float32))

    def act_batch(self, obs: Any, sessions: Any) -> list[Act | Exception]:
        self._raise("act_batch")
        return super().act_batch(obs, sessions)


@pytest.fixture
def failing(
    serving: Callable[..., Engine],
) -> tuple[Engine, Failing, Callable[[Any], Exception | None]]:
    """Return an engine, its policy, and a function that sends requests."""
    policy = Failing()
    engine = serving(policy)
    return engine, policy, lambda op: answered(engine, "a", request_of(op)).error


@pytest.mark.parametrize("op", ["reset", "observe", "act", "act_batch"])
def test_a_replica_whose_accelerator_failed_is_not_healthy_and_sends_its_clients_away(
    failing: tuple[Engine, Failing, Callable[[Any], Exception | None]], op: str
) -> None:
    engine, policy, ask = failing
    assert ask("reset") is None
    engine.health.check()
    policy.errors[op] = RuntimeError(f"{ASSERT}\nmore")
    assert isinstance(ask(op.removesuffix("_batch")), PolicyFailed)
    policy.errors.clear()
    with pytest.raises(PolicyUnavailable, match=ASSERT):
        engine.health.check()
    assert not engine.health.ready
    for later in ("reset", "act"):
        with pytest.raises(PolicyUnavailable, match="begins again at another one"):
            ask(later)


@pytest.mark.parametrize("op", ["act", "act_batch"])
def test_a_replica_all_of_whose_batches_fail_is_not_healthy_until_one_does_not(
    failing: tuple[Engine, Failing, Callable[[Any], Exception | None]], op: str
) -> None:
    engine, policy, ask = failing
    assert ask("reset") is None
    policy.errors[op] = ZeroDivisionError("of the policy")
    for _ in range(FAILED_BATCHES):
        engine.health.check()
        assert isinstance(ask("act"), PolicyFailed)
    with pytest.raises(PolicyFailed, match=f"the last {FAILED_BATCHES} batches failed as a whole"):
        engine.health.check()
    policy.errors.clear()
    assert ask("act") is None
    engine.health.check()


@pytest.mark.parametrize(
    "error",
    [
        InvalidObservation("of a client"),
        PolicyUnavailable("of a policy elsewhere"),
        RuntimeError("CUDA out of memory"),
    ],
)
def test_what_another_replica_could_not_do_better_leaves_a_replica_healthy(
    failing: tuple[Engine, Failing, Callable[[Any], Exception | None]], error: Exception
) -> None:
    engine, policy, ask = failing
    assert ask("reset") is None
    policy.errors["act"] = error
    rounds = 1 if isinstance(error, RuntimeError) else FAILED_BATCHES + 1
    assert all(ask("act") is not None for _ in range(rounds))
    engine.health.check()
