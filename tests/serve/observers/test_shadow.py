"""What is sent to a candidate, that it is bounded, and that the live policy's replies do not depend on it."""

from __future__ import annotations

import threading
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from functools import partial

import numpy as np
import pytest
from eval_fakes import wait_for
from hypothesis import given
from hypothesis import strategies as st
from in_flight import read_requests, send
from manual_clock import Clock
from observed import observe
from shadowed_agents import Seeded

from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.interface import Act, Obs
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Budget, Reply, Request
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import Sender
from vlagents_ray.serve.observers.shadow import PER_SESSION, ShadowSender, Turn, chosen

SESSIONS = [f"session-{number}" for number in range(4000)]


def observed(value: int = 0) -> Obs:
    return Obs({"front": np.full((8, 8, 3), value, np.uint8)}, 1.0, {"joints": np.ones(7, np.float32)})


class Candidate:
    """Notes what it is asked, while it is not held; it knows no session in `unknown`, and fails with `failure`."""

    def __init__(self) -> None:
        self.turns: list[Turn] = []
        self.unknown: set[str] = set()
        self.failure: Exception | None = None
        self.free = threading.Event()
        self.free.set()

    def __call__(self, turns: Sequence[Turn]) -> Collection[str]:
        self.turns += turns
        assert self.free.wait(60)
        if self.failure is not None:
            raise self.failure
        return self.unknown

    def asked(self, op: str = "act") -> list[Request]:
        requests = [read_requests(turn.frame, Budget(DEFAULT_LIMITS))[0] for turn in self.turns]
        return [one for one in requests if isinstance(one, Request) and one.op == op]


class Followed:
    """A sender beside a live policy that a test plays."""

    def __init__(self, candidate: Candidate, share: float = 1.0, room: int = 32) -> None:
        self.candidate = candidate
        self.open = set(SESSIONS)
        self.clock = Clock()
        self.sender = ShadowSender(candidate, share, room, self.open.__contains__, self.clock)

    def ask(self, request: Request, session: str = "a", reply: Reply | None = None) -> None:
        """A request and its reply, as the live policy handles them."""
        self.open.add(session)
        observe(self.sender, session, request, reply or Reply(act=Act(np.zeros(7, np.float32))))

    def reset(self, session: str = "a") -> None:
        self.ask(Request("reset", observed(), "stack", {"seed": 3}), session, Reply(info={"weights": "a", "told": 1}))

    def act(self, value: int = 0, session: str = "a", reply: Reply | None = None) -> None:
        self.ask(Request("act", observed(value)), session, reply)


@contextmanager
def following(share: float = 1.0, room: int = 32) -> Iterator[Followed]:
    followed = Followed(Candidate(), share, room)
    try:
        yield followed
    finally:
        followed.candidate.free.set()
        followed.sender.close()


@pytest.fixture
def followed() -> Iterator[Followed]:
    with following() as one:
        yield one


@given(st.floats(0.05, 1.0))
def test_the_share_of_sessions_is_chosen(share: float) -> None:
    assert np.mean([chosen(one, share) for one in SESSIONS]) == pytest.approx(share, abs=0.04)


@given(st.text(), st.floats(0, 1), st.floats(0, 1))
def test_a_larger_share_keeps_the_sessions_of_a_smaller_one(session: str, one: float, other: float) -> None:
    assert chosen(session, min(one, other)) <= chosen(session, max(one, other))
    assert chosen(session, 1.0)
    assert not chosen(session, 0.0)


def test_the_choice_is_the_same_in_each_process() -> None:
    assert [chosen(one, 0.5) for one in ("a", "b", "key/c", "d")] == [True, False, True, False]


def test_the_candidate_gets_what_the_live_policy_has_acted_on(followed: Followed) -> None:
    followed.reset()
    for value in range(3):
        followed.act(value)
    wait_for(lambda: len(followed.candidate.turns) == 4)
    [reset] = followed.candidate.asked("reset")
    assert (reset.instruction, reset.kwargs, reset.session) == ("stack", {"seed": 3}, "a")
    assert [one.obs and int(one.obs.cameras["front"][0, 0, 0]) for one in followed.candidate.asked()] == [0, 1, 2]
    assert [turn.dropped for turn in followed.candidate.turns] == [0] * 4
    assert followed.candidate.turns[0].reply.info == {"weights": "a"}
    assert followed.candidate.turns[1].reply.act is not None


def test_it_does_not_get_what_the_live_policy_has_refused(followed: Followed) -> None:
    followed.reset()
    followed.act(1, reply=Reply(error=PolicyUnavailable("stops")))
    followed.act(2)
    followed.ask(Request("reset", observed()), "b", Reply(error=PolicyUnavailable("stops")))
    followed.act(3, "b")
    followed.act(4)
    wait_for(lambda: len(followed.candidate.turns) == 3)
    assert [one.obs and int(one.obs.cameras["front"][0, 0, 0]) for one in followed.candidate.asked()] == [2, 4]


def test_sessions_that_are_not_chosen_are_not_sent() -> None:
    with following(share=0.3) as followed:
        for session in SESSIONS[:40]:
            followed.reset(session)
        wanted = {one for one in SESSIONS[:40] if chosen(one, 0.3)}
        wait_for(lambda: len(followed.candidate.turns) + followed.sender.dropped == len(wanted))
        assert {turn.session for turn in followed.candidate.turns} == wanted


def test_a_candidate_that_is_behind_gets_few_of_a_session_and_the_rest_is_counted(followed: Followed) -> None:
    followed.reset()
    wait_for(lambda: len(followed.candidate.turns) == 1)
    followed.candidate.free.clear()
    for value in range(100):
        followed.act(value)
    wait_for(lambda: followed.sender.dropped == 100 - PER_SESSION)
    followed.candidate.free.set()
    wait_for(lambda: len(followed.candidate.asked()) == PER_SESSION)
    followed.act(200)
    wait_for(lambda: len(followed.candidate.asked()) == PER_SESSION + 1)
    assert followed.candidate.turns[-1].dropped == 100 - PER_SESSION


def test_many_sessions_share_the_room() -> None:
    with following(room=10) as followed:
        sessions = SESSIONS[:8]
        for session in sessions:
            followed.reset(session)
        wait_for(lambda: len(followed.candidate.asked("reset")) == 8)
        followed.candidate.free.clear()
        for _ in range(3):
            for session in sessions:
                followed.act(session=session)
        wait_for(lambda: followed.sender.dropped == 24 - 10)
        followed.candidate.free.set()
        wait_for(lambda: len(followed.candidate.asked()) == 10)


def test_one_call_holds_each_session_once_in_its_order(followed: Followed) -> None:
    calls: list[list[str]] = []
    whole = followed.candidate.__call__
    followed.sender._ask = lambda turns: calls.append([turn.session for turn in turns]) or whole(turns)
    for session in ("a", "b"):
        followed.reset(session)
    wait_for(lambda: len(followed.candidate.turns) == 2)
    followed.candidate.free.clear()
    for value in range(3):
        for session in ("a", "b"):
            followed.act(value, session)
    followed.candidate.free.set()
    wait_for(lambda: len(followed.candidate.asked()) == 6)
    assert all(len(set(call)) == len(call) for call in calls)
    for session in ("a", "b"):
        mine = [one for one in followed.candidate.asked() if one.session == session]
        assert [one.obs and int(one.obs.cameras["front"][0, 0, 0]) for one in mine] == [0, 1, 2]


@pytest.mark.parametrize("failure", [PolicyUnavailable("gone"), RuntimeError("broken")])
def test_an_episode_that_the_candidate_has_lost_is_followed_again_from_its_next_reset(
    followed: Followed, failure: Exception
) -> None:
    followed.reset()
    wait_for(lambda: len(followed.candidate.turns) == 1)
    followed.candidate.failure = failure
    followed.act(1)
    wait_for(lambda: followed.sender.dropped == 1)
    followed.candidate.failure = None
    followed.act(2)
    wait_for(lambda: followed.sender.dropped == 2)
    followed.reset()
    followed.act(3)
    wait_for(lambda: len(followed.candidate.asked()) == 2)
    assert [one.obs and int(one.obs.cameras["front"][0, 0, 0]) for one in followed.candidate.asked()] == [1, 3]


def test_a_reset_that_waits_behind_a_lost_episode_is_sent(followed: Followed) -> None:
    followed.reset()
    wait_for(lambda: len(followed.candidate.turns) == 1)
    followed.candidate.free.clear()
    followed.candidate.failure = PolicyUnavailable("gone")
    for value in range(2):
        followed.act(value)
    followed.reset()
    wait_for(lambda: len(followed.candidate.turns) == 2)
    wait_for(lambda: len(followed.sender._waiting) == 2)
    followed.candidate.free.set()
    wait_for(lambda: len(followed.candidate.asked("reset")) == 2)
    assert followed.sender.dropped == 2


def test_a_session_that_the_candidate_does_not_know_is_dropped_alone(followed: Followed) -> None:
    for session in ("a", "b"):
        followed.reset(session)
    wait_for(lambda: len(followed.candidate.turns) == 2)
    followed.candidate.unknown = {"a"}
    followed.act(1, "a")
    wait_for(lambda: len(followed.candidate.asked()) == 1)
    for session in ("a", "b"):
        followed.act(2, session)
    wait_for(lambda: len(followed.candidate.asked()) == 2)
    assert followed.candidate.turns[-1].session == "b"
    wait_for(lambda: followed.sender.dropped == 1)


def test_sessions_that_end_are_closed_at_the_candidate(followed: Followed) -> None:
    for session in ("a", "b"):
        followed.reset(session)
    followed.ask(Request("close"), "a", Reply(info={}))
    wait_for(lambda: [one.session for one in followed.candidate.asked("close")] == ["a"])
    followed.open.clear()  # the connection of the other one has ended
    followed.clock.now += 10
    followed.reset("c")
    wait_for(lambda: [one.session for one in followed.candidate.asked("close")] == ["a", "b"])


def episode(engine: Engine) -> bytes:
    """The actions of an episode, to the bit."""
    actions = b""
    sender = Sender(engine, "test", "a", caller=NoKey.INSIDE)
    rng = np.random.default_rng(5)

    def ask(request: Request) -> Reply:
        found: list[Reply] = []
        send(sender, [request], found.extend)
        wait_for(lambda: bool(found), every_s=0.0005)
        assert found[0].error is None
        return found[0]

    ask(Request("reset", observed(), "stack", {"seed": 3}))
    for _ in range(30):
        obs = Obs({"front": rng.integers(0, 255, (8, 8, 3), np.uint8)}, 1.0, {"joints": rng.random(7, np.float32)})
        act = ask(Request("act", obs)).act
        assert act is not None
        actions += act.action.tobytes()
    return actions


def raises(turns: Sequence[Turn]) -> Collection[str]:
    raise RuntimeError("the candidate is broken")


def hangs(release: threading.Event, turns: Sequence[Turn]) -> Collection[str]:
    release.wait(60)
    return ()


@pytest.mark.parametrize("kind", ["answers", "raises", "hangs"])
def test_the_live_actions_are_the_same_to_the_bit(kind: str) -> None:
    engine, release = Engine(Seeded()), threading.Event()
    ask = {"answers": lambda _: (), "raises": raises, "hangs": partial(hangs, release)}[kind]
    engine.start()
    sender = ShadowSender(ask, 1.0, 8, engine.sessions.__contains__)
    try:
        alone = episode(engine)
        observers = engine.observers
        observers.add(sender)
        beside = episode(engine)
        observers.remove(sender)
    finally:
        release.set()
        sender.close()
        engine.close()
    assert beside == alone
    assert sender.dropped > 0 or kind == "answers"
