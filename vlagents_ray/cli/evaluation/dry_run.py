"""`vlagents-ray eval … --dry-run`: what would be played, and how long that would take."""

from __future__ import annotations

import datetime

from rich.box import SIMPLE_HEAD
from rich.table import Table

from vlagents_ray.cli.console import out
from vlagents_ray.cli.evaluation.policies import resolve_policies
from vlagents_ray.evaluate import EvalConfig, Results
from vlagents_ray.evaluate.estimate import Forecast, forecasts
from vlagents_ray.evaluate.plan.cases import cells
from vlagents_ray.evaluate.results.database import FILE

_BASES = {
    "results": "from episodes that were played before",
    "measured": "at most, as every episode may end early; without the time that the policy takes",
}


def print_plan(config: EvalConfig) -> None:
    """Print a row for each cell, the sum, and where the times come from. Nothing is served or written."""
    config, _ = resolve_policies(config, ask=False)
    planned = cells(config)
    results = Results.load(config.out) if (config.out / FILE).is_file() else None
    found = forecasts(config, planned, results)
    out.print(_table(found))
    for line in _sum(config, found):
        out.print(line)


def _table(found: list[Forecast]) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=0, pad_edge=False)
    for title in ("policy", "env"):
        table.add_column(title, overflow="fold")
    for title in ("seeds", "episodes", "finished", "to play", "s each", "time"):
        table.add_column(title, justify="right", no_wrap=True)
    for one in found:
        about = "" if one.basis == "results" else "≤ "
        table.add_row(
            one.cell.contender,
            " ".join(filter(None, one.cell.name[1:])),
            str(len(one.cell.suite.seeds)),
            str(one.cell.planned),
            str(one.finished),
            str(one.left),
            "?" if one.seconds is None else f"{about}{one.seconds:.3g}",
            "?" if one.seconds is None else f"{about}{_time(one.left * one.seconds)}",
        )
    return table


def _sum(config: EvalConfig, found: list[Forecast]) -> list[str]:
    planned, finished, left = (
        sum(column) for column in zip(*((f.cell.planned, f.finished, f.left) for f in found), strict=True)
    )
    # Workers share one queue; what is short of a worker's turn is a single episode at the end.
    seconds = sum(one.left * (one.seconds or 0.0) for one in found) / max(1, min(config.workers, left))
    cells = [one.cell for one in found]
    policies, envs = len({cell.contender for cell in cells}), len({(cell.suite.name, cell.env) for cell in cells})
    bases = [text for basis, text in _BASES.items() if any(one.basis == basis for one in found)]
    lines = [
        f"{len(found)} cells: {policies} policies at their checkpoints x {envs} environments of suites",
        f"{planned} episodes, {finished} of them finished in {config.out}, {left} to play",
        f"{_time(seconds)} with {config.workers} workers ({'; '.join(bases) or 'nothing is known of the time'})",
    ]
    unknown = {one.cell.env: one.why for one in found if one.seconds is None}
    return lines + [f"{env}: time unknown: {why}" for env, why in unknown.items()]


def _time(seconds: float) -> str:
    return str(datetime.timedelta(seconds=round(seconds)))
