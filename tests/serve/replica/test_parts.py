"""Parts of a replica that plug-ins add: settings, order of opening and closing, observers, routes, facts."""

from __future__ import annotations

from typing import Any, ClassVar

import pytest
from pydantic import ValidationError
from starlette.responses import PlainTextResponse
from starlette.routing import Route

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.noop import Noop
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.config.parts import PartArgs, PartConfig
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.observer import Observer
from vlagents_ray.serve.replica.part import PartContext, ReplicaPart, open_parts

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
    """Has nothing but its name, and facts that fail."""

    def describe(self) -> dict[str, Any]:
        raise RuntimeError("no facts")


class Failing(ReplicaPart):
    def open(self) -> None:
        raise ConfigError("failing: no folder")


class NoPart:
    """Has no settings."""


@pytest.fixture
def context() -> PartContext:
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
def test_settings_of_a_part_are_checked_by_its_own_model(parts: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        ServerArgs(policy="noop", parts=parts)


def test_a_class_that_is_no_part_and_an_unknown_name_are_errors() -> None:
    with pytest.raises(ValidationError, match=r"NoPart has no Config; want a subclass of .*ReplicaPart"):
        ServerArgs(policy="noop", parts={f"{HERE}:NoPart": {}})
    with pytest.raises(ValidationError, match="'latency' is not registered"):
        ServerArgs(policy="noop", parts={"latency": {}})
