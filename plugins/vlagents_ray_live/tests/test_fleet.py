"""Tests of the snapshots of several replicas, gathered for several viewers."""

from __future__ import annotations

import asyncio
from collections.abc import Collection
from functools import partial
from typing import Any

import pytest
from in_flight import opened
from live_server import METADATA

from vlagents_ray.errors import UnknownSession
from vlagents_ray.policies.noop import Noop
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.in_time import RobotReport, RobotTimes
from vlagents_ray_live import live_view
from vlagents_ray_live.live_view import (
    PICTURES,
    Fleet,
    ReplicaView,
    Snapshot,
    SnapshotReader,
    Viewer,
)


class Others:
    """Other replicas, each with one session with one picture."""

    def __init__(self, *names: str) -> None:
        self.names = list(names)
        self.asked: list[tuple[str, int, Collection[str]]] = []
        self.failing: set[str] = set()

    async def views(self) -> dict[str, SnapshotReader]:
        return {name: partial(self._read, name) for name in self.names}

    async def press(
        self, session: str, do: str, by: str, episode: str | None
    ) -> dict[str, Any] | None:
        return {"do": do, "by": by} if session == "of b" else None

    async def _read(self, name: str, since: int, shown: Collection[str]) -> Snapshot:
        self.asked.append((name, since, shown))
        if name in self.failing:
            raise TimeoutError
        session = {"id": f"of {name}", "pictures": {"front": 0}}
        return Snapshot(since + 5, {"name": name, "sessions": [session]}, [name.encode()])


@pytest.fixture
def own() -> ReplicaView:
    engine = Engine(Noop.from_config({}))
    return ReplicaView(engine, "own", "here", lambda: METADATA)


def test_pictures_go_to_those_who_show_them(own: ReplicaView) -> None:
    others = Others("b", "c")

    async def watch() -> list[tuple[dict[str, Any], list[bytes]]]:
        gathered = Fleet(own, others)
        with gathered.viewer() as one, gathered.viewer() as two:
            one.shown, two.shown = frozenset({"of c"}), frozenset({"of b", "of c"})
            return [await one.next(), await two.next()]

    (first, its_files), (second, their_files) = asyncio.run(watch())
    assert [one["name"] for one in first["replicas"]] == ["b", "c", "own"]
    assert [one["sessions"][0]["pictures"] for one in first["replicas"][:2]] == [{}, {"front": 0}]
    assert its_files == [b"c"]
    assert [one["sessions"][0]["pictures"] for one in second["replicas"][:2]] == [
        {"front": 0},
        {"front": 1},
    ]
    assert their_files == [b"b", b"c"]
    assert others.asked[0][2] == {"of b", "of c"}


def test_a_command_reaches_the_replica_that_has_the_session(own: ReplicaView) -> None:
    gathered = Fleet(own, Others("b"))
    assert asyncio.run(gathered.press("of b", "stop", "lab")) == {"do": "stop", "by": "lab"}
    with pytest.raises(UnknownSession):
        asyncio.run(gathered.press("of c", "stop", "lab"))
    with pytest.raises(UnknownSession):
        asyncio.run(Fleet(own).press("of b", "stop", "lab"))


def test_a_replica_that_does_not_answer_is_left_out_and_asked_again_from_where_it_was(
    own: ReplicaView,
) -> None:
    others = Others("b")

    async def watch() -> None:
        gathered = Fleet(own, others)
        with gathered.viewer() as viewer:
            for failing, names in (((), {"b", "own"}), ({"b"}, {"own"}), ((), {"b", "own"})):
                others.failing = set(failing)
                while {one["name"] for one in (await viewer.next())[0]["replicas"]} != names:
                    pass

    asyncio.run(asyncio.wait_for(watch(), 30))
    since = [number for _, number, _ in others.asked]
    assert since == sorted(since)
    assert since[-1] > since[0] == 0


def test_nothing_is_gathered_without_viewers(own: ReplicaView) -> None:
    others = Others("b")

    async def watch() -> int:
        gathered = Fleet(own, others)
        with gathered.viewer() as viewer:
            await viewer.next()
        asked = len(others.asked)
        await asyncio.sleep(0.3)
        assert len(others.asked) == asked
        return asked

    assert asyncio.run(watch()) == 1


def test_an_error_of_a_reading_does_not_end_the_next(
    own: ReplicaView, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, failures = own.read, iter([True, False, False])

    def sometimes(since: int, shown: Collection[str]) -> Snapshot:
        if next(failures):
            raise RuntimeError("a defect")
        return read(since, shown)

    monkeypatch.setattr(own, "read", sometimes)

    async def watch() -> dict[str, Any]:
        gathered = Fleet(own)
        with gathered.viewer() as viewer:
            document, _ = await viewer.next()
        return document

    assert asyncio.run(watch())["replicas"][0]["name"] == "own"


def test_what_is_beside_the_replicas_is_sent_when_it_has_changed() -> None:
    said: list[dict[str, Any]] = [{"evaluation": {"done": 1}}]

    async def watch() -> list[dict[str, Any]]:
        gathered = Fleet(None, extra=lambda: said[-1])
        with gathered.viewer() as viewer:
            found = [(await viewer.next())[0] for _ in range(2)]
            said.append({"evaluation": {"done": 2}})
            while "evaluation" not in (last := (await viewer.next())[0]):
                pass
        return [*found, last]

    first, second, last = asyncio.run(watch())
    assert (first["evaluation"], last["evaluation"]) == ({"done": 1}, {"done": 2})
    assert "evaluation" not in second
    assert first["replicas"] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("behind", "size", "sent"), [(2, 1, 4), (None, PICTURES, 100)], ids=["messages", "bytes"]
)
def test_a_slow_viewer_misses_the_oldest(
    monkeypatch: pytest.MonkeyPatch, behind: int | None, size: int, sent: int
) -> None:
    if behind is not None:
        monkeypatch.setattr(live_view, "_BEHIND", behind)

    async def watch() -> tuple[dict[str, Any], list[bytes]]:
        viewer = Viewer()
        viewer.shown = frozenset({"s"})
        for number in range(sent):
            session = {"id": "s", "pictures": {"front": 0}}
            viewer.put(
                [
                    Snapshot(
                        number,
                        {"name": str(number), "sessions": [session]},
                        [bytes([number]) + bytes(size - 1)],
                    )
                ]
            )
        return await viewer.next()

    document, files = asyncio.run(watch())
    names = [one["name"] for one in document["replicas"]]
    assert names == [str(sent - len(names) + i) for i in range(len(names))]
    assert files[-1][0] == sent - 1
    assert sum(map(len, files)) <= 2**26 if behind is None else len(names) == behind


def test_a_snapshot_has_the_share_in_time_of_each_robot(own: ReplicaView) -> None:
    engine = own._engine
    for name, starved, is_tolerated in (
        ("good", 1, True),
        ("late", 10, False),
        ("unmeasured", 1, None),
    ):
        session = opened(engine.sessions, name)
        session.times = RobotTimes()
        session.times.add(RobotReport(100, starved, 80.0, is_tolerated), engine.clock())
    opened(engine.sessions, "silent")

    document = own.read(0, ()).document
    assert {one["id"]: one["in_time"] for one in document["sessions"]} == {
        "good": {"share": 0.99, "age_p95_ms": 80.0, "within_tolerance": 1.0},
        "late": {"share": 0.9, "age_p95_ms": 80.0, "within_tolerance": 0.0},
        "unmeasured": {"share": 0.99, "age_p95_ms": 80.0, "within_tolerance": None},
        "silent": None,
    }
