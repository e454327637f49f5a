"""The benchmark of success runs each kind of transport and setting, and confirms that equal results
are equal.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer

from benchmarks import success

pytest.importorskip("torch")
pytestmark = pytest.mark.torch

CHECKPOINT = Path(__file__).parents[2] / "examples/reference/checkpoint"


def played(folder: Path, *names: str, episodes: int = 2) -> dict[str, dict[str, object]]:
    file = folder / "figures.json"
    success.main(CHECKPOINT, folder / "runs", episodes, ";".join(names), file)
    rows = json.loads(file.read_text())["ways"]
    assert [row["way"] for row in rows] == [success.STANDARD, *names]
    return {row["way"]: row for row in rows}


def test_ways_in_this_process(tmp_path: Path) -> None:
    rows = played(tmp_path, "again", "bfloat16", "ensemble", "LoRA merged")
    assert rows["again"]["equal"] == 2
    assert rows["bfloat16"]["equal"] == rows["LoRA merged"]["equal"] == 0
    again = played(tmp_path, "again")["again"]
    assert again == rows["again"]  # nothing was run again


@pytest.mark.integration
@pytest.mark.ray
def test_ways_through_a_server(tmp_path: Path) -> None:
    names = [
        "batches of 16",
        "shm",
        "JPEG, quality 30",
        "after a push",
        "upstream, openpi",
        "upstream, gr00t",
    ]
    rows = played(tmp_path, *names)
    assert rows["shm"]["equal"] == rows["after a push"]["equal"] == 2
    assert rows["JPEG, quality 30"]["equal"] == 0
    assert rows["upstream, openpi"]["episodes"] == rows["upstream, gr00t"]["episodes"] == 2


def test_actions_that_differ_where_they_must_not_are_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = success.Way("again", {"steps": 2}, equal=True)
    monkeypatch.setattr(success, "ways", lambda: [success.Way(success.STANDARD), other])
    with pytest.raises(typer.Exit):
        played(tmp_path, "again", episodes=1)


def test_the_difference_is_that_of_paired_episodes() -> None:
    def of(name: str, *solved: bool) -> success.Played:
        return success.Played(
            success.Way(name), {seed: (one, f"{name}{one}") for seed, one in enumerate(solved)}, 1.0
        )

    standard = of("a", *[True] * 8, False, False)
    same, again, worse = success.compared([standard, standard, of("b", *[False] * 8, False, True)])
    assert (same["difference"], same["p_holm"], same["equal"]) == (0.0, 1.0, 10)
    assert again == same
    assert (worse["solved"], worse["only_a"], worse["only_b"], worse["equal"]) == (1, 1, 8, 0)
    # (1 + 9) / 2^9, for both sides, and for two comparisons.
    assert worse["p_holm"] == pytest.approx(2 * 20 / 512)
