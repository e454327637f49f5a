"""The handling of answers and errors of other replicas' actors."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest
import ray
from ray import serve
from ray.exceptions import ActorDiedError, ActorUnavailableError, RayTaskError

from vlagents_ray.errors import InvalidWeights, VLAgentsError
from vlagents_ray.serve.scaling import session_migration, sibling_replicas
from vlagents_ray.serve.scaling.rebalancer import ClientLocation, ReplicaLoad
from vlagents_ray.serve.scaling.session_migration import HeldSessions, PeerEnded, PeerUnreachable
from vlagents_ray.serve.scaling.sibling_replicas import (
    PEER_METHODS,
    ReplicasInCluster,
    SiblingReplica,
    SiblingReplicas,
)


def raised(cause: Exception) -> RayTaskError:
    return RayTaskError("peer", "a traceback", cause)


@pytest.mark.parametrize(
    ("error", "becomes"),
    [
        (InvalidWeights("'w': unknown"), InvalidWeights),
        (raised(RuntimeError("no such method")), PeerUnreachable),
        (ActorDiedError(), PeerEnded),
        (ActorUnavailableError("the network is partitioned", None), PeerUnreachable),
        (TimeoutError(), PeerUnreachable),
    ],
    ids=lambda one: getattr(one, "__name__", type(one).__name__),
)
def test_errors_of_another_replica(
    monkeypatch: pytest.MonkeyPatch, error: Exception, becomes: type[Exception]
) -> None:
    async def call(actor: Any, method: Any, *args: Any) -> Any:
        assert (actor, method.__name__, args) == (
            "actor",
            "peer",
            ("HeldSessions.weights", "arm"),
        )
        if isinstance(error, VLAgentsError):
            return error
        raise error

    monkeypatch.setattr(sibling_replicas, "call_replica", call)
    replica = SiblingReplica("r1", "actor", {"r1"})
    with pytest.raises(becomes) as error_info:
        asyncio.run(replica.call(HeldSessions.weights, "arm"))
    assert type(error_info.value) is becomes
    assert str(error_info.value)


def test_a_part_of_another_replica_has_its_own_time_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    cluster = Cluster(monkeypatch, a="counted", late=None)

    async def call(limit_s: float) -> list[Any]:
        others = await SiblingReplicas().others()
        called = [other.call_part("counter", "count", 7, limit_s=limit_s) for other in others]
        return await asyncio.gather(*called, return_exceptions=True)

    answered, late = asyncio.run(call(0.1))
    assert answered == "counted"
    assert isinstance(late, PeerUnreachable)
    assert "no answer within 0.1 s" in str(late)
    assert cluster.asked == [("a", "counter"), ("late", "counter")]


def test_a_replica_that_still_loads_delays_no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """A replica that replaces a killed one is still loading: it answers no calls, and has no
    sessions.
    """
    Cluster(monkeypatch, loading="no answer")

    async def never(actor: str) -> bool:
        await asyncio.sleep(3600)
        return True

    monkeypatch.setattr(sibling_replicas.private, "replica_is_initialized", never)
    assert sibling_replicas._INITIALIZED_S < session_migration._ANSWER_S
    monkeypatch.setattr(session_migration, "_ANSWER_S", 3600.0)
    monkeypatch.setattr(sibling_replicas, "_INITIALIZED_S", 0.01)

    async def search() -> None:
        [loading] = await SiblingReplicas().others()
        with pytest.raises(PeerUnreachable):
            await loading.ask(HeldSessions.versions_of, ["session"])

    asyncio.run(search())


class Cluster:
    """Named actors whose answers a test sets. Actors without an answer never return."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **answers: Any) -> None:
        self.answers = {self.name(replica): answer for replica, answer in answers.items()}
        self.asked: list[tuple[str, str]] = []
        named = [
            {"name": name, "namespace": "serve"}
            for name in [*self.answers, "SERVE_REPLICA::other#Policy#x"]
        ]
        monkeypatch.setattr(ray.util, "list_named_actors", lambda **_: named)
        monkeypatch.setattr(ray, "get_actor", self._actor)
        monkeypatch.setattr(sibling_replicas, "call_replica", self._call)
        monkeypatch.setattr(sibling_replicas, "_SILENT_S", 60.0)
        self.initialized = set(self.answers)
        monkeypatch.setattr(
            sibling_replicas.private, "replica_is_initialized", self._is_initialized
        )
        context = SimpleNamespace(
            app_name="app", replica_id=SimpleNamespace(to_full_id_str=lambda: self.name("me"))
        )
        monkeypatch.setattr(serve, "get_replica_context", lambda: context)

    @staticmethod
    def name(replica: str) -> str:
        return f"SERVE_REPLICA::app#Policy#{replica}"

    def _actor(self, name: str, namespace: str) -> str:
        if name not in self.answers:
            raise ValueError("no such actor")
        return name

    async def _is_initialized(self, actor: str) -> bool:
        return actor in self.initialized

    async def _call(self, actor: str, method: Any, *args: Any) -> Any:
        self.asked.append((actor.rpartition("#")[2], args[0] if args else method.__name__))
        answer = self.answers[actor]
        if answer is None:
            await asyncio.sleep(3600)
        if isinstance(answer, Exception):
            raise answer
        return answer


def load(replica: str) -> ReplicaLoad:
    return ReplicaLoad(replica, 3, True, "node", "boot", ("v", "f"))


def test_loads_are_those_of_the_replicas_that_answer_and_the_others_are_left_alone_for_a_while(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cluster = Cluster(monkeypatch, me=load("me"), a=load("a"), late=None, dead=ActorDiedError())
    others = SiblingReplicas()
    for _ in range(2):
        assert [one.replica for one in asyncio.run(others.loads())] == ["a"]
    assert sorted(cluster.asked) == [("a", "Rebalancer.load")] * 2 + [
        ("dead", "Rebalancer.load"),
        ("late", "Rebalancer.load"),
    ]


def test_a_replica_that_starts_is_asked_again_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    cluster = Cluster(monkeypatch, a=load("a"))
    cluster.initialized.clear()
    others = SiblingReplicas()
    assert asyncio.run(others.loads()) == []
    cluster.initialized.add(cluster.name("a"))
    assert [answer.replica for answer in asyncio.run(others.loads())] == ["a"]


def test_a_silent_replica_that_announces_itself_is_asked_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cluster = Cluster(monkeypatch, a=None)
    others = SiblingReplicas()
    assert asyncio.run(others.loads()) == []
    cluster.answers[cluster.name("a")] = load("a")
    assert asyncio.run(others.loads()) == []
    others.forget_silence(cluster.name("a"))
    assert [answer.replica for answer in asyncio.run(others.loads())] == ["a"]


def test_a_replica_announces_itself_to_some_others_once_it_is_initialized(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cluster = Cluster(monkeypatch, me="me", **{f"r{number}": "noted" for number in range(50)})
    cluster.initialized.remove(cluster.name("me"))
    this_actor = SimpleNamespace(current_actor=cluster.name("me"))
    monkeypatch.setattr(ray, "get_runtime_context", lambda: this_actor)

    async def start() -> None:
        announcing = asyncio.ensure_future(SiblingReplicas().announce_this_replica())
        await asyncio.sleep(0.2)
        assert cluster.asked == []
        cluster.initialized.add(cluster.name("me"))
        await announcing

    asyncio.run(start())
    assert {method for _, method in cluster.asked} == {"Rebalancer.replica_joined"}
    assert len({replica for replica, _ in cluster.asked} - {"me"}) == 32


def test_of_many_replicas_those_near_a_client_and_some_others_are_asked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    loads = {
        f"r{number}": ReplicaLoad(f"r{number}", 3, True, f"node{number % 20}", "boot", ("v", "f"))
        for number in range(100)
    }
    cluster = Cluster(monkeypatch, **loads)
    others = SiblingReplicas()
    asyncio.run(others.some_loads())
    assert len(cluster.asked) == 100, "the location of the replicas is not known yet"
    drawn = set()
    for _ in range(30):
        answers = asyncio.run(others.some_loads([ClientLocation("node7")]))
        assert {f"r{number}" for number in range(7, 100, 20)} <= {one.replica for one in answers}
        assert len(answers) == 5 + 32
        drawn |= {one.replica for one in answers}
    assert len(drawn) > 90
    assert len(asyncio.run(others.loads())) == 100


def test_a_replica_is_called_once_it_is_initialized(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before that, Serve would log a traceback for a call. This holds for all methods, and again
    after the replica was replaced.
    """
    cluster = Cluster(monkeypatch, a=load("a"), b=load("b"))
    cluster.initialized = {cluster.name("a")}

    async def answers(method: Any) -> list[str]:
        called = [one.call(method) for one in await replicas.others()]
        results = await asyncio.gather(*called, return_exceptions=True)
        return [
            "unreachable" if isinstance(one, PeerUnreachable) else "answered" for one in results
        ]

    replicas = ReplicasInCluster(["app"])
    methods = [one.call for one in PEER_METHODS.values()]
    for method in methods:
        assert asyncio.run(answers(method)) == ["answered", "unreachable"]
    assert {name for name, _ in cluster.asked} == {"a"}
    cluster.initialized.add(cluster.name("b"))
    for method in methods:
        assert asyncio.run(answers(method)) == ["answered", "answered"]
    assert len(cluster.asked) == 3 * len(methods)


@pytest.mark.parametrize(
    ("replica", "answer"),
    [("a", ({"policy": "noop"}, "actor")), ("late", None), ("dead", None), ("gone", None)],
)
def test_a_client_goes_where_it_was_announced_or_stays(
    monkeypatch: pytest.MonkeyPatch, replica: str, answer: Any
) -> None:
    cluster = Cluster(
        monkeypatch, a=({"policy": "noop"}, "actor"), late=None, dead=ActorDiedError()
    )
    assert asyncio.run(SiblingReplicas().announce_client(cluster.name(replica))) == answer
    assert cluster.asked == ([] if replica == "gone" else [(replica, "expect_client")])
