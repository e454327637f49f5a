"""The part of a replica that takes weights: it coordinates the same part of the other replicas."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import pytest
from in_flight import answered

from vlagents_ray.errors import Overloaded, PolicyUnavailable, UnchangedWeights
from vlagents_ray.interface import Act, Obs, TrainableAgent
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.config.parts import PartArgs
from vlagents_ray.serve.endpoints.docs_page import docs_page
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.replica.part import OtherReplica, PartContext, open_parts
from vlagents_ray.serve.scaling.session_migration import PeerUnreachable
from vlagents_ray.serve.weights import PushOptions, Rest
from vlagents_ray_learn import weights_part
from vlagents_ray_learn.publisher import EngineTarget
from vlagents_ray_learn.weights_endpoint import PART
from vlagents_ray_learn.weights_part import WeightsPart


class Gain(TrainableAgent):
    trainable: ClassVar[str | None] = "tree"

    def initialize(self) -> None:
        self.tree = {"gain": np.zeros(2, np.float32)}

    def act(self, obs: Obs) -> Act:
        return Act(self.tree["gain"].copy())


class Replica:
    """A replica in this process, which others call by `call_part` alone."""

    def __init__(self, name: str, application: list[Replica]) -> None:
        self.name = name
        self.engine = Engine(Gain())
        self.engine.start()
        self.limits: dict[str, float | None] = {}  # of the calls of other replicas, by method
        self.is_reachable = True

        async def siblings() -> Sequence[OtherReplica]:
            return [replica for replica in application if replica is not self]

        context = PartContext(self.engine, name, "node", dict, siblings=siblings)
        self.parts = open_parts(PartArgs(), context)

    async def call_part(self, part: str, method: str, *args: Any, limit_s: float | None) -> Any:
        """As another replica calls it."""
        self.limits[method] = limit_s
        if not self.is_reachable:
            raise PeerUnreachable("no route")
        return await asyncio.wait_for(self.parts.call(part, method, *args), limit_s)

    def call(self, method: Callable[..., Any], *args: Any) -> Any:
        """Call the part as a learner in the cluster does."""
        return asyncio.run(self.parts.call(PART, method.__name__, *args))

    def acted(self) -> tuple[int, float]:
        """The version and the gain with which a new episode acts."""
        reset = answered(self.engine, "s", Request("reset", Obs(), priority="simulation"))
        assert reset.error is None
        act = answered(self.engine, "s", Request("act", Obs())).act
        return act.info["policy"]["version"], float(act.action[0])


def gains(value: float) -> Mapping[str, Any]:
    return {"gain": np.full(2, value, np.float32)}


Start = Callable[[], Replica]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts another replica of one application."""
    application: list[Replica] = []

    def begin() -> Replica:
        application.append(Replica(f"r{len(application)}", application))
        return application[-1]

    yield begin
    for replica in application:
        replica.engine.close()
        replica.parts.close()


def test_all_replicas_act_with_weights_that_any_of_them_was_given(start: Start) -> None:
    first, second = start(), start()
    pushed = first.call(WeightsPart.push, gains(5), PushOptions())
    assert (pushed.version, pushed.replicas) == (1, ("r0", "r1"))
    assert second.call(WeightsPart.push, gains(6), PushOptions()).version == 2
    assert [first.acted(), second.acted()] == [(2, 6.0)] * 2
    assert first.call(WeightsPart.versions) == second.call(WeightsPart.versions) == [2, 2]
    with pytest.raises(UnchangedWeights):
        first.call(WeightsPart.push, gains(6), PushOptions())
    assert second.limits["stage"] > second.limits["commit"] > 0


def test_the_replica_that_coordinates_a_push_exports_its_duration(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    exported: list[tuple[str, float]] = []

    class Series:
        def __init__(self, name: str, **_: Any) -> None:
            self.name = name

        def set_default_tags(self, tags: Mapping[str, str]) -> Series:
            return self

        def observe(self, value: float) -> None:
            exported.append((self.name, value))

    monkeypatch.setattr(weights_part, "Histogram", Series)
    first, _ = start(), start()
    first.call(WeightsPart.push, gains(5), PushOptions())
    with pytest.raises(UnchangedWeights):
        first.call(WeightsPart.push, gains(5), PushOptions())
    [(name, took_ms)] = exported
    assert name == "vlagents_weight_push_ms"
    assert 0 < took_ms < 60_000


def test_no_replica_changes_if_one_cannot_be_reached(start: Start) -> None:
    first, second = start(), start()
    first.call(WeightsPart.push, gains(5), PushOptions())
    second.is_reachable = False
    with pytest.raises(PolicyUnavailable, match="replica r1 cannot be reached"):
        first.call(WeightsPart.push, gains(6), PushOptions())
    assert [first.acted(), second.acted()] == [(1, 5.0)] * 2
    assert first.call(WeightsPart.versions) == [1]


def test_all_replicas_sleep_and_wake_together(start: Start) -> None:
    first, second = start(), start()
    first.call(WeightsPart.rest_all, Rest("sleep", offload=False))
    for replica in (first, second):
        with pytest.raises(Overloaded, match="already asleep"):
            replica.engine.weights.rest(Rest("sleep"))
    second.call(WeightsPart.rest_all, Rest("wake"))
    assert [first.acted(), second.acted()] == [(0, 0.0)] * 2


def test_a_new_replica_takes_the_weights_of_the_others_before_it_is_ready(start: Start) -> None:
    first = start()
    first.call(WeightsPart.push, gains(5), PushOptions())
    late = start()
    assert late.acted() == (0, 0.0)
    asyncio.run(late.parts.before_ready())
    assert late.acted() == (1, 5.0)


def test_a_replica_that_missed_a_commit_takes_the_weights_later(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(weights_part, "_CATCH_UP_S", 0.01)
    first, second = start(), start()
    EngineTarget(first.engine).push(gains(5), PushOptions())

    async def work() -> None:
        working = asyncio.ensure_future(second.parts.run())
        while second.engine.weights.number == 0:
            await asyncio.sleep(0.01)
        working.cancel()
        await asyncio.gather(working, return_exceptions=True)

    asyncio.run(asyncio.wait_for(work(), 30))
    assert second.acted() == (1, 5.0)


def test_a_replica_becomes_ready_if_the_others_weights_cannot_be_taken(
    start: Start, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    first = start()
    first.call(WeightsPart.push, gains(5), PushOptions())
    late = start()
    caplog.set_level(logging.ERROR)

    def fail(*args: Any) -> str:
        raise RuntimeError("the disk is full")

    monkeypatch.setattr(late.engine.model.own_weights, "stage", fail)
    asyncio.run(late.parts.before_ready())
    assert late.acted() == (0, 0.0)
    assert "tried again later" in caplog.text


def test_the_values_of_another_process_are_staged_where_they_are_resolved(start: Start) -> None:
    first, second = start(), start()
    resolved: list[int] = []

    class Reference:
        def __await__(self) -> Any:
            resolved.append(1)
            return asyncio.sleep(0, gains(5)).__await__()

    first.call(WeightsPart.push, [Reference()], PushOptions())
    assert len(resolved) == 2, "each replica reads the values in place"
    assert [first.acted(), second.acted()] == [(1, 5.0)] * 2


def test_the_part_is_on_unless_a_deployment_turns_it_off(start: Start) -> None:
    assert PART in ServerArgs(policy="noop").parts.on()
    assert PART not in ServerArgs(policy="noop", parts={PART: None}).parts.on()
    replica = start()
    assert {getattr(route, "path", "") for route in replica.parts.routes()} >= {
        "/v1/weights",
        "/v1/weights/{step}",
    }
    parts = open_parts(
        PartArgs(**{PART: None}), PartContext(replica.engine, "without", "node", dict)
    )
    assert not any("weights" in getattr(route, "path", "") for route in parts.routes())
    with pytest.raises(
        LookupError, match="part 'weights': expected a method for other replicas, got 'push'"
    ):
        asyncio.run(parts.call(PART, "push", gains(5), PushOptions()))
    parts.close()


def test_the_page_of_a_server_lists_the_part(start: Start) -> None:
    metadata = {
        "policy": "noop",
        "version": "0",
        "protocol": 1,
        "parts": start().parts.describe(),
    }
    page = docs_page(metadata)
    assert "<dt><code>WS /v1/weights</code>, <code>GET /v1/weights</code></dt>" in page
    assert "New weights from a learner" in page
