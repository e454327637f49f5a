"""Two contenders on the episodes that both played, and a contender with and without a clock that runs on."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.results import CellResults, Results, synchronous_twin
from vlagents_ray.evaluate.statistics import Pairs, difference_interval, holm

# Of a cell's settings, those of the policy: what contenders may differ in. All others are the env's.
OF_POLICY = frozenset({"policy", "policy_config", "policy_options", "checkpoint", "execute", "codec"})
ALL = "all"

Strata = dict[str, Pairs]  # by env


@dataclass(frozen=True, slots=True)
class Line:
    """The comparison on one suite, or on all."""

    suite: str  # or "all"
    strata: tuple[Pairs, ...]  # by env
    adjusted: float  # McNemar's p-value, by Holm's method for all that is compared beside it

    @property
    def pairs(self) -> Pairs:
        """All envs together."""
        return sum(self.strata, Pairs())

    @property
    def interval(self) -> tuple[float, float]:
        """95 %, of the difference A less B."""
        return difference_interval(self.strata)

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        beside = {"interval_95": list(self.interval), "p_holm": self.adjusted}
        return {"suite": self.suite} | self.pairs.to_json() | beside


@dataclass(frozen=True, slots=True)
class Comparison:
    """Contender A against contender B."""

    a: str
    b: str
    suites: tuple[Line, ...]  # one each, in the order of the plan; empty where they share but one
    total: Line

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        return {"a": self.a, "b": self.b, "lines": [line.to_json() for line in (*self.suites, self.total)]}


def compare(results: Results, a: str, b: str) -> Comparison:
    """`a` against `b` on the episodes that both have finished: same suite, env, settings of the env, number and seed.

    Raises `ConfigError` if there are none, or if an env of a suite had other settings for the one than for the other.
    """
    return comparisons(results, [(a, b)])[0]


def comparisons(results: Results, which: Sequence[tuple[str, str]]) -> list[Comparison]:
    """`compare` each of these pairs of contenders, with p-values that are adjusted for one another.

    Those of one suite are one family for Holm's method, and those of all suites together another.
    """
    found = [_by_suite(results, a, b) for a, b in which]
    totals = _lines(ALL, [[pairs for strata in suites.values() for pairs in strata.values()] for suites in found])
    lines: list[list[Line]] = [[] for _ in which]
    for suite in dict.fromkeys(suite for suites in found for suite in suites):
        having = [index for index, suites in enumerate(found) if suite in suites and len(suites) > 1]
        family = _lines(suite, [list(found[index][suite].values()) for index in having])
        for index, line in zip(having, family, strict=True):
            lines[index].append(line)
    return [Comparison(a, b, tuple(lines[i]), totals[i]) for i, (a, b) in enumerate(which)]


def comparable(results: Results) -> tuple[list[tuple[str, str]], list[str]]:
    """The pairs of contenders that `compare` takes, each once, and why it takes no other."""
    pairs, reasons = [], []
    for a, b in itertools.combinations(results.contenders, 2):
        try:
            _by_suite(results, a, b)
        except ConfigError as error:
            reasons.append(str(error))
        else:
            pairs.append((a, b))
    return pairs, reasons


def clock_gaps(results: Results) -> list[Comparison]:
    """Every contender's suites in real time (A) against the same envs with a clock that waits (B).

    A is named "CONTENDER, SUITE in real time", B "CONTENDER, SUITE". A suite without such a twin is left out.
    """
    found: dict[tuple[str, str], Strata] = {}
    for cell in results.cells:
        twin = synchronous_twin(results, cell)
        if twin is not None and (pairs := _pairs(cell, twin)).total:
            name = f"{cell.contender}, {cell.suite} in real time", f"{cell.contender}, {twin.suite}".rstrip(", ")
            found.setdefault(name, {})[cell.env] = pairs
    lines = _lines(ALL, [list(strata.values()) for strata in found.values()])
    return [Comparison(a, b, (), line) for (a, b), line in zip(found, lines, strict=True)]


def _by_suite(results: Results, a: str, b: str) -> dict[str, Strata]:
    if unknown := sorted({a, b} - set(results.contenders)):
        raise ConfigError(f"compare: got {unknown}, want two of the contenders {results.contenders}")
    others = {(cell.suite, cell.env): cell for cell in results.of(b)}
    found: dict[str, Strata] = {}
    for cell in results.of(a):
        other = others.get((cell.suite, cell.env))
        if other is None:
            continue
        _require_same_env(cell, other)
        pairs = _pairs(cell, other)
        if pairs.total:
            found.setdefault(cell.suite, {})[cell.env] = pairs
    if not found:
        raise ConfigError(f"compare: {a!r} and {b!r} share no finished episode; evaluate both with the same seeds")
    return found


def _require_same_env(cell: CellResults, other: CellResults) -> None:
    one, two = _of_env(cell), _of_env(other)
    for name in sorted(one.keys() | two.keys()):
        if one.get(name) != two.get(name):
            raise ConfigError(
                f"compare: {cell.env!r} had {name} {one.get(name)!r} for {cell.contender!r}, but {two.get(name)!r} for "
                f"{other.contender!r}; evaluate both alike, or name the suites apart"
            )


def _of_env(cell: CellResults) -> dict[str, Any]:
    return {name: value for name, value in cell.settings.items() if name not in OF_POLICY}


def _pairs(a: CellResults, b: CellResults) -> Pairs:
    """By success once, as the first column of the table of results."""
    theirs = {(one.key.episode, one.key.seed): bool(one.success_once) for one in b.counted}
    outcomes = [
        (bool(one.success_once), theirs[one.key.episode, one.key.seed])
        for one in a.counted
        if (one.key.episode, one.key.seed) in theirs
    ]
    return Pairs(*(outcomes.count(outcome) for outcome in ((True, True), (True, False), (False, True), (False, False))))


def _lines(suite: str, family: Sequence[Sequence[Pairs]]) -> list[Line]:
    adjusted = holm([sum(strata, Pairs()).p_value for strata in family])
    return [Line(suite, tuple(strata), p) for strata, p in zip(family, adjusted, strict=True)]
