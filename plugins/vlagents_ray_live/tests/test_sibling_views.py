"""Tests of the data of other replicas: their snapshots, and commands to their sessions."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any

import pytest

from vlagents_ray.errors import InvalidInput
from vlagents_ray.serve.replica.part import SiblingPart
from vlagents_ray.serve.scaling.session_migration import PeerEnded, PeerUnreachable
from vlagents_ray_live.sibling_views import METHODS, SiblingViews


class Answering:
    """Another replica, whose live part gives an answer that the test chooses."""

    def __init__(self, name: str, answer: Any) -> None:
        self.name = name
        self.calls: list[tuple[Any, ...]] = []
        self._answer = answer

    async def call_part(self, part: str, method: str, *args: Any, limit_s: float | None) -> Any:
        self.calls.append((part, method, *args, limit_s))
        if isinstance(self._answer, Exception):
            raise self._answer
        return self._answer


def views_of(*replicas: Answering) -> SiblingViews:
    async def siblings() -> Sequence[SiblingPart]:
        return [SiblingPart(replica, "live", METHODS) for replica in replicas]

    return SiblingViews(siblings)


@pytest.mark.parametrize(
    ("answers", "pressed"),
    [
        ([PeerEnded("gone"), None, {"do": "stop"}], {"do": "stop"}),
        ([PeerUnreachable("it has no live part"), None], None),
        ([], None),
    ],
)
def test_a_command_reaches_the_replica_that_has_the_session(
    answers: list[Any], pressed: dict[str, str] | None
) -> None:
    replicas = [Answering(str(number), answer) for number, answer in enumerate(answers)]
    assert asyncio.run(views_of(*replicas).press("arm", "stop", "lab")) == pressed
    for replica in replicas:
        assert replica.calls == [("live", "press", "arm", "stop", "lab", None, METHODS["press"])]


def test_the_refusal_of_a_command_is_raised() -> None:
    refusing = Answering("refuses", InvalidInput("no such command"))
    with pytest.raises(InvalidInput, match="no such command"):
        asyncio.run(views_of(refusing).press("arm", "start", "lab"))


def test_views_are_read_by_the_name_of_the_replica() -> None:
    replica = Answering("a", "a snapshot")

    async def read() -> list[Any]:
        views = await views_of(replica).views()
        return [(name, await view(7, ["arm"])) for name, view in views.items()]

    assert asyncio.run(read()) == [("a", "a snapshot")]
    assert replica.calls == [("live", "read", 7, ["arm"], METHODS["read"])]
