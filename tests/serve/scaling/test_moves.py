"""Sessions begin, act, move, get new weights and end in any order, with a policy in this process or
in a child process.

After each answer, every session is at exactly one replica, with the state and the weights that its
client expects.
"""

from __future__ import annotations

import asyncio
import gc
import itertools
import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial, wraps
from typing import Any

import numpy as np
import pytest
from gain_policies import Gain, gains, in_child
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test
from in_flight import send
from in_memory_keys import ChangingKeys
from in_process_replicas import Replicas, _Peer

from vlagents_ray.errors import DeadlineExceeded, TooManyRequests, UnknownSession
from vlagents_ray.interface import Agent, Obs
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.access.api_keys import Caller, NoKey
from vlagents_ray.serve.engine.sender import Sender
from vlagents_ray.serve.scaling.session_migration import HeldSessions
from vlagents_ray.serve.weights import PushMode, PushOptions, Rest

_NAMES = ("a", "b", "c")
_NUMBERS = itertools.count()


@dataclass
class _Session:
    """The state that the client of a session expects."""

    acts: int
    version: int
    follows: bool
    step: int | None


@pytest.fixture(
    scope="module", params=[Gain, partial(in_child, "Gain")], ids=["in this process", "in a child"]
)
def served(request: pytest.FixtureRequest) -> Iterator[Replicas]:
    replicas = Replicas([request.param(), request.param()])
    yield replicas
    replicas.close()


def ask(
    served: Replicas,
    at: int,
    op: Any,
    name: str,
    caller: Caller | NoKey = NoKey.OPEN,
    **fields: Any,
) -> Reply:
    """Send a request like a plain HTTP client."""
    return begin(served, at, op, name, caller, **fields).get(timeout=30)


def begin(
    served: Replicas,
    at: int,
    op: Any,
    name: str,
    caller: Caller | NoKey = NoKey.OPEN,
    **fields: Any,
) -> queue.SimpleQueue[Reply]:
    replies: queue.SimpleQueue[Reply] = queue.SimpleQueue()
    sender = Sender(served.engines[at], "http", name, connected=False, caller=caller, has_left=None)
    send(sender, [Request(op, Obs(), **fields)], lambda answers: replies.put(answers[0]))
    return replies


class Moves(RuleBasedStateMachine):
    """Two replicas, and the clients of three sessions."""

    served: Replicas

    def __init__(self) -> None:
        super().__init__()
        example = next(_NUMBERS)
        self.names = {name: f"{example}-{name}" for name in _NAMES}
        self.open: dict[str, _Session] = {}
        self.newest = self.served.engines[0].weights.number
        self.pinned = self.served.engines[0].model.own_weights.pinned.number

    @rule(name=st.sampled_from(_NAMES), at=st.sampled_from([0, 1]), follows=st.booleans())
    def reset(self, name: str, at: int, follows: bool) -> None:
        kwargs = {"weights": "follow" if follows else "pinned", "seed": 3}
        known = self.open.get(name)
        reply = ask(
            self.served, at, "reset", self.names[name], kwargs=kwargs, step=known and known.step
        )
        assert reply.error is None
        self.open[name] = _Session(0, self.newest if follows else self.pinned, follows, reply.step)

    @rule(name=st.sampled_from(_NAMES), at=st.sampled_from([0, 1]), steps=st.booleans())
    def act(self, name: str, at: int, steps: bool) -> None:
        session = self.open.get(name)
        reply = ask(
            self.served,
            at,
            "act",
            self.names[name],
            step=session.step if session and steps else None,
        )
        if session is None:
            assert isinstance(reply.error, UnknownSession)
            return
        if reply.error is not None:
            raise reply.error
        drawn = np.random.default_rng(3).random(session.acts + 1)[-1]
        assert reply.act.action[2] == np.float32(drawn), "an act was lost or executed twice"
        version = reply.act.info["policy"]["version"]
        assert version == session.version
        assert reply.act.action[0] == version, "the session acts with other weights than it reports"
        session.acts, session.step = session.acts + 1, reply.step

    @rule(name=st.sampled_from(_NAMES))
    def end(self, name: str) -> None:
        at = self._place(name)
        if at is not None:
            assert ask(self.served, at, "close", self.names[name]).error is None
        self.open.pop(name, None)

    @rule(name=st.sampled_from(_NAMES))
    def offer(self, name: str) -> None:
        """The replica of the session hands it over, like a replica that stops."""
        at = self._place(name)
        if at is None:
            return
        held, other = self.served.migrators[at].sessions, _Peer(self.served, 1 - at)
        given = held.send_to_peer(self.names[name], [other])
        asyncio.run_coroutine_threadsafe(given, self.served._loop).result(30)
        assert self._place(name) == 1 - at

    @rule(mode=st.sampled_from(["keep", "next_episode"]), pin=st.booleans(), missed=st.booleans())
    def push(self, mode: PushMode, pin: bool, missed: bool) -> None:
        """Push new weights. A replica that `missed` the commit gets them from the other replica."""
        number, options = self.newest + 1, PushOptions(mode=mode, pin=pin)
        first, second = (engine.weights for engine in self.served.engines)
        for updates in (first, second):
            updates.stage(number, gains(float(number)), options)
        first.commit(number, options)
        if missed:
            second.drop(number)
            [held] = [version for version in first.pushed_versions() if version.number == number]
            second.stage(number, held.values, replace(options, allow_same=True))
        second.commit(number, options)
        self.newest = number
        if pin:
            self.pinned = number
        for session in self.open.values():
            if mode == "keep" and session.follows:
                session.version = number

    @rule(name=st.sampled_from(_NAMES), op=st.sampled_from(["reset", "act"]))
    def ask_one_that_sleeps(self, name: str, op: str) -> None:
        """A request whose deadline passes while the policy sleeps has no effect."""
        at = self._place(name)
        if at is None:
            return
        engine = self.served.engines[at]
        engine.weights.rest(Rest("sleep", offload=False))
        late = begin(self.served, at, op, self.names[name], deadline_ms=5.0)
        threading.Event().wait(0.01)  # the deadline passes
        engine.weights.rest(Rest("wake"))
        assert isinstance(late.get(timeout=30).error, DeadlineExceeded)

    @invariant()
    def no_state_is_of_a_reset_that_never_was(self) -> None:
        for engine in self.served.engines:
            for session in engine.sessions.all():
                assert session.version == (session.steps, session.moves)

    @invariant()
    def each_session_is_at_one_replica(self) -> None:
        for name in self.open:
            assert self._place(name) is not None

    def teardown(self) -> None:
        for name in list(self.open):
            self.end(name)

    def _place(self, name: str) -> int | None:
        places = [
            at
            for at, engine in enumerate(self.served.engines)
            if self.names[name] in engine.sessions
        ]
        assert len(places) <= 1
        return places[0] if places else None


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_sessions_survive_any_order_of_moves_pushes_and_rests(served: Replicas) -> None:
    class Served(Moves):
        pass

    Served.served = served
    run_state_machine_as_test(
        Served,
        settings=settings(
            max_examples=20,
            stateful_step_count=25,
            deadline=None,
            suppress_health_check=list(HealthCheck),
            print_blob=True,
        ),
    )


def test_a_session_that_moves_acts_with_the_weights_that_were_pushed_before(
    served: Replicas,
) -> None:
    """The child process of the first replica last acted for this session with older weights, which
    the other replica's child may still have.
    """
    number = served.engines[0].weights.number + 1
    follows = {"weights": "follow"}
    assert ask(served, 0, "reset", "moving", kwargs=follows).error is None
    options = PushOptions(mode="keep")
    for engine in served.engines:
        engine.weights.stage(number, gains(float(number)), options)
        engine.weights.commit(number, options)
    # The new weights are in use at the second replica.
    assert ask(served, 1, "reset", "beside", kwargs=follows).error is None
    reply = ask(served, 1, "act", "moving")
    for name in ("moving", "beside"):
        assert ask(served, 1, "close", name).error is None
    assert reply.error is None
    assert reply.act.info["policy"]["version"] == reply.act.action[0] == number


@pytest.mark.parametrize("stops", [False, True])
def test_sessions_move_with_weights_that_no_other_session_uses(
    served: Replicas, stops: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other replica has freed these weights. It fetches them once for all sessions, and frees
    them with the last session.
    """
    fetched: list[str] = []
    weights = HeldSessions.weights

    @wraps(weights)
    async def counted(held: HeldSessions, session_id: str) -> dict[str, Any] | None:
        fetched.append(session_id)
        return await weights(held, session_id)

    monkeypatch.setattr(HeldSessions, "weights", counted)
    kwargs, names = {"weights": "follow"}, [f"moving {number}" for number in range(4)]
    first = max(engine.weights.number for engine in served.engines) + 1
    for number in (first, first + 1, first + 2):
        for engine in served.engines:
            engine.weights.stage(number, gains(float(number)), PushOptions())
            engine.weights.commit(number, PushOptions())
        if number == first:
            assert all(ask(served, 0, "reset", name, kwargs=kwargs).error is None for name in names)
    alive = served.engines[1].model.own_weights._alive
    assert first not in alive
    if stops:
        held, other = served.migrators[0].sessions, _Peer(served, 1)
        for name in names:
            asyncio.run_coroutine_threadsafe(held.send_to_peer(name, [other]), served._loop).result(
                30
            )
    for reply in [
        answer.get(timeout=30) for answer in [begin(served, 1, "act", name) for name in names]
    ]:
        assert reply.error is None
        assert reply.act.info["policy"]["version"] == reply.act.action[0] == first
    assert len(fetched) == 1
    for name in names:
        assert ask(served, 1, "close", name).error is None
    for op in ("reset", "act", "close"):  # the policy acts with other weights
        assert ask(served, 1, op, "beside", kwargs=kwargs if op == "reset" else {}).error is None
    gc.collect()
    assert first not in alive


def test_no_key_has_more_sessions_at_a_replica_than_it_may_whatever_moves_there() -> None:
    keys = ChangingKeys()
    caller = keys.keys.check(keys.add("sim", sessions=2), "app")
    served = Replicas([Gain(), Gain()])
    try:
        for number in range(6):
            if number % 2 == 0:
                assert ask(served, 0, "reset", f"s{number}", caller).error is None
            else:
                assert ask(served, 0, "reset", f"s{number}", caller).error is None
                # Both requests are sent at once.
                answers = [begin(served, 1, "act", f"s{number - n}", caller) for n in (0, 1)]
                errors = [answer.get(timeout=30).error for answer in answers]
                if number == 1:
                    assert errors == [None, None]
                else:
                    assert all(isinstance(error, TooManyRequests) for error in errors)
                    for n in (0, 1):
                        assert ask(served, 0, "act", f"s{number - n}", caller).error is None, (
                            "the session stayed at its replica"
                        )
                        assert ask(served, 0, "close", f"s{number - n}", caller).error is None
        assert len(served.engines[1].sessions) == 2
    finally:
        served.close()


class Guarded(Agent):
    """A policy that requires the lock of the model in each of its methods."""

    held: Callable[[], bool] = staticmethod(lambda: True)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        assert Guarded.held(), "reset"
        return {}

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> Any:
        assert Guarded.held(), "act"
        return Gain.act_batch(self, obs, sessions)

    def act(self, obs: Obs) -> Any:
        from vlagents_ray import Act

        return Act(np.zeros(1, np.float32))

    def __getstate__(self) -> dict[str, Any]:
        assert Guarded.held(), "export"
        return self.__dict__

    def __setstate__(self, state: dict[str, Any]) -> None:
        assert Guarded.held(), "adoption"
        self.__dict__.update(state)


def test_no_method_of_a_policy_runs_without_its_lock(monkeypatch: pytest.MonkeyPatch) -> None:
    served = Replicas([Guarded(), Guarded()], batch_sizes=(4,), max_batch_size=4)
    try:
        models = [engine.model.require_loaded() for engine in served.engines]
        monkeypatch.setattr(
            Guarded, "held", staticmethod(lambda: any(model.busy.locked() for model in models))
        )
        for at, op in [(0, "reset"), (0, "act"), (1, "act"), (0, "act"), (0, "close")]:
            reply = ask(served, at, op, "robot")
            assert reply.error is None, (op, reply.error)
    finally:
        served.close()
