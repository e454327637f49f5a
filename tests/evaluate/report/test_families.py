"""Comparisons over whole families: the chance of any wrong decision, and evaluations with several
clocks.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from eval_fakes import LINE
from recorded_results import record, runs
from rich.console import Console

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import Results, print_summary
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.evaluate.report import success
from vlagents_ray.evaluate.report.page import write_report
from vlagents_ray.evaluate.report.results_document import ResultsDocument
from vlagents_ray.evaluate.report.success import compare_all, families, families_json
from vlagents_ray.evaluate.results.comparison import compare
from vlagents_ray.evaluate.results.reader import CaseResults, Episode, Run, by_timing
from vlagents_ray.evaluate.results.statistics import ERROR_RATE
from vlagents_ray.evaluate.results.summary import Summary, summarize
from vlagents_ray_results.merge import merge

EPISODES = 60
EVALUATIONS = 200


@cache
def _episode(number: int, *, solved: bool) -> Episode:
    key = EpisodeKey(LINE, number, number, "case")
    result = EpisodeResult(key, "done", success_once=solved, success_at_end=solved)
    return Episode(result, (), None, 1, 1, 0.0)


def _equal_policies(number: int, *, sweep: bool, random: np.random.Generator) -> Results:
    """Return results of policy ids that all solve half of the episodes: policies, or checkpoints
    of one policy.
    """
    cases = []
    for index, outcomes in enumerate(random.random((number, EPISODES)) < 0.5):
        name, step = ("learner", 100 * (index + 1)) if sweep else (f"policy{index}", None)
        episodes = tuple(
            _episode(episode, solved=bool(solved)) for episode, solved in enumerate(outcomes)
        )
        settings = {"policy": name, "checkpoint": step, "env": LINE, "clock": None}
        identity = ({}, {}, {}, {})
        cases.append(
            CaseResults(
                f"case{index}", name, step, "", LINE, EPISODES, settings, *identity, episodes, ()
            )
        )
    run = Run(1, 0.0, 1.0, "complete", {}, {})
    return Results(Path("/nowhere"), tuple(cases), (run,), {})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "most_pairs", "most_compared", "sweep"),
    [
        pytest.param(6, 15, 780, False, id="all shown"),
        pytest.param(6, 14, 780, True, id="some folded"),
        pytest.param(18, 15, 153, False, id="all compared", marks=pytest.mark.integration),
        pytest.param(18, 15, 152, False, id="the best compared"),
        pytest.param(18, 15, 152, True, id="neighbours compared"),
    ],
)
def test_equal_policies_are_told_apart_in_five_percent_of_evaluations_at_most(
    number: int, most_pairs: int, most_compared: int, sweep: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The parameters cover both sides of each constant. With more policies, the shown pairs depend
    on the outcomes.
    """
    monkeypatch.setattr(success, "MOST_PAIRS", most_pairs)
    monkeypatch.setattr(success, "MOST_COMPARED", most_compared)
    random = np.random.default_rng(number)
    wrong = 0
    for _ in range(EVALUATIONS):
        results = _equal_policies(number, sweep=sweep, random=random)
        [family] = families(summarize(results))
        wrong += any(comparison.total.adjusted < ERROR_RATE for comparison in family.comparisons)
    standard_deviation = math.sqrt(EVALUATIONS * ERROR_RATE * (1 - ERROR_RATE))
    assert wrong <= EVALUATIONS * ERROR_RATE + 2 * standard_deviation
    assert (family.left_out > 0) == (most_compared < math.comb(number, 2))


def test_the_page_decides_by_the_adjusted_p_values(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(success, "MOST_COMPARED", 152)
    random = np.random.default_rng(3)
    for _ in range(5):
        summary = summarize(_equal_policies(18, sweep=False, random=random))
        [family], compared = families(summary), compare_all(summary)
        assert compared is not None
        shown = {
            (row.a, row.b): row for part in compared.parts for row in (*part.shown, *part.folded)
        }
        for comparison in family.comparisons:
            row = shown[comparison.a, comparison.b]
            assert (row.adjusted, row.decided) == (
                comparison.total.adjusted,
                comparison.total.adjusted < ERROR_RATE,
            )


# Numbers of solved episodes out of 11 synchronous and 13 real-time ones, chosen so that no rate of
# one clock equals a rate over both.
WAITING, LIVE = 11, 13
SOLVED = {
    ("learner", "waiting"): 10,
    ("learner", "live"): 1,
    ("base", "waiting"): 5,
    ("base", "live"): 12,
}


def _solved(case: EvalCase, seed: int) -> int | None:
    return 5 if seed < SOLVED[case.policy.name, case.suite.name] else None


def _suites(*, clocks: tuple[str, ...] = ("waiting", "live")) -> list[dict[str, Any]]:
    clock = {"latency": 0.1, "mode": "async"}
    waiting = {"name": "waiting", "envs": [LINE], "episodes": WAITING}
    live = {"name": "live", "envs": [LINE], "episodes": LIVE, "clock": clock}
    return [{"waiting": waiting, "live": live}[name] for name in clocks]


def _of_one_run(out: Path, steps: list[int]) -> Results:
    return record(runs(out / "run", steps=steps, suites=_suites()), _solved)


def _of_two_folders(out: Path, steps: list[int]) -> Results:
    folders = []
    for clock in ("waiting", "live"):
        folder = out / clock
        record(runs(folder, steps=steps, suites=_suites(clocks=(clock,))), _solved)
        folders.append(folder)
    return merge(out / "merged", folders).results


def _numbers(value: object) -> Iterator[float]:
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        for member in value:
            yield from _numbers(member)
    elif isinstance(value, float):
        yield abs(value)


def _numbers_of_text(text: str) -> Iterator[float]:
    """Return the percentages in a page or a terminal output, as shares."""
    for percent in re.findall(r"\d+\.\d(?!\d)|\d+(?=%)", text):
        yield float(percent) / 100


def _outputs(results: Results) -> dict[str, list[float]]:
    """Return the numbers in each output with success rates."""
    summary = summarize(results)
    console = Console(file=StringIO(), width=200)
    print_summary(console, summary)
    page = write_report(results, results.out / "page.html").read_text()
    elements = page[page.index("<main") : page.index('id="configuration"')]
    return {
        "summary.json": list(_numbers(summary.to_json())),
        "report --json": list(_numbers(families_json(summary))),
        "terminal": list(_numbers_of_text(console.file.getvalue())),  # type: ignore[attr-defined]
        "page": list(_numbers_of_text(elements)),
        "live page": list(_numbers(ResultsDocument(results.out).read())),
    }


def _pooled() -> dict[str, float]:
    """Return the numbers that only appear if episodes of both clocks are pooled."""
    both = WAITING + LIVE
    learner, base = (SOLVED[name, "waiting"] + SOLVED[name, "live"] for name in ("learner", "base"))
    rates = {"learner": learner / both, "base": base / both}
    mean = {
        name: (SOLVED[name, "waiting"] / WAITING + SOLVED[name, "live"] / LIVE) / 2
        for name in ("learner", "base")
    }
    returns = {f"return of {name}": 1 - rate for name, rate in rates.items()}
    difference = {"difference": abs(rates["learner"] - rates["base"])}
    return rates | {f"mean of {name}": rate for name, rate in mean.items()} | returns | difference


@pytest.mark.parametrize("steps", [[], [1000, 2000]], ids=["policies", "checkpoints"])
@pytest.mark.parametrize("results_of", [_of_one_run, _of_two_folders], ids=["one run", "merged"])
def test_no_output_pools_episodes_of_two_clocks(
    results_of: Callable[[Path, list[int]], Results], steps: list[int], tmp_path: Path
) -> None:
    results = results_of(tmp_path, steps)
    forbidden = _pooled()
    for output, numbers in _outputs(results).items():
        in_percent = output in ("terminal", "page")
        for name, value in forbidden.items():
            digits = 3 if in_percent else 9
            equal = [number for number in numbers if round(number, digits) == round(value, digits)]
            assert not equal, f"{output} contains the pooled {name}, {value:.4f}"
        expected = SOLVED["learner", "waiting"] / WAITING
        found = any(round(number, 2) == round(expected, 2) for number in numbers)
        assert found or output == "report --json", (
            f"{output} lacks the rate of one clock, {expected:.3f}"
        )
    a, b = results.policy_ids[0], results.policy_ids[-1]
    with pytest.raises(ConfigError, match="several timings"):
        compare(results, a, b)


# The kinds of timing, with the settings of a case.
KINDS: dict[str, dict[str, Any]] = {
    "synchronous": {},
    "in real time": {"clock": {"latency": 0.1}},
    "in real time, slower": {"clock": {"latency": 0.2}},
    "on the robot": {"robot": {"arm": "x:Y", "hz": 20.0, "task": {"instruction": "go"}}},
    "on the robot, faster": {"robot": {"arm": "x:Y", "hz": 50.0, "task": {"instruction": "go"}}},
}


@pytest.mark.parametrize(("one", "other"), list(itertools.combinations(KINDS, 2)))
def test_no_two_kinds_of_timing_share_a_rate_or_a_pair(one: str, other: str) -> None:
    cases = []
    for kind, solved in ((one, True), (other, False)):
        for policy in ("a", "b"):
            settings = {"policy": policy, "clock": None} | KINDS[kind]
            episodes = tuple(_episode(number, solved=solved) for number in range(4))
            cases.append(
                CaseResults(
                    f"{policy} {kind}", policy, None, kind, LINE, 4, settings, *({},) * 4,
                    episodes, (),
                )
            )  # fmt: skip
    results = Results(Path("/nowhere"), tuple(cases), (Run(1, 0.0, 1.0, "complete", {}, {}),), {})
    assert [len(members) for members in by_timing(cases).values()] == [2, 2]
    summary = summarize(results)
    for total in summary.totals:
        assert (total.success_once.rate, total.mean_steps, total.mean_return) == (None,) * 3
    table = success.success_table(summary)
    rates = set()
    for block in table.blocks:
        rates |= {group.success_once.rate for group in block.groups}
    assert rates == {0, 1}
    with pytest.raises(ConfigError, match="several timings"):
        compare(results, "a", "b")
    for timing in by_timing(cases):
        assert compare(results, "a", "b", timing=timing).total.pairs.total == 4

    # A policy of one kind and a policy of the other kind in the same env are no pair.
    mixed = [replace(case, suite="") for case in (cases[0], cases[3])]
    with pytest.raises(ConfigError, match=r"expected the same (clock|robot)"):
        compare(results.among(mixed), "a", "b")


def test_two_tasks_of_one_robot_are_one_timing() -> None:
    cases = []
    for task in ("cup", "drawer"):
        robot = {"arm": "x:Y", "hz": 20.0, "task": {"instruction": task}}
        cases.append(
            CaseResults(
                task, "a", None, "", task, 1, {"clock": None, "robot": robot}, *({},) * 4, (), ()
            )
        )
    assert list(by_timing(cases)) == ["on the robot"]


def test_episodes_in_real_time_change_nothing_of_those_that_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The best policy, the compared pairs and their p-values come from episodes of one clock."""
    monkeypatch.setattr(success, "MOST_COMPARED", 2)

    def synchronous_parts(live_solved: dict[str, int]) -> list[object]:
        for name, solved in live_solved.items():
            monkeypatch.setitem(SOLVED, (name, "live"), solved)
        results = record(
            runs(tmp_path / str(live_solved["base"]), steps=[1000, 2000], suites=_suites()), _solved
        )
        summary: Summary = summarize(results)
        compared = [
            family for family in families_json(summary) if family["timing"] == "synchronous"
        ]
        page = write_report(results, results.out / "page.html").read_text()
        headline = re.search(r"solved by the best, ([^<,]*, [^<,]*)", page)
        assert headline is not None
        return [summary.best[0], compared, headline.group(1)]

    assert synchronous_parts({"learner": 0, "base": 13}) == synchronous_parts(
        {"learner": 13, "base": 0}
    )
