"""The error rates of intervals and tests: for repeated starts, lost episodes, and all sequences of
commands that add episodes after a look at the results.
"""

from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.config import StopConfig
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.evaluate.report.success import compare_all
from vlagents_ray.evaluate.results.comparison import compare
from vlagents_ray.evaluate.results.early_stopping import CaseStopping
from vlagents_ray.evaluate.results.reader import (
    CaseResults,
    Episode,
    Results,
    Run,
    is_sequential,
    rate_of,
    starts_of,
)
from vlagents_ray.evaluate.results.statistics import (
    Pairs,
    Starts,
    confidence_sequence,
    difference_interval,
    independent_episodes,
    mcnemar,
    paired_test,
    sequential_difference_interval,
    sequential_test,
    sum_of,
)
from vlagents_ray.evaluate.results.summary import summarize
from vlagents_ray.success import wilson

LOST = None
Outcome = bool | None


def case_of(
    policy: str,
    outcomes: list[Outcome],
    *,
    starts: list[str] | None = None,
    env: str = "env",
    planned: int | None = None,
    planned_at: float = 0.0,
    finished_at: list[float] | None = None,
    stop: StopConfig | None = None,
    **settings: Any,
) -> CaseResults:
    """Return a case whose episodes have these outcomes; None is a lost episode."""
    planned = len(outcomes) if planned is None else planned
    results = []
    for number, solved in enumerate(outcomes):
        key = EpisodeKey(env, number, number, "0")
        status: Any = "infra_failed" if solved is LOST else "done"
        start = None if starts is None or solved is LOST else starts[number]
        results.append(EpisodeResult(key, status, solved, solved, start=start))

    at, stopping = None, None
    if stop is not None:
        stopping = CaseStopping(stop, [0], planned)
        stopping.add_all(results)
        at = stopping.at
    episodes = []
    for number, result in enumerate(results):
        finished = 1.0 if finished_at is None else finished_at[number]
        beyond = stopping is not None and not stopping.counts(result.key)
        episodes.append(Episode(result, (), None, 1, 1, finished, beyond=beyond))
    all_settings = {"clock": None, "policy": policy} | settings
    return CaseResults(
        f"{policy} {env}", policy, None, "", env, planned, all_settings, {}, {}, {}, {},
        tuple(episodes), (), stop, at, planned_at,
    )  # fmt: skip


def results_of(*cases: CaseResults) -> Results:
    run = Run(1, 0.0, 2.0, "complete", {}, {})
    return Results(Path("out"), cases, (run,), {})


def states(number: int, of: int) -> list[str]:
    """Return the starts of `number` episodes of an environment with `of` initial states."""
    return [f"init_state {episode % of}" for episode in range(number)]


# Repeated starts


@pytest.mark.parametrize("repeats", [1, 2, 5, 10])
def test_repetition_alone_changes_neither_interval_nor_test(repeats: int) -> None:
    """Two deterministic policies in ten initial states: B solves states 0 to 4, A all."""
    names = states(10 * repeats, 10)
    a = case_of("a", [True] * 10 * repeats, starts=names)
    b = case_of("b", [state % 10 < 5 for state in range(10 * repeats)], starts=names)
    line = compare(results_of(a, b), "a", "b").total
    once = compare(
        results_of(case_of("a", [True] * 10), case_of("b", [True] * 5 + [False] * 5)), "a", "b"
    ).total
    assert line.p_value == once.p_value == mcnemar(5, 0)
    assert line.interval == pytest.approx(once.interval, abs=0.051 / repeats)
    rate = rate_of([b], "success_once")
    assert rate.interval == pytest.approx(wilson(5, 10))
    assert (rate.successes, rate.episodes, line.starts) == (5 * repeats, 10 * repeats, 10)


@given(st.lists(st.integers(1, 9), min_size=1, max_size=30))
def test_repeats_are_worth_at_most_their_starts(repeats: list[int]) -> None:
    number = independent_episodes(repeats)
    assert 1 - 1e-9 <= number <= len(repeats) + 1e-9
    assert independent_episodes([repeats[0]] * len(repeats)) == pytest.approx(len(repeats))


COUNTS = st.integers(0, 6)
PAIRS = st.builds(Pairs, *[st.integers(0, 2)] * 4).filter(lambda pairs: pairs.total > 0)


@given(st.lists(st.dictionaries(PAIRS, COUNTS, max_size=3), max_size=2))
def test_the_paired_test_counts_all_signs(strata: list[Starts]) -> None:
    nets: list[int] = []
    for starts in strata:
        for pairs, number in starts.items():
            nets += [pairs.net] * number
    nets = [net for net in nets if net][:11]
    observed = abs(sum(nets))
    starts = Counter(Pairs(only_a=max(net, 0), only_b=max(-net, 0)) for net in nets)
    both_signs = [(net, -net) for net in nets]
    sums = [abs(sum(signs)) for signs in itertools.product(*both_signs)]
    expected = sum(total >= observed for total in sums) / len(sums)
    assert paired_test([starts]) == pytest.approx(expected, rel=1e-9)


@given(st.builds(Pairs, *[st.integers(0, 40)] * 4))
def test_starts_that_are_not_repeated_give_mcnemars_test(pairs: Pairs) -> None:
    assert paired_test([pairs.starts]) == mcnemar(pairs.only_a, pairs.only_b)
    assert sum_of([pairs.starts]) == pairs


@pytest.mark.parametrize("rate", [0.15, 0.6])
@pytest.mark.parametrize("spread", [0.0, 0.5, 1.0], ids=["noise", "both", "deterministic"])
def test_intervals_cover_the_truth_if_starts_are_repeated(rate: float, spread: float) -> None:
    """`spread` is the share of starts whose episodes all have the same outcome."""
    rng = np.random.default_rng(0)
    runs, number, repeats = 100, 24, 4
    missed = wrong = naive = decided = 0
    for _ in range(runs):
        difficulty = np.where(
            rng.random(number) < spread, (rng.random(number) < rate).astype(float), rate
        )
        a, b = (rng.random((repeats, number)) < difficulty for _ in "ab")
        # B has the same rate over all starts, but solves other ones.
        b = b[:, rng.permutation(number)]
        names = states(number * repeats, number)
        cases = [
            case_of(name, solved.ravel().tolist(), starts=names)
            for name, solved in (("a", a), ("b", b))
        ]
        low, high = rate_of([cases[0]], "success_once").interval
        missed += not low <= rate <= high
        low, high = wilson(int(a.sum()), a.size)
        naive += not low <= rate <= high
        line = compare(results_of(*cases), "a", "b").total
        low, high = line.interval
        wrong += not low <= 0.0 <= high
        decided += line.adjusted < 0.05
    # Three standard deviations above 5 % of so few runs.
    assert max(missed, wrong, decided) / runs <= 0.05 + 3 * (0.05 * 0.95 / runs) ** 0.5
    assert spread < 1 or naive / runs > 0.15, "episodes as independent ones must fail"


# Sequences of commands


def test_the_sequential_interval_is_the_confidence_sequence_of_a_rate() -> None:
    for successes, trials in ((0, 5), (3, 4), (20, 50), (700, 1000)):
        starts = {Pairs(only_a=1): successes, Pairs(only_b=1): trials - successes}
        low, high = sequential_difference_interval([starts])
        assert ((1 + low) / 2, (1 + high) / 2) == pytest.approx(
            confidence_sequence(successes, trials), abs=1e-6
        )
    starts = {Pairs(only_a=1): 9, Pairs(only_b=1): 1, Pairs(both=1): 90}
    low, high = sequential_difference_interval([starts])
    assert low < 0.08 < high
    assert (low > 0) == (sequential_test([starts]) < 0.05)


@given(st.lists(st.dictionaries(PAIRS, st.integers(0, 60), max_size=4), max_size=3))
def test_a_sequential_interval_is_wider_and_agrees_with_its_test(strata: list[Starts]) -> None:
    low, high = sequential_difference_interval(strata)
    assert -1.0 <= low <= high <= 1.0
    p = sequential_test(strata)
    assert 0.0 <= p <= 1.0
    if abs(p - 0.05) > 1e-9 and sum_of(strata).total:
        assert (low > 0 or high < 0) == (p < 0.05)
    net = sum_of(strata).net
    kinds = itertools.chain.from_iterable(strata)
    if net and all(pairs.total == 1 for pairs in kinds):
        assert p >= paired_test(strata) or p > 0.05
        fixed_low, fixed_high = difference_interval(strata)
        assert high - low >= 0.8 * (fixed_high - fixed_low)


@dataclass
class Evaluation:
    """A folder of results of two equal policies, whose episodes commands add."""

    rng: np.random.Generator
    states: int | None  # number of initial states; None: each episode has its own
    is_noisy: bool  # whether the policies draw their actions at random
    stop: StopConfig | None
    now: float = 0.0
    planned: dict[str, int] = field(default_factory=dict)  # by env
    planned_at: dict[str, float] = field(default_factory=dict)
    played: dict[str, list[tuple[bool, bool, float]]] = field(default_factory=dict)
    known: dict[tuple[str, int], tuple[bool, bool]] = field(default_factory=dict)

    def plan(self, env: str, episodes: int) -> None:
        """Run `eval` with more episodes, with a further seed or env, or `merge` with a later
        folder.
        """
        self.now += 1
        self.planned[env] = self.planned.get(env, 0) + episodes
        self.planned_at[env] = self.now

    def play(self, share: float = 1.0) -> None:
        """Run the planned episodes, or end with Ctrl-C after this share of them."""
        for env, planned in self.planned.items():
            played = self.played.setdefault(env, [])
            for number in range(len(played), round(len(played) + share * (planned - len(played)))):
                self.now += 1
                played.append((*self._outcome(env, number), self.now))

    def _outcome(self, env: str, number: int) -> tuple[bool, bool]:
        state = number % (self.states or 10**9)
        rate = np.random.default_rng([state, len(env)]).random()  # the same for both policies
        a, b = (bool(self.rng.random() < rate) for _ in "ab")
        return (a, b) if self.is_noisy else self.known.setdefault((env, state), (a, b))

    def is_decided(self) -> bool:
        """Return whether the report shows a filled dot."""
        cases = []
        for env, played in self.played.items():
            starts = None if self.states is None else states(len(played), self.states)
            for place, name in enumerate(("a", "b")):
                cases.append(
                    case_of(
                        name,
                        [episode[place] for episode in played],
                        starts=starts,
                        env=env,
                        planned=self.planned[env],
                        planned_at=self.planned_at[env],
                        finished_at=[episode[2] for episode in played],
                        stop=self.stop,
                    )
                )
        return compare(results_of(*cases), "a", "b").total.adjusted < 0.05


def ever_decided(rng: np.random.Generator, looks: int) -> bool:
    """Return whether two equal policies are decided at any look between random commands."""
    stops = [None, None, StopConfig(target=0.5, at_least=10), StopConfig(width=0.4)]
    evaluation = Evaluation(
        rng,
        states=[None, 10, 24][rng.integers(3)],
        is_noisy=bool(rng.integers(2)),
        stop=stops[rng.integers(4)],
    )
    evaluation.plan("env", int(rng.integers(6, 40)))
    for _ in range(looks):
        evaluation.play([1.0, float(rng.random())][rng.integers(2)])
        if evaluation.played["env"] and evaluation.is_decided():
            return True
        command = rng.integers(4)
        if command == 0:
            evaluation.plan(f"env{len(evaluation.planned) * '+'}", int(rng.integers(5, 30)))
        elif command < 3:
            env = list(evaluation.planned)[rng.integers(len(evaluation.planned))]
            evaluation.plan(env, int(rng.integers(5, 30)))
    return False


@pytest.mark.parametrize(
    "runs", [60, pytest.param(1000, marks=pytest.mark.slow)], ids=["quick", "long"]
)
def test_no_sequence_of_commands_decides_between_equal_policies_too_often(runs: int) -> None:
    """Grow, resume, stop early, repeat starts, add environments and merge, with a look after each
    command.
    """
    rng = np.random.default_rng(1)
    decided = sum(ever_decided(rng, looks=8) for _ in range(runs))
    assert decided / runs <= 0.05


@cache
def _fixed(only_a: int, only_b: int) -> float:
    return mcnemar(only_a, only_b)


@cache
def _sequential(only_a: int, only_b: int) -> float:
    return sequential_test([{Pairs(only_a=1): only_a, Pairs(only_b=1): only_b}])


@pytest.mark.parametrize(("first", "step"), [(10, 10), (50, 10), (100, 100)])
@pytest.mark.parametrize("rate", [0.1, 0.5])
def test_a_first_look_and_growth_together_keep_the_error_rate(
    first: int, step: int, rate: float
) -> None:
    """The worst sequence: a test of a fixed number of episodes, and then as many more as it takes,
    up to ten times as many.
    """
    rng = np.random.default_rng(0)
    runs, decided, unaware = 1000, 0, 0
    for _ in range(runs):
        a, b = rng.random((2, 10 * first)) < rate
        only_a, only_b = np.cumsum(a & ~b).tolist(), np.cumsum(b & ~a).tolist()
        looks = range(first - 1, 10 * first, step)
        ps = [_fixed(only_a[looks[0]], only_b[looks[0]])]
        ps += [_sequential(only_a[look], only_b[look]) for look in looks[1:]]
        decided += min(ps) < 0.05
        unaware += any(_fixed(only_a[look], only_b[look]) < 0.05 for look in looks)
    assert decided / runs <= 0.05 < unaware / runs


def test_a_number_that_was_chosen_before_the_first_result_is_fixed() -> None:
    fixed = case_of("a", [True] * 10, planned_at=0.5)
    assert not is_sequential([fixed])
    for late in (
        replace(fixed, planned_at=1.5),  # more episodes after the first result
        replace(fixed, planned=11),  # an episode is missing
        replace(fixed, stop=StopConfig(target=0.5)),
    ):
        assert is_sequential([late])
        assert rate_of([late], "success_once").error_rate == 0.05
    # A further env of the policy after its first result is a further look at all of its episodes; a
    # further policy is not.
    added = case_of("a", [True] * 10, env="other", planned_at=1.5, finished_at=[2.0] * 10)
    assert not is_sequential([added])
    assert is_sequential([fixed, added])
    assert not is_sequential([fixed, replace(added, policy="b")])


# Lost episodes

OUTCOMES = st.sampled_from([True, False, LOST])


@settings(max_examples=40)
@given(st.lists(st.tuples(OUTCOMES, OUTCOMES), min_size=1, max_size=7), st.booleans())
def test_each_figure_allows_for_every_outcome_of_what_was_lost(
    table: list[tuple[Outcome, Outcome]], has_states: bool
) -> None:
    """Missing not at random: no assumption about the outcomes of lost episodes."""
    starts = states(len(table), 3) if has_states else None
    a, b = zip(*table, strict=True)
    if not any(x is not LOST and y is not LOST for x, y in table):
        return
    cases = [case_of("a", list(a), starts=starts), case_of("b", list(b), starts=starts)]
    results = results_of(*cases)
    line = compare(results, "a", "b").total
    rates = [rate_of([case], "success_once") for case in cases]
    view = compare_all(summarize(results))
    assert view is not None
    [shown] = view.parts[0].shown
    assert (shown.decided, shown.p_value) == (line.adjusted < 0.05, line.p_value)
    assert view.lost == line.lost == sum(LOST in pair for pair in table)

    free = [i for i, outcome in enumerate([*a, *b]) if outcome is LOST]
    for values in itertools.product((True, False), repeat=len(free)):
        outcomes: list[Any] = [*a, *b]
        for place, value in zip(free, values, strict=True):
            outcomes[place] = value
        halves = outcomes[: len(a)], outcomes[len(a) :]
        complete = [
            case_of(name, half, starts=starts) for name, half in zip("ab", halves, strict=True)
        ]
        for rate, case in zip(rates, complete, strict=True):
            low, high = rate_of([case], "success_once").interval
            if starts is None:
                assert rate.interval[0] <= low + 1e-12
                assert rate.interval[1] >= high - 1e-12
        whole = compare(results_of(*complete), "a", "b").total
        difference = whole.pairs.difference or 0.0
        assert line.interval[0] <= difference <= line.interval[1]
        if starts is None:
            assert line.p_value >= whole.p_value - 1e-12
        if line.adjusted < 0.05:
            assert difference * (line.pairs.difference or 0.0) > 0, "the sign is not decided"


def test_losses_of_the_better_policy_do_not_decide() -> None:
    """A solves 20 of 40 and loses the other 20; B solves 30 of 40."""
    a = [True if number % 2 == 0 else LOST for number in range(40)]
    b = [number % 2 == 1 or number % 4 == 0 for number in range(40)]
    line = compare(results_of(case_of("a", a), case_of("b", list(b))), "a", "b").total
    assert line.pairs.difference == 0.5
    assert mcnemar(line.pairs.only_a, line.pairs.only_b) < 0.05
    assert (line.p_value, line.lost) == (1.0, 20)
    low, high = line.interval
    assert low < -0.25 < high


@given(
    st.lists(st.integers(0, 5), min_size=1, max_size=12),
    st.lists(st.sampled_from("xyz"), min_size=1, max_size=3, unique=True),
)
def test_a_seed_is_one_start_in_all_suites_of_an_env(
    states_of: list[int], suites: list[str]
) -> None:
    """Two suites may render the same seeds differently, so that their first observations differ."""
    cases = []
    for suite in suites:
        names = [f"digest {suite} {state}" for state in states_of]
        case = case_of("a", [True] * len(names), starts=names)
        cases.append(replace(case, case_id=suite, suite=suite))
    starts = starts_of(cases)
    assert all(names == starts[suites[0]] for names in starts.values())
    assert len(set(starts[suites[0]].values())) == len(set(states_of))
    rate = rate_of(cases, "success_once")
    repeats = Counter(states_of).values()
    alone = independent_episodes(repeats)
    assert alone == pytest.approx(
        rate.episodes / len(suites) if rate.independent is None else rate.independent
    )


def test_the_same_episodes_in_a_second_suite_decide_nothing() -> None:
    """Two suites that differ only in the size of their pictures."""
    cases = []
    for suite in ("small", "large"):
        for policy, solved in (("a", 5), ("b", 0)):
            outcomes: list[Outcome] = [number < solved for number in range(10)]
            names = [f"{suite} {number}" for number in range(10)]
            case = case_of(policy, outcomes, starts=names)
            cases.append(replace(case, case_id=f"{policy} {suite}", suite=suite))
    comparison = compare(results_of(*cases), "a", "b")
    assert [line.p_value for line in comparison.suites] == [mcnemar(5, 0)] * 2
    assert comparison.total.p_value == mcnemar(5, 0)
    assert mcnemar(10, 0) < 0.05 < comparison.total.p_value
