"""Makes the table and the picture of `benchmarks.learners`.

`python -m benchmarks.learners_page examples/reference/learners.json --picture
docs/pictures/learners.svg` prints the table as Markdown. The same table in docs/ is written by
tests/support/tables.py.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Annotated, Any

import typer

from benchmarks.picture import plot_learners
from vlagents_ray.cli.console import errors, out
from vlagents_ray.evaluate.results.statistics import Pairs, difference_interval, wilson

NAMES = {
    "dagger": "DAgger",
    "cloning": "cloning",
    "cloning_h264": "cloning, frames in H.264",
    "grpo": "GRPO",
    "ppo": "PPO",
}
KINDS = ("demonstrations", "rollouts", "interventions")  # kinds of episodes
# The 97.5 % quantiles of Student's t-distribution for 1, 2, … degrees of freedom.
_T_975 = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262)


@dataclass(frozen=True)
class LearnerRow:
    """The figures of all runs of a learner with the same number of optimizer steps."""

    learner: str
    steps: int | None  # number of optimizer steps, if it is a setting
    seeds: tuple[int, ...]
    episodes: Mapping[str, float]  # mean numbers of episodes per run, by kind
    cpu_s: float | None  # mean CPU time of the runs whose CPU time was measured, s
    cpu_runs: int  # number of runs
    success: tuple[float, ...]  # success of each run, in [0, 1]
    gains: tuple[float, ...]  # gains of each run over the policy before it
    # Counts of the pairs of episodes of a single run; None if there are several runs.
    pairs: Pairs | None
    # Largest p value of McNemar's tests of the runs; None if a run has none.
    largest_p: float | None
    # Numbers of solved episodes and of all episodes, over all evaluated runs.
    metaworld: tuple[int, int] | None


def label(learner: str, steps: int | None) -> str:
    """Return the name of a learner in the table and in the picture."""
    return NAMES[learner] if steps is None else f"{NAMES[learner]}, {steps} steps"


def rate_of(rates: Mapping[str, Sequence[int]]) -> tuple[int, int]:
    """Return the numbers of solved episodes and of all episodes over all environments."""
    return sum(rate[0] for rate in rates.values()), sum(rate[1] for rate in rates.values())


def learner_rows(figures: Mapping[str, Any]) -> list[LearnerRow]:
    """Return a row for each learner of `benchmarks.learners` and number of optimizer steps, the
    best row first.
    """
    solved_before, held_out = rate_of(figures["before"]["tabletop"])
    rows = []
    kinds = dict.fromkeys((run["learner"], run["steps"]) for run in figures["runs"])
    for learner, steps in kinds:
        runs = [
            run for run in figures["runs"] if (run["learner"], run["steps"]) == (learner, steps)
        ]
        success = []
        for run in runs:
            solved, episodes = rate_of(run["tabletop"]["rates"])
            success.append(solved / episodes)
        costs = [run["cpu_s"] for run in runs if run.get("cpu_s") is not None]
        p_values = [run["tabletop"].get("p_value") for run in runs]
        rows.append(
            LearnerRow(
                learner=learner,
                steps=steps,
                seeds=tuple(run["seed"] for run in runs),
                episodes=_mean_episodes(runs),
                cpu_s=fmean(costs) if costs else None,
                cpu_runs=len(costs),
                success=tuple(success),
                gains=tuple(rate - solved_before / held_out for rate in success),
                pairs=_pairs(runs[0]["tabletop"]) if len(runs) == 1 else None,
                largest_p=None if None in p_values else max(p_values),
                metaworld=_metaworld(runs),
            )
        )
    return sorted(rows, key=lambda row: -fmean(row.success))


def _mean_episodes(runs: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return the mean number of episodes of a run, by their kind."""
    means = {}
    for kind in KINDS:
        if kind in runs[0]["episodes"]:
            means[kind] = fmean(run["episodes"][kind] for run in runs)
    return means


def _pairs(tabletop: Mapping[str, Any]) -> Pairs | None:
    """Return the counts of a run; None if only its rate is known."""
    if "both" not in tabletop:
        return None
    names = ("both", "only_a", "only_b", "neither")
    return Pairs(*(tabletop[name] for name in names))


def _metaworld(runs: Sequence[Mapping[str, Any]]) -> tuple[int, int] | None:
    """Return the numbers of solved episodes and of all episodes of Meta-World; None if no run has
    any.
    """
    rates = [rate_of(run["metaworld"]["rates"]) for run in runs if "metaworld" in run]
    if not rates:
        return None
    return sum(solved for solved, _ in rates), sum(episodes for _, episodes in rates)


def gain_interval(row: LearnerRow) -> tuple[float, float, float]:
    """Return the mean gain of the runs and its 95 % interval.

    The interval of several runs is based on Student's t-distribution over seeds. The interval of a
    single run is based on its pairs of episodes, and does not account for other seeds.
    """
    if row.pairs is None:
        return mean_interval(row.gains)
    return (row.gains[0], *difference_interval([row.pairs]))


def mean_interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the mean and its 95 % interval with Student's t-distribution.

    Args:
        values: One value for each run.

    Returns:
        The mean and the bounds of the interval; the bounds are NaN if there is only one run.
    """
    mean = fmean(values)
    if len(values) == 1:
        return mean, math.nan, math.nan
    error = _T_975[len(values) - 2] * stdev(values) / math.sqrt(len(values))
    return mean, mean - error, mean + error


def table_rows(figures: Mapping[str, Any], learners: Sequence[str] = tuple(NAMES)) -> Iterator[str]:
    """Yield the lines of the table in Markdown.

    Args:
        figures: The figures of `benchmarks.learners`.
        learners: The learners that the table has.
    """
    columns = (
        "learner",
        "runs",
        "episodes of a run",
        "CPU min",
        "success of each run, %",
        "gain, points",
        "p",
        "Meta-World, %",
    )
    yield f"| {' | '.join(columns)} |"
    yield "|---" * len(columns) + "|"
    solved, held_out = rate_of(figures["before"]["tabletop"])
    metaworld = figures["before"].get("metaworld")
    before = _with_count(rate_of(metaworld)) if metaworld else ""
    yield f"| before | | | | {100 * solved / held_out:.1f} | | | {before} |"
    for row in learner_rows(figures):
        if row.learner in learners:
            yield _line(row)


def _line(row: LearnerRow) -> str:
    mean, low, high = (100 * value for value in gain_interval(row))
    interval = "" if math.isnan(low) else f" [{low:.1f}, {high:.1f}]"
    cpu = ""
    if row.cpu_s is not None:
        cpu = f"{row.cpu_s / 60:.1f}"
        if row.cpu_runs < len(row.seeds):
            cpu += f" ({row.cpu_runs} run)" if row.cpu_runs == 1 else f" ({row.cpu_runs} runs)"
    cells = (
        label(row.learner, row.steps),
        str(len(row.seeds)),
        ", ".join(f"{number:,.0f} {kind}" for kind, number in row.episodes.items()),
        cpu,
        ", ".join(f"{100 * rate:.1f}" for rate in row.success),
        f"{mean:+.1f}{interval}",
        _p_value(row),
        "" if row.metaworld is None else _with_count(row.metaworld),
    )
    return f"| {' | '.join(cells)} |"


def _p_value(row: LearnerRow) -> str:
    if row.largest_p is None:
        return ""
    return f"{row.largest_p:.2g}" if len(row.seeds) == 1 else f"≤ {row.largest_p:.1g}"


def _with_count(rate: tuple[int, int]) -> str:
    """Return a rate with its interval (Wilson) and the number of its episodes."""
    solved, episodes = rate
    low, high = wilson(solved, episodes)
    return f"{100 * solved / episodes:.1f} [{100 * low:.1f}, {100 * high:.1f}] of {episodes}"


def main(
    file: Annotated[Path, typer.Argument(help="File of `benchmarks.learners --results`.")],
    picture: Annotated[Path | None, typer.Option(help="File of the picture.")] = None,
) -> None:
    """Print the table of the learners, and draw their success against their costs."""
    with errors():
        figures = json.loads(file.read_text())
        out.print("\n".join(table_rows(figures)), soft_wrap=True, markup=False)
        if picture is not None:
            solved, episodes = rate_of(figures["before"]["tabletop"])
            plot_learners(points_of(figures), solved / episodes, picture)


def points_of(figures: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return a point for each run: `learner`, `success`, `episodes`, and `cpu_s` or None."""
    points = []
    for run in figures["runs"]:
        solved, episodes = rate_of(run["tabletop"]["rates"])
        # The interventions of DAgger are in episodes that already count as rollouts.
        used = run["episodes"].get("rollouts", run["episodes"].get("demonstrations"))
        points.append(
            {
                "learner": label(run["learner"], run["steps"]),
                "success": solved / episodes,
                "episodes": used,
                "cpu_s": run.get("cpu_s"),
            }
        )
    return points


if __name__ == "__main__":
    typer.run(main)
