"""Success rates as others quote them: with the episodes, the interval, the protocol, the weights and the code."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any, Literal

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.results.reader import CellResults, Results, have_common_rate, rate_of
from vlagents_ray.evaluate.results.statistics import Rate
from vlagents_ray.evaluate.results.summary import checkpoint_of, pushed_of, weights_of

Metric = Literal["success_once", "success_at_end"]
_AT_END = "at the end"  # SIMPLER's protocol: the last state decides
_MOST_NOTED = 5  # deviations in a note; `Score.facts` has all


@dataclass(frozen=True, slots=True)
class Score:
    """The success rate of one policy id in one benchmark, or in a part of it."""

    results: Results
    name: str  # "libero/libero_spatial", "tabletop"; after the name of a suite, or with the task, where that is needed
    cells: tuple[CellResults, ...]  # that have a common rate

    @property
    def metric(self) -> Metric:
        """The success that the benchmark's protocol counts: after some step, unless it says after the last."""
        return (
            "success_at_end" if any(_protocol(one).get("success") == _AT_END for one in self.cells) else "success_once"
        )

    @property
    def rate(self) -> Rate:
        return rate_of(self.cells, self.metric)

    @property
    def date(self) -> datetime:
        """The time at which the last episode was recorded, in UTC."""
        last = max(one.finished for cell in self.cells for one in cell.episodes if one.counts)
        return datetime.fromtimestamp(int(last), timezone.utc)

    @property
    def deviations(self) -> list[str]:
        """What differs from the protocol, or from the plan, a phrase each."""
        found = [text for cell in self.cells for text in _deviations(cell)]
        return list(dict.fromkeys(found))

    @property
    def facts(self) -> dict[str, Any]:
        """All that pools or doubts the rate, as plain JSON values."""
        low, high = self.rate.interval
        kind = "Wilson" if self.rate.error_rate is None else "confidence sequence"
        level = 0.95 if self.rate.error_rate is None else 1 - self.rate.error_rate
        seeds = sorted({one.key.seed for cell in self.cells for one in cell.counted})
        return {
            "episodes": self.rate.episodes,
            "successes": self.rate.successes,
            "interval": {"low": low, "high": high, "level": level, "kind": kind},
            "policy_errors": sum(one.status == "policy_error" for cell in self.cells for one in cell.counted),
            "seeds": [seeds[0], seeds[-1]],
            "tasks": {cell.env: rate_of([cell], self.metric).to_json() for cell in self.cells},
            "protocols": _distinct([_protocol(cell) for cell in self.cells]),
            "deviations": self.deviations,
            "settings": sorted(cell.cell for cell in self.cells),
            "checkpoints": _distinct([checkpoint_of(cell) for cell in self.cells]),
            "weights": _distinct([weights_of(cell) for cell in self.cells]),
            "pushed_weights": _distinct([pushed_of(cell) for cell in self.cells]),
            "policies": _distinct([self.results.policies.get(cell.policy, {}).get("policy") for cell in self.cells]),
            "code": _distinct([_code(run.versions) for run in self.results.runs]),
        }

    @property
    def note(self) -> str:
        """The facts in one line of text."""
        facts, low_high = self.facts, [f"{100 * bound:.1f}" for bound in self.rate.interval]
        kind, level = facts["interval"]["kind"], facts["interval"]["level"]
        odd = facts["deviations"]
        more = f"; and {len(odd) - _MOST_NOTED} more" if len(odd) > _MOST_NOTED else ""
        names = [str(one["name"]) for one in facts["protocols"] if "name" in one]
        stated = ", ".join(dict.fromkeys(names)) or ("the environment's" if facts["protocols"] else "none stated")
        weights = ", ".join(facts["weights"] or facts["checkpoints"]) or "no digest reported"
        return (
            f"success rate in %, {_WHEN[self.metric]}; {facts['successes']} of {facts['episodes']} episodes, "
            f"{100 * level:g} % interval ({kind}) {low_high[0]} to {low_high[1]}; "
            f"seeds {facts['seeds'][0]} to {facts['seeds'][1]}; protocol: {stated}; "
            f"deviations: {'; '.join(odd[:_MOST_NOTED]) or 'none'}{more}; weights: {weights}; "
            f"code: {', '.join(_code_text(one) for one in facts['code'])}"
        )


_WHEN = {"success_once": "solved after some step", "success_at_end": "solved after the last step"}


def scores(results: Results) -> list[Score]:
    """The scores of the only policy id in `results`, by benchmark, those of suites with other options apart.

    Raises:
        ConfigError: There are several policy ids, or no episode has a result.
    """
    if len(results.contenders) != 1:
        raise ConfigError(f"got the policies {results.contenders}, want one: name it with --policy NAME, or NAME@STEP")
    groups: dict[tuple[str, str], list[CellResults]] = {}
    for cell in results.cells:
        groups.setdefault((cell.suite, benchmark_of(cell.env)), []).append(cell)
    # A task all of whose episodes were lost stays with its benchmark, whose score has it among the deviations.
    groups = {name: cells for name, cells in groups.items() if any(cell.counted for cell in cells)}
    if not groups:
        raise ConfigError(f"{results.out}: has no finished episode, want results that a rate can be made of")
    names = [benchmark for _, benchmark in groups]
    found: list[Score] = []
    for (suite, benchmark), cells in groups.items():
        name = benchmark if names.count(benchmark) == 1 else f"{suite} {benchmark}".strip()
        if have_common_rate(cells):
            found.append(Score(results, name, tuple(cells)))
        else:  # they stopped after different numbers of episodes, or some were in real time
            found += [Score(results, cell.task, (cell,)) for cell in cells if cell.counted]
    return found


def benchmark_of(env: str) -> str:
    """The benchmark that an env's name belongs to: "libero/libero_spatial" of "libero/libero_spatial/3"."""
    return env if ":" in env else env.rpartition("/")[0] or env


def _protocol(cell: CellResults) -> dict[str, Any]:
    stated = cell.described.get("protocol")
    return dict(stated) if isinstance(stated, dict) else {}


def _deviations(cell: CellResults) -> list[str]:
    found = [str(one) for one in _protocol(cell).get("deviations") or []]
    if cell.settings.get("clock") is not None:
        found.append("real time: the environment does not wait for the policy")
    if cell.settings.get("codec") == "jpeg":
        found.append("the policy got JPEG images")
    if cell.stopped_at is not None:
        found.append(f"{cell.env}: stopped early, after {cell.stopped_at} of {cell.planned} episodes")
    if cell.missing:
        found.append(f"{cell.env}: {cell.missing} of {cell.planned} planned episodes have no result")
    return found


def _distinct(values: Sequence[Any]) -> list[Any]:
    found: list[Any] = []
    for value in values:
        if value and value not in found:
            found.append(value)
    return found


def _code(versions: dict[str, Any]) -> dict[str, Any]:
    state = (versions.get("code") or {}).get("vlagents_ray") or {}
    return {"vlagents-ray": versions.get("vlagents-ray")} | {
        name: state[name] for name in ("commit", "diff_sha256") if state.get(name)
    }


def _code_text(code: dict[str, Any]) -> str:
    commit = f" at commit {code['commit']}" if "commit" in code else ""
    changed = f" with changes (SHA-256 {code['diff_sha256']})" if "diff_sha256" in code else ""
    return f"vlagents-ray {code.get('vlagents-ray')}{commit}{changed}"
