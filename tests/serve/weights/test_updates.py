"""New weights in one replica: the two phases of a push, the time at which sessions change, and
rejected pushes without effect.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from gain_policies import Doubled, Gain, gains, in_child
from in_flight import answered

from vlagents_ray.errors import (
    InvalidInput,
    InvalidWeights,
    NotTrainable,
    Overloaded,
    PolicyFailed,
    UnchangedWeights,
    UnknownSession,
    WeightsNotStaged,
)
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve import weights as versions
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.sessions import SessionState
from vlagents_ray.serve.weights import PushOptions
from vlagents_ray.weights.trainable import fingerprint

ACT_S = 0.125


class Served:
    """An engine in this process, with a learner."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self.learn = engine.weights

    def reset(self, session: str, priority: Any = "simulation", **options: Any) -> Reply:
        return self.ask(session, Request("reset", Obs(), kwargs=options, priority=priority))

    def act(self, session: str) -> tuple[int, float]:
        """Act, and return the version that acted and the gain in its action."""
        act = self.ask(session, Request("act", Obs())).act
        return act.info["policy"]["version"], float(act.action[0])

    def ask(self, session: str, request: Request) -> Reply:
        reply = answered(self.engine, session, request)
        if reply.error is not None:
            raise reply.error
        return reply

    def push(self, number: int, mode: versions.PushMode = "next_episode") -> str:
        """Push a version whose gain is its number."""
        digest = self.learn.stage(number, gains(number), PushOptions(mode))
        self.learn.commit(number, PushOptions(mode))
        return digest


AGENTS = pytest.mark.parametrize(
    "agent", [Gain, Doubled, in_child], ids=["by reference", "in place", "in a child process"]
)


class Lazy(Doubled):
    """A policy without parameters before its first act, like torch's lazy layers, which infer their
    sizes from it.
    """

    def initialize(self) -> None:
        super().initialize()
        self.size = np.zeros(1, np.int64)  # the size of the layer, once it is known

    def shared_objects(self) -> list[Any]:
        return [*super().shared_objects(), self.size]

    def parameters(self) -> dict[str, Any]:
        return super().parameters() if self.size[0] else {}

    def act(self, obs: Obs) -> Act:
        self.size[0] = 2
        return super().act(obs)


@pytest.mark.parametrize("partial", [False, True])
def test_parameters_that_the_first_act_makes_can_be_pushed(
    serving: Callable[..., Engine], partial: bool
) -> None:
    served = Served(serving(Lazy()))
    options = PushOptions("keep", partial, allow_same=True)
    served.reset("a")
    with pytest.raises(InvalidWeights, match="expected one of the policy's 0 names"):
        served.learn.stage(1, gains(1), options)
    served.act("a")
    served.learn.stage(2, gains(2), options)
    served.learn.commit(2, options)
    assert served.act("a") == (2, 2)


@pytest.mark.slow
@AGENTS
def test_an_episode_ends_with_the_weights_that_it_began_with_unless_they_are_pushed_to_it(
    serving: Callable[..., Engine], agent: type[Gain]
) -> None:
    served = Served(serving(agent()))
    alone = Served(serving(agent()))
    for one in (served, alone):
        one.reset("old", seed=3)
    served.push(1)
    served.reset("new")
    for number in range(2, 5):
        served.push(number)
        assert served.act("new") == (1, 1.0)
        mine, apart = (one.ask("old", Request("act", Obs())).act for one in (served, alone))
        assert mine.info == apart.info
        np.testing.assert_array_equal(mine.action, apart.action, strict=True)
    assert served.reset("old").info == {"gain": 4.0}
    assert served.act("old") == (4, 4.0)
    assert served.act("new") == (1, 1.0)
    digest = served.push(5, "keep")
    assert served.act("new") == (5, 5.0), "running episodes change at once"
    act = served.ask("new", Request("act", Obs())).act
    assert act.info["policy"] == {"version": 5, "fingerprint": digest}
    assert digest == fingerprint(gains(5)), "a copy of the agent's values"


@AGENTS
def test_robots_keep_the_pinned_weights_unless_they_follow(
    serving: Callable[..., Engine], agent: type[Gain]
) -> None:
    served = Served(serving(agent()))
    for session, options in {"pinned": {}, "follows": {"weights": "follow"}}.items():
        served.reset(session, "robot", **options)
    served.reset("baseline", weights="pinned")
    served.push(1, "keep")
    assert {name: served.act(name)[0] for name in ("pinned", "follows", "baseline")} == {
        "pinned": 0,
        "follows": 1,
        "baseline": 0,
    }
    served.reset("pinned", "robot")
    assert served.act("pinned") == (0, 0.0)
    served.learn.stage(2, gains(2), PushOptions())
    served.learn.commit(2, PushOptions(pin=True))
    served.reset("pinned", "robot")
    assert served.act("pinned") == (2, 2.0)
    with pytest.raises(InvalidInput, match=r"weights: expected 'follow' .*, got 7"):
        served.reset("pinned", weights=7)


@pytest.mark.slow
@AGENTS
@pytest.mark.parametrize(
    ("pushed", "error"),
    [
        ({}, InvalidWeights),
        ({"layer/gain": np.full(2, np.nan)}, InvalidWeights),
        (gains(1), UnchangedWeights),
    ],
)
def test_what_is_refused_changes_nothing(
    serving: Callable[..., Engine],
    agent: type[Gain],
    pushed: dict[str, Any],
    error: type[Exception],
) -> None:
    served = Served(serving(agent()))
    served.push(1)
    before = served.learn.describe()
    with pytest.raises(error):
        served.learn.stage(2, pushed, PushOptions())
    with pytest.raises(WeightsNotStaged, match="version 2 is not staged here"):
        served.learn.commit(2, PushOptions("keep"))
    assert served.learn.describe() == before
    served.reset("a")
    assert served.act("a") == (1, 1.0)
    served.push(2)


@AGENTS
def test_a_staged_version_does_not_act_and_a_second_one_has_to_wait(
    serving: Callable[..., Engine], agent: type[Gain]
) -> None:
    served = Served(serving(agent()))
    served.learn.stage(1, gains(1), PushOptions())
    served.reset("a")
    assert served.act("a") == (0, 0.0)
    with pytest.raises(Overloaded, match="another push"):
        served.learn.stage(2, gains(2), PushOptions())
    with pytest.raises(InvalidInput, match=r"mode: expected .*, got 'now'"):
        PushOptions("now")  # type: ignore[arg-type]
    served.learn.drop(1)
    served.push(1)
    served.learn.commit(1, PushOptions("keep"))  # as if its reply had been lost
    with pytest.raises(
        Overloaded,
        match="expected a version above 1, the newest here, got 1, since another push was faster",
    ):
        served.learn.stage(1, gains(3), PushOptions())


def test_a_learner_that_dies_between_the_phases_leaves_the_last_version(
    serving: Callable[..., Engine], monkeypatch: pytest.MonkeyPatch
) -> None:
    served = Served(serving(Gain()))
    monkeypatch.setattr(versions, "STAGED_S", 0.0)
    dropped = threading.Event()
    own = served.engine.model.own_weights
    drop = own.drop
    monkeypatch.setattr(own, "drop", lambda number: (drop(number), dropped.set()))
    served.learn.stage(1, gains(1), PushOptions())
    assert dropped.wait(30)
    with pytest.raises(WeightsNotStaged):
        served.learn.commit(1, PushOptions("keep"))
    served.reset("a")
    assert served.act("a") == (0, 0.0)


@pytest.mark.slow
@AGENTS
def test_versions_never_go_back_and_no_act_fails_while_weights_are_pushed(
    serving: Callable[..., Engine], agent: type[Gain]
) -> None:
    served = Served(serving(agent()))
    over = threading.Event()
    seen: dict[str, list[tuple[int, float]]] = {name: [] for name in "abc"}
    failed: list[BaseException] = []

    def play(session: str) -> None:
        try:
            while not over.is_set():
                served.reset(session)
                seen[session] += [served.act(session) for _ in range(5)]
        except BaseException as error:  # noqa: BLE001 - reported below
            failed.append(error)

    threads = [threading.Thread(target=play, args=(session,)) for session in seen]
    for thread in threads:
        thread.start()
    for number in range(1, 40):
        served.push(number, "keep" if number % 2 else "next_episode")
    over.set()
    for thread in threads:
        thread.join(30)
    assert failed == []
    for acts in seen.values():
        numbers = [number for number, _ in acts]
        assert numbers == sorted(numbers)
        assert all(gain == number for number, gain in acts)


class Slow(Doubled):
    """A policy as slow as π0 with eight rows on a GPU."""

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        time.sleep(ACT_S)
        return super().act_batch(obs, sessions)


@pytest.mark.slow
def test_a_few_bytes_are_staged_within_20_ms_beside_slow_acts(
    serving: Callable[..., Engine],
) -> None:
    served = Served(serving(Slow()))
    served.reset("a", weights="follow")
    over = threading.Event()

    def play() -> None:
        while not over.is_set():
            served.act("a")

    robot = threading.Thread(target=play)
    robot.start()
    staged_s = []
    for number in range(1, 10):
        time.sleep(1.3 * ACT_S)  # so that pushes begin at different times of an act
        begun_s = time.perf_counter()
        served.learn.stage(number, gains(number), PushOptions("keep"))
        staged_s.append(time.perf_counter() - begun_s)
        served.learn.commit(number, PushOptions("keep"))
    over.set()
    robot.join(30)
    assert served.act("a") == (9, 9.0)
    assert np.median(staged_s) < 0.02


@pytest.mark.slow
@AGENTS
def test_a_moved_session_goes_on_with_its_version_and_not_where_that_is_missing(
    serving: Callable[..., Engine], agent: type[Gain]
) -> None:
    here, there, without = (
        Served(serving(agent())),
        Served(serving(agent())),
        Served(serving(agent())),
    )
    here.push(1)
    here.reset("a")
    there.push(1)
    for one in (here, there):
        one.push(2)
    info = here.ask("a", Request("export")).info
    assert info is not None
    state = SessionState.from_info(info)
    with pytest.raises(UnknownSession, match="version 1 of the weights"):
        there.engine.moves.adopt("a", state)  # no session uses version 1 there
    for one in (here, there):
        one.push(3)
    here.reset("a")
    info = here.ask("a", Request("export")).info
    assert info is not None
    state = SessionState.from_info(info)
    there.engine.moves.adopt("a", state)
    assert there.act("a") == (3, 3.0)
    with pytest.raises(UnknownSession, match="version 3 of the weights"):
        without.engine.moves.adopt("a", state)


def test_versions_that_nobody_acts_with_are_freed(serving: Callable[..., Engine]) -> None:
    served = Served(serving(Gain()))
    served.reset("a")
    for number in range(1, 4):
        served.push(number)
    assert sorted(served.engine.model.own_weights._alive) == [0, 3]


def test_weights_that_cannot_be_loaded_fail_the_act_and_others_act_again(
    serving: Callable[..., Engine],
) -> None:
    class Fragile(Gain):
        def load_parameters(self, values: Mapping[str, Any]) -> None:
            if values["layer/gain"][0] == 1:
                raise MemoryError
            super().load_parameters(values)

    served = Served(serving(Fragile()))
    served.reset("a")
    served.push(1)
    with pytest.raises(PolicyFailed):
        served.reset("b")
    assert served.act("a") == (0, 0.0)
    served.push(2)
    served.reset("b")
    assert served.act("b") == (2, 2.0)


def test_a_policy_that_names_no_parameters_is_not_trainable(serving: Callable[..., Engine]) -> None:
    class Fixed(Agent):
        def act(self, obs: Obs) -> Act:
            return Act(np.zeros(1))

    served = Served(serving(Fixed()))
    with pytest.raises(NotTrainable, match="Fixed: names no parameters"):
        served.learn.stage(1, {}, PushOptions())
    assert served.learn.describe() == {
        key: {"version": 0, "fingerprint": ""} for key in ("newest", "pinned")
    }
