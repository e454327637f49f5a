"""What the candidate's process counts and records."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from vlagents_ray.errors import NotReset, PolicyFailed, UnknownSession, VLAgentsError
from vlagents_ray.interface import Act, Obs
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.observers.comparison import Comparer, ComparisonLog

LIMIT = 10**6  # bytes


def acted(value: float, version: int = 0) -> Reply:
    act = Act(np.full((2, 3), value, np.float32), info={"policy": {"version": version, "fingerprint": "9f"}})
    return Reply(act=act, step=5, timing={"queue_ms": 1.0, "inference_ms": 2.0})


def act(session: str = "a") -> Request:
    return Request("act", Obs(), session=session)


def test_comparisons_are_counted_and_recorded(tmp_path: Path) -> None:
    comparer = Comparer(ComparisonLog(tmp_path / "new", "app", "replica", LIMIT))
    lost = comparer.add([act("a"), act("b")], [acted(0.1), acted(0.1)], [acted(0.3, 4), acted(0.6)], [0, 2])
    assert lost == []
    compared = comparer.collect()
    assert compared.outcomes == {"compared": 2}
    assert compared.differences["all"].values == pytest.approx([0.2, 0.5])
    assert compared.differences["first"].values == pytest.approx([0.2, 0.5])
    assert compared.joints == pytest.approx([0.7] * 3)
    assert compared.latencies_ms.values == [3.0, 3.0]
    first, second = [json.loads(line) for line in (tmp_path / "new/app-replica.jsonl").read_text().splitlines()]
    assert (first["session"], first["step"], first["dropped"], second["dropped"]) == ("a", 5, 0, 2)
    assert np.array_equal(np.float32(first["live"]["action"]), np.full((2, 3), 0.1, np.float32))
    assert first["candidate"]["policy"] == {"version": 4, "fingerprint": "9f"}
    assert first["difference"]["rows"] == 2
    assert first["difference"]["mean"] == pytest.approx(0.2)
    assert comparer.collect().outcomes == {}


@pytest.mark.parametrize(
    ("error", "lost"), [(PolicyFailed("no"), []), (NotReset("no"), ["a"]), (UnknownSession("no"), ["a"])]
)
def test_a_failed_act_is_counted_and_only_an_unknown_episode_is_lost(
    tmp_path: Path, error: VLAgentsError, lost: list[str]
) -> None:
    comparer = Comparer(ComparisonLog(tmp_path, "app", "replica", LIMIT))
    assert comparer.add([act()], [acted(0.1)], [Reply(error=error)], [0]) == lost
    assert comparer.collect().outcomes == {"failed": 1}
    line = json.loads((tmp_path / "app-replica.jsonl").read_text())
    assert line["candidate"] == {"error": error.code, "detail": "no"}
    assert line["difference"] is None


def test_an_action_that_cannot_be_compared_has_failed() -> None:
    comparer = Comparer()
    comparer.add([act()], [acted(0.1)], [Reply(act=Act(np.zeros(2, np.float32)))], [0])
    assert comparer.collect().outcomes == {"failed": 1}


def test_a_reset_is_recorded_with_the_weights_of_both(tmp_path: Path) -> None:
    comparer = Comparer(ComparisonLog(tmp_path, "app", "replica", LIMIT))
    ours, theirs = ({"checkpoint": "runs/last", "weights": weights} for weights in ("a", "b"))
    request = Request("reset", Obs(), "stack", session="a")
    comparer.add([request], [Reply(info=ours)], [Reply(info={**theirs, "told": 1})], [0])
    line = json.loads((tmp_path / "app-replica.jsonl").read_text())
    assert (line["instruction"], line["live"], line["candidate"]) == ("stack", ours, theirs | {"timing": {}})


def test_an_episode_whose_reset_fails_is_lost() -> None:
    comparer = Comparer()
    request = Request("reset", Obs(), "stack", session="a")
    assert comparer.add([request], [Reply(info={})], [Reply(error=PolicyFailed("no"))], [0]) == ["a"]
    assert comparer.collect().outcomes == {}


def test_a_full_disk_ends_the_recording_and_not_the_comparison(tmp_path: Path) -> None:
    comparer = Comparer(ComparisonLog(tmp_path / "folder", "app", "replica", LIMIT))
    (tmp_path / "folder").rmdir()
    for _ in range(2):
        comparer.add([act()], [acted(0.1)], [acted(0.3)], [0])
    assert comparer.collect().outcomes == {"compared": 2}


def test_the_oldest_comparisons_of_an_application_make_room(tmp_path: Path) -> None:
    """Those of its earlier replicas, too, and nothing else in the folder."""
    others = [tmp_path / name for name in ("notes.jsonl", "app-b-replica.jsonl")]
    for path in (*others, tmp_path / "app-earlier.jsonl"):
        path.write_text("x" * 5000)
    log = ComparisonLog(tmp_path, "app", "replica", 8000)
    for number in range(100):
        log.write([{"number": number, "text": "x" * 200}])
        own = [path for path in tmp_path.iterdir() if path not in others]
        assert sum(path.stat().st_size for path in own) <= 8000 + 300
    kept = [json.loads(line)["number"] for path in own for line in path.read_text().splitlines()]
    assert sorted(kept) == list(range(100 - len(kept), 100))
    assert len(kept) > 20
    assert all(path.stat().st_size == 5000 for path in others)
