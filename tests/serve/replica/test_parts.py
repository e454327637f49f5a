"""Parts of a replica: settings, order of opening and closing, observers, routes, facts, and calls
between replicas.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import pytest
from pydantic import ValidationError
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import BaseRoute, Route

from vlagents_ray import registry
from vlagents_ray.errors import ConfigError, InvalidInput
from vlagents_ray.policies.noop import Noop
from vlagents_ray.protocol.messages import MessageLimits
from vlagents_ray.registry import RegistryEntry
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.config.parts import PartArgs, PartConfig
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.observer import Observer
from vlagents_ray.serve.replica.part import (
    OtherReplica,
    PartContext,
    ReplicaPart,
    ReplicaParts,
    open_parts,
)

HERE = __name__
events: list[str] = []


class CountConfig(PartConfig):
    limit: int = 3


class Counter(ReplicaPart, Observer):
    Config: ClassVar[type[PartConfig]] = CountConfig

    def open(self) -> None:
        events.append(f"open {self.settings.limit}")

    def close(self) -> None:
        events.append(f"close {self.settings.limit}")

    def observer(self) -> Observer:
        return self

    def routes(self) -> list[Route]:
        return [Route("/count", lambda _: PlainTextResponse("0"))]

    def describe(self) -> dict[str, Any]:
        return {"limit": self.settings.limit}


class Plain(ReplicaPart):
    """A part that has only a name, and whose facts fail."""

    def describe(self) -> dict[str, Any]:
        raise RuntimeError("no facts")


class Failing(ReplicaPart):
    def open(self) -> None:
        raise ConfigError("failing: no folder")


class Totals(ReplicaPart):
    """A part that adds up a number of each replica."""

    sibling_methods: ClassVar[dict[str, float | None]] = {
        "in_thread": 5.0,
        "on_loop": None,
        "fail": 5.0,
    }

    def open(self) -> None:
        self.number = len(self.context.replica)

    def in_thread(self, more: int) -> tuple[int, bool]:
        return self.number + more, threading.current_thread() is threading.main_thread()

    async def on_loop(self, more: int) -> tuple[int, bool]:
        return self.number + more, threading.current_thread() is threading.main_thread()

    def fail(self) -> None:
        raise InvalidInput("no total")

    def secret(self) -> int:
        return self.number


class Neighbour:
    """Another replica in this process."""

    def __init__(self, name: str, parts: ReplicaParts) -> None:
        self.name = name
        self._parts = parts

    async def call_part(self, part: str, method: str, *args: Any, limit_s: float | None) -> Any:
        return await asyncio.wait_for(self._parts.call(part, method, *args), limit_s)


class Periodic(ReplicaPart):
    """A part that prepares for the loaded policy, and then works until it is cancelled or fails."""

    Config: ClassVar[type[PartConfig]] = CountConfig

    async def before_ready(self) -> None:
        if self.settings.limit < 0:
            raise ConfigError("periodic: no weights")
        self.has_prepared = True

    async def run(self) -> None:
        events.append(f"works {self.settings.limit} {self.has_prepared}")
        if self.settings.limit == 0:
            raise RuntimeError("no more work")
        try:
            await asyncio.sleep(600)
        finally:
            events.append("ends")


class EndsAtOnce(Periodic):
    """A part whose periodic work fails."""


class NoPart:
    """A class that is not a part, since it has no settings."""


@pytest.fixture
def context(monkeypatch: pytest.MonkeyPatch) -> PartContext:
    """Return the parts' view of a replica, without plug-ins whose parts are on by default."""
    monkeypatch.setattr(registry, "_entry_points", lambda _: {})
    events.clear()
    return PartContext(Engine(Noop()), "app#replica", "node", dict)


def args(**parts: Any) -> PartArgs:
    return PartArgs(**{f"{HERE}:{name}": settings for name, settings in parts.items()})


def test_a_part_is_opened_observes_answers_and_is_closed(
    context: PartContext, caplog: pytest.LogCaptureFixture
) -> None:
    parts = open_parts(args(Counter={"limit": 5}, Plain={}), context)
    assert events == ["open 5"]
    assert context.engine.observers.any
    assert [route.path for route in parts.routes() if isinstance(route, Route)] == ["/count"]
    assert parts.describe() == {f"{HERE}:Counter": {"limit": 5}}
    assert "no facts" in caplog.text
    parts.close()
    assert events[0] == "open 5"
    assert set(events[1:]) == {"close 5"}
    assert not context.engine.observers.any


def test_parts_that_were_opened_are_closed_if_a_later_one_fails(context: PartContext) -> None:
    with pytest.raises(ConfigError, match="no folder"):
        open_parts(args(Counter={}, Failing={}), context)
    assert events[0] == "open 3"
    assert set(events[1:]) == {"close 3"}
    assert not context.engine.observers.any


def test_a_part_prepares_for_the_loaded_policy_and_works_until_it_is_cancelled(
    context: PartContext, caplog: pytest.LogCaptureFixture
) -> None:
    parts = open_parts(args(EndsAtOnce={"limit": 0}, Periodic={"limit": 5}), context)

    async def run() -> None:
        await parts.before_ready()
        working = asyncio.ensure_future(parts.run())
        await asyncio.wait({working}, timeout=0.1)
        assert not working.done(), "the error of one part ended the work of the other parts"
        working.cancel()
        await asyncio.gather(working, return_exceptions=True)

    asyncio.run(run())
    assert events == ["works 0 True", "works 5 True", "ends"]
    assert f"part '{HERE}:EndsAtOnce': its periodic work has ended" in caplog.text
    assert "no more work" in caplog.text
    parts.close()


def test_a_part_that_cannot_prepare_for_the_policy_keeps_the_replica_from_starting(
    context: PartContext,
) -> None:
    parts = open_parts(args(Periodic={"limit": -1}), context)
    with pytest.raises(ConfigError, match="no weights"):
        asyncio.run(parts.before_ready())
    parts.close()


def test_a_server_without_parts_has_none(context: PartContext) -> None:
    parts = open_parts(ServerArgs(policy="noop").parts, context)
    assert (list(parts.routes()), parts.describe()) == ([], {})
    parts.close()


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({f"{HERE}:Counter": {"limit": "many"}}, "limit"),
        ({f"{HERE}:Counter": {"most": 3}}, "most"),
    ],
)
def test_settings_of_a_part_are_checked_by_its_own_model(
    parts: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValidationError, match=message):
        ServerArgs(policy="noop", parts=parts)


def test_a_class_that_is_no_part_and_an_unknown_name_are_errors() -> None:
    with pytest.raises(
        ValidationError, match=r"expected a subclass of .*ReplicaPart, .*, got .*NoPart without one"
    ):
        ServerArgs(policy="noop", parts={f"{HERE}:NoPart": {}})
    with pytest.raises(ValidationError, match="'latency', which is not registered"):
        ServerArgs(policy="noop", parts={"latency": {}})


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Register one part that is on by default and one that is not, and no others."""
    entries = {
        "counter": RegistryEntry(f"{HERE}:Counter", by_default=True),
        "plain": RegistryEntry(f"{HERE}:Plain"),
    }
    monkeypatch.setitem(registry._BUILT_IN, "replica", entries)
    monkeypatch.setattr(registry, "_entry_points", lambda _: {})


@pytest.mark.parametrize(
    ("parts", "limits"),
    [
        ({}, {"counter": 3}),
        ({"counter": {"limit": 5}}, {"counter": 5}),
        ({"counter": None}, {}),
        ({"plain": {}, "counter": None}, {"plain": None}),
        ({"plain": {}}, {"counter": 3, "plain": None}),
        ({"plain": None}, {"counter": 3}),
    ],
)
def test_a_part_may_be_on_by_default_and_null_turns_it_off(
    registered: None, parts: dict[str, Any], limits: dict[str, Any]
) -> None:
    args = ServerArgs(policy="noop", parts=parts)
    at_the_replica = ServerArgs(**args.model_dump(mode="json"))
    for settings in (args, at_the_replica):
        assert {
            name: getattr(config, "limit", None) for name, config in settings.parts.on().items()
        } == limits


@pytest.fixture
def totals(context: PartContext) -> Totals:
    """Return the part of a replica next to two other replicas, one of which lacks this part."""
    with_part = open_parts(args(Totals={}), replace(context, replica="longer name"))
    without_part = open_parts(args(), context)

    async def siblings() -> Sequence[OtherReplica]:
        return [Neighbour("with", with_part), Neighbour("without", without_part)]

    return Totals(None, replace(context, part=f"{HERE}:Totals", siblings=siblings))


@pytest.mark.parametrize(("method", "on_loop"), [(Totals.in_thread, False), (Totals.on_loop, True)])
def test_a_part_calls_the_same_part_of_other_replicas(
    totals: Totals, method: Any, on_loop: bool
) -> None:
    async def call() -> list[Any]:
        siblings = await totals.siblings()
        assert [sibling.name for sibling in siblings] == ["with", "without"]
        return await asyncio.gather(
            *(sibling.call(method, 5) for sibling in siblings), return_exceptions=True
        )

    answer, missing = asyncio.run(call())
    assert answer == (len("longer name") + 5, on_loop)
    assert isinstance(missing, LookupError)
    assert f"part '{HERE}:Totals'" in str(missing)


def test_an_error_of_the_part_of_another_replica_is_raised_here(totals: Totals) -> None:
    async def call() -> Any:
        return await (await totals.siblings())[0].call(Totals.fail)

    with pytest.raises(InvalidInput, match="no total"):
        asyncio.run(call())


def test_other_replicas_call_only_the_methods_that_a_part_names(context: PartContext) -> None:
    parts = open_parts(args(Totals={}), context)
    for method in ("secret", "close", "open", "__init__", "siblings"):
        with pytest.raises(LookupError, match=f"got '{method}', which the part does not have"):
            asyncio.run(parts.call(f"{HERE}:Totals", method))


class OfEverybody(Counter):
    """A part with one public page, whose path is in its settings."""

    def routes(self) -> list[BaseRoute]:
        return [
            Route("/count", answer),
            Route("/v1/metadata", answer),
            Route("/files/{name}", answer),
        ]


def answer(request: Request) -> Response:
    return PlainTextResponse("here")


@pytest.mark.parametrize(
    ("path", "is_own"),
    [("/count", True), ("/v1/metadata", False), ("/v1/act", False), ("/no", False)],
)
def test_only_a_parts_own_route_is_a_page_without_a_key(
    path: str, is_own: bool, context: PartContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(OfEverybody, "pages", {"page": path})
    parts = open_parts(args(OfEverybody={}), context)
    app = build_http_app(Engine(Noop()), dict, MessageLimits(), more=list(parts.routes()))
    if is_own:
        assert parts.pages(app.routes) == {path}
    else:
        with pytest.raises(
            ConfigError, match=f"expected pages that are routes of this part, got '{path}'"
        ):
            parts.pages(app.routes)
    parts.close()
