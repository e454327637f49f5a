"""The comparison of learners at a small size, with its table and its picture."""

from __future__ import annotations

import copy
import json
import math
from pathlib import Path
from typing import Any

import pytest
import typer

from benchmarks import learners
from benchmarks.learners_page import learner_rows, mean_interval, points_of, table_rows
from benchmarks.picture import plot_learners
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.results.statistics import Pairs


def train(folder: Path, names: str) -> dict[str, Any]:
    """Run the command at a small size, and return its figures."""
    file = folder / "figures.json"
    learners.main(
        folder / "runs",
        names,
        seeds="0",
        recorded=6,
        steps=2,
        iterations=1,
        rollouts=8,
        held_out=2,
        metaworld=0,
        results=file,
    )
    figures: dict[str, Any] = json.loads(file.read_text())
    return figures


@pytest.mark.torch
@pytest.mark.slow
@pytest.mark.integration
def test_each_learner_trains_and_is_evaluated_on_the_same_episodes(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    figures = train(tmp_path, ",".join(learners.LEARNERS))
    assert [run["learner"] for run in figures["runs"]] == list(learners.LEARNERS)
    for run in figures["runs"]:
        assert run["cpu_s"] > 0
        assert run["tabletop"]["pairs"] == 2
        assert "metaworld" not in run
    dagger, cloning, _, grpo, _ = figures["runs"]
    assert dagger["episodes"]["rollouts"] == 6 >= dagger["episodes"]["interventions"] > 0
    assert cloning["episodes"] == {"demonstrations": 6}
    assert grpo["episodes"] == {"rollouts": 8}


@pytest.mark.torch
@pytest.mark.slow
def test_a_series_that_was_interrupted_continues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("torch")
    executed: list[str] = []
    execute = learners._execute

    def interrupted(step: learners.Step, log: Path) -> dict[str, float]:
        if step.name == "train" and not executed.count("train"):
            executed.append(step.name)
            raise KeyboardInterrupt
        executed.append(step.name)
        return execute(step, log)

    monkeypatch.setattr(learners, "_execute", interrupted)
    with pytest.raises(typer.Exit):
        train(tmp_path, "cloning")
    figures = train(tmp_path, "cloning")
    assert executed == ["record", "train", "train"]
    assert train(tmp_path, "cloning") == figures
    assert executed == ["record", "train", "train"], "finished learners must not be trained again"


@pytest.mark.parametrize("text", ["", "one", "-1", ",".join(map(str, range(11)))])
def test_seeds_that_are_no_seeds_are_rejected(text: str) -> None:
    with pytest.raises(ConfigError, match="--seeds: expected 1 to 10 numbers from 0 on"):
        learners.parse_seeds(text)


def test_episodes_are_paired_by_environment_and_seed() -> None:
    before = {("a", 0): True, ("a", 1): False, ("b", 0): False, ("b", 1): True}
    after = {("a", 0): True, ("a", 1): True, ("b", 0): False, ("b", 1): False}
    assert learners.pairs_of(after, before) == Pairs(both=1, only_a=1, only_b=1, neither=1)
    assert learners.rates_of(after) == {"a": [2, 2], "b": [0, 2]}


def run_of(learner: str, seed: int, solved: int, **more: Any) -> dict[str, Any]:
    return {
        "learner": learner,
        "seed": seed,
        "steps": 600 if learner == "dagger" else None,
        "episodes": {"rollouts": 800, "interventions": 600 + seed},
        "cpu_s": 300.0,
        "tabletop": {"rates": {"tabletop": [solved, 500]}, "p_value": 10.0 ** -(seed + 1)},
        **more,
    }


FIGURES: dict[str, Any] = {
    "before": {"tabletop": {"tabletop": [462, 500]}, "metaworld": {"a": [25, 25], "b": [24, 25]}},
    "runs": [
        run_of("dagger", 0, 490, metaworld={"rates": {"a": [5, 25], "b": [0, 25]}}),
        run_of("dagger", 1, 494),
        run_of("grpo", 0, 480, cpu_s=None),
    ],
}


def test_the_table_has_means_intervals_and_the_largest_p() -> None:
    head, _, before, dagger, grpo = table_rows(FIGURES)
    assert head.startswith("| learner | runs |")
    assert "| 92.4 |" in before
    assert "98.0 [89.5, 99.6] of 50" in before
    assert (
        "| DAgger, 600 steps | 2 | 800 rollouts, 600 interventions | 5.0 | 98.0, 98.8 |" in dagger
    )
    # The half width is 12.706 times the standard error of 5.6 and 6.4.
    assert "| +6.0 [0.9, 11.1] | ≤ 0.1 | 10.0 [4.3, 21.4] of 50 |" in dagger
    assert "| GRPO | 1 | 800 rollouts, 600 interventions |  | 96.0 | +3.6 | 0.1 |  |" in grpo
    assert len(list(table_rows(FIGURES, ["grpo"]))) == 4


def test_a_learner_without_all_tests_has_no_largest_p() -> None:
    figures = copy.deepcopy(FIGURES)
    del figures["runs"][0]["tabletop"]["p_value"]
    dagger, grpo = learner_rows(figures)
    assert (dagger.largest_p, grpo.largest_p) == (None, 0.1)


def test_runs_of_different_lengths_are_different_rows() -> None:
    figures = copy.deepcopy(FIGURES)
    figures["runs"][1]["steps"] = 200
    assert [(row.steps, row.seeds) for row in learner_rows(figures)] == [
        (200, (1,)),
        (600, (0,)),
        (None, (0,)),
    ]


def test_a_single_run_has_the_interval_of_its_pairs() -> None:
    counts = {"both": 459, "only_a": 37, "only_b": 3, "neither": 1, "p_value": 1.9e-8}
    run = run_of("dagger", 0, 496, tabletop={"rates": {"tabletop": [496, 500]}, **counts})
    [row] = list(table_rows({**FIGURES, "runs": [run]}))[3:]
    assert "| +6.8 [4.4, 9.2] | 1.9e-08 |" in row


def test_one_run_without_pairs_has_no_interval() -> None:
    mean, low, high = mean_interval([0.5])
    assert mean == 0.5
    assert math.isnan(low)
    assert math.isnan(high)


def test_the_picture_names_each_learner_beside_its_runs(tmp_path: Path) -> None:
    picture = tmp_path / "learners.svg"
    plot_learners(points_of(FIGURES), 0.924, picture)
    text = picture.read_text()
    assert text.count("DAgger") == text.count("GRPO") == 1

    figures = copy.deepcopy(FIGURES)
    figures["runs"][2]["cpu_s"] = 600.0
    plot_learners(points_of(figures), 0.924, picture)
    text = picture.read_text()
    assert "10 min CPU time" in text
