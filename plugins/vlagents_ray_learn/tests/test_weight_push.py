"""New weights for several replicas: all of them, or none; and replicas that die or start
meanwhile.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import numpy as np
import pytest
from in_flight import answered

from vlagents_ray.errors import (
    InvalidInput,
    InvalidWeights,
    Overloaded,
    PolicyUnavailable,
    UnchangedWeights,
)
from vlagents_ray.interface import Act, Agent, Obs, TrainableAgent
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.scaling.session_migration import PeerEnded, PeerUnreachable
from vlagents_ray.serve.weights import HeldVersion, NewestVersion, PushMode, PushOptions, Rest
from vlagents_ray_learn.weight_push import (
    PushResult,
    ThisReplica,
    Values,
    WeightPusher,
    WeightsReplica,
)


class Gain(TrainableAgent):
    """Acts with its one parameter, whose length may differ between replicas."""

    trainable: ClassVar[str | None] = "tree"

    def __init__(self, length: int = 2) -> None:
        self.length = length

    def initialize(self) -> None:
        self.tree = {"gain": np.zeros(self.length, np.float32)}

    def act(self, obs: Obs) -> Act:
        return Act(self.tree["gain"].copy())


class Replica(ThisReplica):
    """A replica in this process, of which the calls of other replicas fail on demand."""

    def __init__(self, name: str, agent: Agent) -> None:
        self.engine = Engine(agent)
        self.engine.start()
        super().__init__(name, self.engine.weights)
        self.fails: dict[str, Exception] = {}
        self.calls: list[str] = []

    def seen_by_others(self) -> WeightsReplica:
        """The replica as others call it."""
        return _ReplicaFromAfar(self)

    def gain(self, session: str = "s", *, reset: bool = True) -> tuple[int, float]:
        """The version and the gain with which a simulation acts."""
        if reset:
            assert (
                answered(self.engine, session, Request("reset", Obs(), priority="simulation")).error
                is None
            )
        act = answered(self.engine, session, Request("act", Obs())).act
        return act.info["policy"]["version"], float(act.action[0])


class _ReplicaFromAfar(WeightsReplica):
    """Notes each call of a replica, and fails those that the replica names."""

    def __init__(self, replica: Replica) -> None:
        self._replica = replica
        self.name = replica.name

    def _note(self, method: str) -> None:
        self._replica.calls.append(method)
        if method in self._replica.fails:
            raise self._replica.fails[method]

    async def newest(self) -> NewestVersion:
        self._note("newest")
        return await self._replica.newest()

    async def stage(self, number: int, values: Values, options: PushOptions) -> str:
        self._note("stage")
        return await self._replica.stage(number, values, options)

    async def commit(self, number: int, options: PushOptions) -> None:
        self._note("commit")
        await self._replica.commit(number, options)

    async def drop(self, number: int) -> None:
        self._note("drop")
        await self._replica.drop(number)

    async def pushed_versions(self) -> list[HeldVersion]:
        self._note("pushed_versions")
        return await self._replica.pushed_versions()

    async def rest(self, rest: Rest) -> None:
        self._note("rest")
        await self._replica.rest(rest)


class Application:
    """Replicas that know each other."""

    def __init__(self) -> None:
        self.replicas: list[Replica] = []

    def start(self, *agents: Agent) -> list[Replica]:
        """More replicas."""
        begun = [Replica(f"r{len(self.replicas) + i}", agent) for i, agent in enumerate(agents)]
        self.replicas += begun
        return begun

    def pusher(self, own: Replica) -> WeightPusher:
        """Pushes as that replica does."""

        async def others() -> list[WeightsReplica]:
            return [replica.seen_by_others() for replica in self.replicas if replica is not own]

        return WeightPusher(own, others)

    def push(self, gain: float, options: PushOptions = PushOptions(), at: int = 0) -> PushResult:  # noqa: B008 - frozen
        """Push by way of the replica at that index."""
        return asyncio.run(self.pusher(self.replicas[at]).push(_gains(gain), options))

    def catch_up(self, own: Replica) -> int:
        """As that replica does; its newest version then."""
        asyncio.run(self.pusher(own).catch_up())
        return own.engine.weights.number

    def gains(self) -> list[tuple[int, float]]:
        """What each replica acts with."""
        return [replica.gain() for replica in self.replicas]


def _gains(gain: float) -> Mapping[str, Any]:
    return {"gain": np.full(2, gain, np.float32)}


@pytest.fixture
def app() -> Iterator[Application]:
    found = Application()
    yield found
    for replica in found.replicas:
        replica.engine.close()


def test_what_changes_nothing_is_refused(app: Application) -> None:
    app.start(Gain(), Gain())
    app.push(5)
    with pytest.raises(UnchangedWeights):
        app.push(5)
    assert app.push(5, PushOptions(allow_same=True)).version == 2


def test_all_replicas_act_with_a_push_by_way_of_any(app: Application) -> None:
    app.start(Gain(), Gain(), Gain())
    first = app.push(5)
    assert (first.version, first.replicas) == (1, ("r0", "r1", "r2"))
    assert app.gains() == [(1, 5.0)] * 3
    assert app.push(6, at=2).version == 2
    assert app.gains() == [(2, 6.0)] * 3


def test_if_one_replica_refuses_none_acts_with_it(app: Application) -> None:
    app.start(Gain(), Gain(length=3), Gain())
    with pytest.raises(InvalidWeights, match=r"'gain': expected shape \(3,\), got \(2,\)"):
        app.push(5)
    assert app.gains() == [(0, 0.0)] * 3
    app.replicas.pop(1).engine.close()
    assert app.push(5).replicas == ("r0", "r2")  # nothing is left of the rejected push


def test_a_learner_numbers_versions_as_it_likes_if_they_rise(app: Application) -> None:
    app.start(Gain(), Gain())
    assert app.push(5, PushOptions(version=500)).version == 500
    with pytest.raises(
        InvalidInput, match="version: expected one above 500, the newest that acts, got 500"
    ):
        app.push(6, PushOptions(version=500))
    assert app.push(6).version == 501
    assert app.gains() == [(501, 6.0)] * 2
    with pytest.raises(
        InvalidInput,
        match=r"version: expected a number in \[1, 9007199254740991\], got 9007199254740992",
    ):
        PushOptions(version=2**53)
    # Or no later number is above it.
    with pytest.raises(InvalidInput, match="expected at most 1000000000 above 501"):
        app.push(7, PushOptions(version=2**53 - 1))
    assert app.push(7, PushOptions(version=502)).version == 502


def test_if_one_replica_cannot_be_reached_none_acts_with_it(app: Application) -> None:
    _, far = app.start(Gain(), Gain())
    far.fails["stage"] = PeerUnreachable("no route")
    with pytest.raises(
        PolicyUnavailable, match="replica r1 cannot be reached, so that nothing was changed"
    ):
        app.push(5)
    far.fails.clear()
    assert app.gains() == [(0, 0.0)] * 2
    app.push(5)


def test_if_one_replica_cannot_sleep_none_does_and_all_wake_together(app: Application) -> None:
    app.start(Gain(), Gain(), Gain())
    pusher = app.pusher(app.replicas[0])
    app.replicas[1].fails["rest"] = PeerUnreachable("away")
    with pytest.raises(PolicyUnavailable, match="replica r1 cannot be reached"):
        asyncio.run(pusher.rest(Rest("sleep")))
    assert app.gains() == [(0, 0.0)] * len(app.replicas)
    app.replicas[1].fails.clear()
    asyncio.run(pusher.rest(Rest("sleep")))
    for replica in app.replicas:
        with pytest.raises(Overloaded, match="already asleep"):
            replica.engine.weights.rest(Rest("sleep"))
    asyncio.run(pusher.rest(Rest("wake")))
    assert app.gains() == [(0, 0.0)] * len(app.replicas)


@pytest.mark.parametrize("phase", ["newest", "stage", "commit"])
def test_a_replica_that_ends_does_not_hold_up_the_others(app: Application, phase: str) -> None:
    _, ending, _ = app.start(Gain(), Gain(), Gain())
    ending.fails[phase] = PeerEnded("killed")
    assert app.push(5).replicas == ("r0", "r2")
    assert [app.replicas[0].gain(), app.replicas[2].gain()] == [(1, 5.0)] * 2


def test_a_push_beside_another_is_refused_and_leaves_that_one_alone(app: Application) -> None:
    app.start(Gain(), Gain())
    app.replicas[1].engine.weights.stage(1, _gains(7), PushOptions())  # by another coordinator
    with pytest.raises(Overloaded, match="another push is in progress"):
        app.push(5)
    app.replicas[1].engine.weights.commit(1, PushOptions())
    assert app.gains() == [(0, 0.0), (1, 7.0)]


def test_a_replica_that_starts_later_takes_the_newest_and_the_pinned_version(
    app: Application,
) -> None:
    app.start(Gain())
    app.push(5, PushOptions(pin=True))
    app.push(6)
    app.push(7)
    [late] = app.start(Gain())
    assert app.catch_up(late) == 3
    assert late.engine.weights.describe() == app.replicas[0].engine.weights.describe()
    assert late.gain() == (3, 7.0)
    assert app.catch_up(late) == 3  # nothing to do
    assert app.push(8, at=1).version == 4


def test_a_replica_that_loads_does_not_hold_up_the_others_and_one_that_is_lost_does(
    app: Application,
) -> None:
    _, other = app.start(Gain(), Gain())
    pusher = app.pusher(app.replicas[0])
    for error in (PeerUnreachable("no answer"), PolicyUnavailable("the policy is loading")):
        other.fails["newest"] = error
        pushed = asyncio.run(pusher.push(_gains(len(str(error))), PushOptions()))
        assert pushed.replicas == ("r0",)
    other.fails.clear()
    assert app.catch_up(other) == 2
    asyncio.run(pusher.push(_gains(5), PushOptions()))
    other.fails["newest"] = PeerUnreachable("no answer")
    with pytest.raises(PolicyUnavailable, match="replica r1 cannot be reached"):
        asyncio.run(pusher.push(_gains(6), PushOptions()))
    assert app.gains() == [(3, 5.0)] * 2


def test_a_replica_that_missed_a_commit_catches_up(app: Application) -> None:
    _, far = app.start(Gain(), Gain())
    far.fails["commit"] = PeerUnreachable("no route")
    result = app.push(5)
    assert result.replicas == ("r0",)
    assert far.calls.count("commit") > 1
    assert far.gain() == (0, 0.0)
    far.engine.weights.drop(1)  # as after a minute
    assert app.catch_up(far) == 1
    assert far.gain() == (1, 5.0)


@pytest.mark.parametrize("mode", ["keep", "next_episode"])
def test_sessions_of_a_replica_that_catches_up_change_as_the_push_said(
    app: Application, mode: PushMode
) -> None:
    _, far = app.start(Gain(), Gain())
    assert far.gain() == (0, 0.0)
    far.fails["commit"] = PeerUnreachable("no route")
    app.push(5, PushOptions(mode))
    far.engine.weights.drop(1)  # as after a minute
    app.catch_up(far)
    assert far.gain(reset=False) == ((1, 5.0) if mode == "keep" else (0, 0.0))
    assert far.gain() == (1, 5.0)


def test_a_replica_without_others_to_ask_stays_as_it_is(app: Application) -> None:
    mute, alone = app.start(Gain(), Gain())
    mute.fails["newest"] = PeerUnreachable("no route")
    assert app.catch_up(alone) == 0


def test_weights_of_another_checkpoint_are_neither_taken_nor_mixed(app: Application) -> None:
    app.start(Gain())
    app.push(5)
    [other] = app.start(Gain())
    other.engine.model.own_weights.model = ("its settings", "its digest")
    assert app.catch_up(other) == 0
    with pytest.raises(PolicyUnavailable, match="changing their checkpoint"):
        app.push(6)
    assert app.gains() == [(1, 5.0), (0, 0.0)]


def test_values_may_be_a_reference_that_each_replica_resolves(app: Application) -> None:
    app.start(Gain(), Gain())

    class Reference:
        def __await__(self) -> Any:
            return asyncio.sleep(0, _gains(5)).__await__()

    asyncio.run(app.pusher(app.replicas[0]).push([Reference()], PushOptions()))
    assert app.gains() == [(1, 5.0)] * 2
