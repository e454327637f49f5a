from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from eval_fakes import LINE, OTHER_LINE
from recorded_results import record, runs

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import Results
from vlagents_ray.evaluate.report.page import configuration
from vlagents_ray.evaluate.results.combination import combined
from vlagents_ray.evaluate.results.comparison import clock_gaps, comparable, compare, comparisons
from vlagents_ray.evaluate.results.statistics import Pairs, sum_of


def solved_by(**seeds: set[int]) -> Any:
    """Return an outcome function from the seeds that each policy solves."""
    return lambda case, seed: 5 if seed in seeds[case.policy.name] else None


def test_pairs_are_episodes_of_the_same_env_and_seed(tmp_path: Path) -> None:
    config = runs(tmp_path, episodes=5, steps=[])
    found = compare(record(config, solved_by(learner={0, 1, 2}, base={2, 3})), "learner", "base")
    in_each = Pairs(both=1, only_a=2, only_b=1, neither=1)
    assert [line.suite for line in found.suites] == ["one", "two"]
    one, two = (line.outcomes.strata for line in found.suites)
    assert one == (in_each.starts,) * 2
    assert two == (in_each.starts,)
    # Both suites have the environment LINE, whose starts are repeated.
    assert found.total.pairs == in_each + in_each + in_each
    assert (found.total.starts, len(found.total.outcomes.strata)) == (10, 2)
    low, high = found.total.interval
    assert low < found.total.pairs.difference < high  # type: ignore[operator]


def test_what_infrastructure_lost_is_in_no_pair(tmp_path: Path) -> None:
    results = record(
        runs(tmp_path, episodes=5, steps=[]), solved_by(learner=set(), base={0, 1}), troubles=True
    )
    line = compare(results, "learner", "base").suites[0]
    # Seed 1 has only base's episode; the policy's error with seed 0 counts as a failure.
    assert sum_of(line.outcomes.strata[:1]) == Pairs(only_b=1, neither=3)
    assert line.lost == 1
    assert sum_of(line.outcomes.worst[:1]) == Pairs(only_b=2, neither=3)
    assert sum_of(line.outcomes.best[:1]) == Pairs(both=1, only_b=1, neither=3)


def test_p_values_of_more_comparisons_are_larger(tmp_path: Path) -> None:
    results = record(runs(tmp_path, episodes=20))
    pairs, reasons = comparable(results)
    assert pairs == [
        ("base", "learner@1000"),
        ("base", "learner@2000"),
        ("learner@1000", "learner@2000"),
    ]
    assert reasons == []
    together = comparisons(results, pairs)
    alone = [compare(results, a, b) for a, b in pairs]
    assert [one.total.adjusted for one in alone] == [one.total.p_value for one in alone]
    assert all(
        one.total.adjusted >= single.total.adjusted
        for one, single in zip(together, alone, strict=True)
    )
    smallest = min(range(3), key=lambda index: alone[index].total.adjusted)
    assert together[smallest].total.adjusted == pytest.approx(3 * alone[smallest].total.adjusted)


def test_a_comparison_as_json_has_every_line(tmp_path: Path) -> None:
    found = compare(record(runs(tmp_path)), "learner@1000", "base").to_json()
    assert [line["suite"] for line in found["lines"]] == ["one", "two", "all"]
    assert {"pairs", "both", "difference", "interval_95", "p_value", "p_holm"} <= found["lines"][
        0
    ].keys()


def folder(out: Path, name: str, **suite: Any) -> Results:
    """Return the settings of one policy in one environment."""
    settings = {
        "policies": [{"name": name, "url": "http://localhost:1"}],
        "suites": [{"envs": [LINE], "episodes": 4} | suite],
    }
    config = type(runs(out)).model_validate(settings | {"out": out})
    return record(config, lambda _case, seed: 3 if seed % 2 else None, videos=True)


def test_other_settings_of_an_env_are_no_pair(tmp_path: Path) -> None:
    results = combined(
        [folder(tmp_path / "a", "a"), folder(tmp_path / "b", "b", env_options={"state_dim": 1})]
    )
    with pytest.raises(
        ConfigError,
        match=r"expected the same env_options of .*, got {} for 'a' and {'state_dim': 1} for 'b'",
    ):
        compare(results, "a", "b")
    assert comparable(results)[0] == []


def test_no_shared_episode_and_unknown_policies_are_no_comparison(tmp_path: Path) -> None:
    results = combined(
        [folder(tmp_path / "a", "a"), folder(tmp_path / "b", "b", envs=[OTHER_LINE])]
    )
    with pytest.raises(ConfigError, match="share no finished episode"):
        compare(results, "a", "b")
    with pytest.raises(
        ConfigError, match=r"expected two of the policies \['a', 'b'\], got \['best'\]$"
    ):
        compare(results, "best", "b")


def test_a_misspelt_policy_is_answered_with_the_nearest_name(tmp_path: Path) -> None:
    results = combined([folder(tmp_path / "a", "all_rows"), folder(tmp_path / "b", "four_rows")])
    with pytest.raises(ConfigError, match=r"got \['allrows'\]; did you mean 'all_rows'\?"):
        compare(results, "allrows", "four_rows")


def test_folders_are_read_as_one(tmp_path: Path) -> None:
    results = combined([folder(tmp_path / "a", "a"), folder(tmp_path / "b", "b")])
    assert results.policy_ids == ["a", "b"]
    assert compare(results, "a", "b").total.pairs == Pairs(both=2, neither=2)
    videos = [video for case in results.cases for one in case.episodes for video in one.videos]
    assert len(videos) == 4
    assert all((results.out / video).is_file() for video in videos)
    assert [run.run for run in results.runs] == [1, 2]


def test_policies_of_one_name_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    first = folder(tmp_path / "first", "pi0")
    second = folder(tmp_path / "second", "pi0", reset_options={"instruction": "go"})
    assert combined([first, second]).policy_ids == ["pi0 (first)", "pi0 (second)"]


def test_other_weights_under_one_name_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    """This also holds if no task is in both folders, whose rates would otherwise be added up."""

    def played(by: str, env: str, checkpoint: str, weights: str) -> Results:
        results = folder(tmp_path / by, "pi0", envs=[env])
        [case] = results.cases
        said = {"checkpoint": checkpoint, "weights": weights}
        episodes = tuple(replace(one, result=replace(one.result, **said)) for one in case.episodes)
        return results.among([replace(case, episodes=episodes)])

    first = played("first", LINE, "runs/last", "a")
    assert combined([first, played("same", OTHER_LINE, "runs/last", "a")]).policy_ids == ["pi0"]
    another = played("another", OTHER_LINE, "runs/best", "b")
    assert combined([first, another]).policy_ids == ["pi0"]  # the page names both folders
    other = combined([first, played("later", OTHER_LINE, "runs/last", "b")])
    assert other.policy_ids == ["pi0 (first)", "pi0 (later)"]
    assert ("pi0 (later)", "b") in configuration(other).checkpoints


def test_parts_of_one_evaluation_are_to_be_merged(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"merge .* --out OUT`, with --accept-changes if code or weights changed"
    ):
        combined([folder(tmp_path / "a", "pi0"), folder(tmp_path / "b", "pi0")])


def test_the_gap_to_the_synchronous_score_pairs_suites_that_differ_in_their_clock(
    tmp_path: Path,
) -> None:
    suites: list[dict[str, Any]] = [
        {"name": name, "envs": [LINE], "episodes": 4} for name in ("live", "waiting")
    ]
    suites[0]["clock"] = {"latency": 0.1, "mode": "async"}
    config = runs(tmp_path, steps=[], suites=suites)
    gaps = clock_gaps(
        record(config, lambda case, seed: 5 if case.suite.name == "waiting" or seed == 0 else None)
    )
    assert [(gap.a, gap.b) for gap in gaps] == [
        ("learner, live in real time", "learner, waiting"),
        ("base, live in real time", "base, waiting"),
    ]
    assert gaps[0].total.pairs == Pairs(both=1, only_b=3)
