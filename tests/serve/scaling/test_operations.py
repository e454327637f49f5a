"""Each operation on a session, from each kind of client, in each situation, has the outcome that
one rule gives: it applies to the episode to which it belongs, wherever that episode is, and to no
other.
"""

from __future__ import annotations

import asyncio
import queue
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, get_args

import numpy as np
import pytest
from eval_fakes import wait_for
from in_flight import send
from in_process_replicas import Replicas

from vlagents_ray import Act, Agent, Obs
from vlagents_ray.errors import NotReset, UnknownSession
from vlagents_ray.protocol.messages import BACKGROUND_OPS, IMMEDIATE_OPS, OPS, Op, Reply, Request
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.engine.sender import Sender

ARM = "arm"
# Operations that clients cannot send: replicas send them to each other's engines, or to the process
# of a policy.
INNER = ("call", "export", "adopt", "weights", "release", "raise_step")


class Counting(Agent):
    """A policy that answers with its instruction and its number of acts. A reset waits at a gate if
    its option requests it.
    """

    gate = threading.Event()
    entered = threading.Semaphore(0)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.instruction, self.acts = instruction, 0
        if kwargs.get("wait"):
            self.entered.release()
            assert self.gate.wait(20)
        return {}

    def act(self, obs: Obs) -> Act:
        self.acts += 1
        return Act(np.array([self.acts], np.float32), info={"obeys": self.instruction})


@dataclass
class State:
    """The state that an observer expects of the session: None without an episode."""

    episode: str | None
    acts: int = 0


@dataclass(frozen=True)
class Kind:
    """A kind of client."""

    connected: bool  # whether it has a connection; otherwise it uses HTTP
    steps: bool  # whether it sends the step of the last answer

    def __str__(self) -> str:
        transport = "connection" if self.connected else "HTTP"
        return f"{transport} {'with' if self.steps else 'without'} steps"


KINDS = [Kind(connected, steps) for connected in (True, False) for steps in (True, False)]


class Client:
    """A client of one replica."""

    def __init__(self, replicas: Replicas, at: int, kind: Kind, step: int | None = None) -> None:
        self._engine, self._kind, self._step = replicas.engines[at], kind, step
        self._connection = self._sender() if kind.connected else None

    def _sender(self) -> Sender:
        name, connected = ("", True) if self._kind.connected else (ARM, False)
        return Sender(
            self._engine, "test", name, caller=NoKey.OPEN, has_left=None, connected=connected
        )

    def begin(self, op: Any, instruction: str | None = None, **kwargs: Any) -> Callable[[], Reply]:
        """Send a request, and return the function that waits for its answer."""
        replies: queue.SimpleQueue[list[Reply]] = queue.SimpleQueue()
        request = Request(op, Obs(), instruction, kwargs, session=ARM)
        if self._kind.steps and op != "reset":
            request.step = self._step
        send(self._connection or self._sender(), [request], replies.put)
        return partial(self._receive, replies)

    def _receive(self, replies: queue.SimpleQueue[list[Reply]]) -> Reply:
        [reply] = replies.get(timeout=20)
        if reply.step is not None:
            self._step = reply.step
        return reply

    def ask(self, op: Any, instruction: str | None = None) -> Reply:
        return self.begin(op, instruction)()

    def returned(self, replicas: Replicas, at: int) -> Client:
        """Return the client after it has connected to a replica again."""
        return Client(replicas, at, self._kind, self._step)


@dataclass
class Situation:
    """The client that sends the operation, and the state of the session before it."""

    client: Client
    state: State
    # Whether an operation without a step belongs to the current episode, by the kind of client.
    belongs: bool
    go_on: Callable[[], object] = lambda: None  # called while the operation waits


@pytest.fixture
def replicas() -> Iterator[Replicas]:
    Counting.gate.clear()
    served = Replicas([Counting(), Counting()])
    yield served
    Counting.gate.set()
    served.close()


def begun(replicas: Replicas, kind: Kind) -> Client:
    """Return a client that has acted once in its episode at the first replica."""
    client = Client(replicas, 0, kind)
    assert client.ask("reset", "episode 1").error is None
    assert client.ask("act").error is None
    return client


def same_replica(replicas: Replicas, kind: Kind) -> Situation:
    return Situation(begun(replicas, kind), State("episode 1", 1), belongs=True)


def other_replica(replicas: Replicas, kind: Kind) -> Situation:
    client = begun(replicas, kind).returned(replicas, 1)
    return Situation(client, State("episode 1", 1), belongs=True)


def older_connection(replicas: Replicas, kind: Kind) -> Situation:
    """Another client of the same kind has begun an episode since."""
    client, newer = begun(replicas, kind), Client(replicas, 0, kind)
    assert newer.ask("reset", "episode 2").error is None
    assert newer.ask("act").error is None
    # Without a step, an HTTP request belongs to the episode that is current when it arrives.
    belongs = not (kind.connected or kind.steps)
    return Situation(client, State("episode 2", 1), belongs)


def older_connection_elsewhere(replicas: Replicas, kind: Kind) -> Situation:
    """Another client has begun an episode at the other replica since."""
    client, newer = begun(replicas, kind), Client(replicas, 1, kind)
    assert newer.ask("reset", "episode 2").error is None
    assert newer.ask("act").error is None
    belongs = not (kind.connected or kind.steps)
    return Situation(client, State("episode 2", 1), belongs)


def during_a_search(replicas: Replicas, kind: Kind) -> Situation:
    """Another request, which fits no state of the session, has begun a search for it."""
    client = begun(replicas, kind).returned(replicas, 1)
    held, go_on = replicas.migrators[0].sessions, threading.Event()
    copy = held.copy

    async def slow_copy(*args: Any) -> Any:
        assert await asyncio.to_thread(go_on.wait, 20)
        return await copy(*args)

    held.copy = slow_copy  # type: ignore[method-assign]
    lost = Client(replicas, 1, Kind(connected=False, steps=True), step=7).begin("act")

    def end_search() -> None:
        go_on.set()
        # The session of a reset that still waits is not known here yet.
        assert isinstance(lost().error, (UnknownSession, NotReset))

    wait_for(lambda: ARM in replicas.migrators[1]._callbacks)
    return Situation(client, State("episode 1", 1), True, end_search)


def during_a_reset(replicas: Replicas, kind: Kind) -> Situation:
    """The policy executes another client's reset when the operation arrives."""
    client, other = begun(replicas, kind), Client(replicas, 0, Kind(False, False))
    reset = other.begin("reset", "episode 2", wait=True)
    assert Counting.entered.acquire(timeout=10)

    def end_reset() -> None:
        Counting.gate.set()
        assert reset().error is None

    belongs = not (kind.connected or kind.steps)
    return Situation(client, State("episode 2", 0), belongs, end_reset)


def behind_a_reset_in_vain(replicas: Replicas, kind: Kind) -> Situation:
    """Another client's reset, which waits when the operation arrives, is withdrawn."""
    client = begun(replicas, kind)
    busy = Client(replicas, 0, Kind(False, False))
    sender = Sender(
        replicas.engines[0], "test", "busy", caller=NoKey.OPEN, has_left=None, connected=False
    )
    send(sender, [Request("reset", Obs(), "busy", {"wait": True})], lambda _: None)
    assert Counting.entered.acquire(timeout=10)
    [reset] = send(
        busy._sender(), [Request("reset", Obs(), "in vain", session=ARM)], lambda _: None
    )

    def withdraw() -> None:
        replicas.engines[0].intake.withdraw(reset)
        Counting.gate.set()

    return Situation(client, State("episode 1", 1), True, withdraw)


SITUATIONS = [
    same_replica,
    other_replica,
    older_connection,
    older_connection_elsewhere,
    during_a_search,
    during_a_reset,
    behind_a_reset_in_vain,
]


def after_reset(situation: Situation) -> tuple[bool, State]:
    return True, State("a new one")


def after_act(situation: Situation) -> tuple[bool, State]:
    state = situation.state
    if not situation.belongs:
        return False, state
    return True, State(state.episode, state.acts + 1)


def after_close(situation: Situation) -> tuple[bool, State]:
    return True, State(None) if situation.belongs else situation.state


RULES: dict[str, Callable[[Situation], tuple[bool, State]]] = {
    "reset": after_reset,
    "act": after_act,
    "close": after_close,
}
"""For each operation: whether it succeeds, and the state after it."""


def test_each_operation_has_a_rule() -> None:
    assert set(RULES) == set(OPS)
    assert set(get_args(Op)) == {*RULES, *INNER, *IMMEDIATE_OPS, *BACKGROUND_OPS}


@pytest.mark.slow
@pytest.mark.parametrize("op", RULES)
@pytest.mark.parametrize("kind", KINDS, ids=str)
@pytest.mark.parametrize("situation", SITUATIONS, ids=lambda one: one.__name__)
def test_an_operation_applies_to_its_own_episode_wherever_that_is(
    op: str, kind: Kind, situation: Callable[[Replicas, Kind], Situation], replicas: Replicas
) -> None:
    before = situation(replicas, kind)
    answer = before.client.begin(op, "a new one" if op == "reset" else None)
    before.go_on()
    reply = answer()

    is_ok, state = RULES[op](before)
    assert (reply.error is None) is is_ok, reply.error
    if not is_ok:
        assert isinstance(reply.error, UnknownSession)
    if op == "act" and is_ok:
        assert (reply.act.info["obeys"], reply.act.action[0]) == (state.episode, state.acts)

    # An observer acts at both replicas.
    held = [ARM in engine.sessions for engine in replicas.engines]
    assert held.count(True) == (state.episode is not None)
    for at in (0, 1):
        seen = Client(replicas, at, Kind(connected=False, steps=False)).ask("act")
        if state.episode is None:
            assert isinstance(seen.error, UnknownSession)
            continue
        assert seen.error is None
        state.acts += 1
        assert (seen.act.info["obeys"], seen.act.action[0]) == (state.episode, state.acts)
