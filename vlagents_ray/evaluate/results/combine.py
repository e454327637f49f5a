"""Several folders of results as one, for a report that compares them."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.results.reader import CellResults, Results, Run, Worker
from vlagents_ray.evaluate.results.summary import checkpoint_of, weights_of


def combined(folders: Sequence[Results]) -> Results:
    """Combine the results of several folders.

    A policy that two folders have in the same env, or with other weights under the same name of its checkpoint, gets
    the folder's name appended: "pi0 (second)".

    Raises:
        ConfigError: There is no folder, or two of them are parts of one evaluation, which are merged, not compared.
    """
    if not folders:
        raise ConfigError("report: got no folder, want one or more that evaluations wrote their results to")
    if len(folders) == 1:
        return folders[0]
    _require_apart(folders)
    counts = Counter((cell.contender, cell.suite, cell.env) for each in folders for cell in each.cells)
    clashing = {cell.policy for each in folders for cell in each.cells if counts[_name(cell)] > 1}
    clashing |= _of_other_weights(folders)
    base = Path(os.path.commonpath([each.out.resolve() for each in folders]))
    cells: list[CellResults] = []
    runs: list[Run] = []
    policies: dict[str, dict[str, Any]] = {}
    workers: list[Worker] = []
    for each, label in zip(folders, _labels(folders, base), strict=True):
        names = {
            cell.policy: f"{cell.policy} ({label})" if cell.policy in clashing else cell.policy for cell in each.cells
        }
        prefix = each.out.resolve().relative_to(base)
        cells += [_moved(cell, names[cell.policy], prefix, len(runs)) for cell in each.cells]
        policies |= {names.get(name, name): said for name, said in each.policies.items()}
        workers += [
            replace(one, policy=names.get(one.policy, one.policy), run=one.run + len(runs)) for one in each.workers
        ]
        runs += [replace(run, run=run.run + len(runs)) for run in each.runs]
    parts = tuple(sorted((each.out.resolve() for each in folders), reverse=True))  # a folder before the one it is in
    return Results(base, tuple(cells), tuple(runs), policies, tuple(workers), parts)


def _require_apart(folders: Sequence[Results]) -> None:
    seen: dict[str, Path] = {}
    for each in folders:
        for cell in each.cells:
            if (first := seen.setdefault(cell.cell, each.out)) is not each.out:
                raise ConfigError(
                    f"report: {first} and {each.out} both have {cell.contender!r} in {cell.env!r} with the same "
                    f"settings; put parts of one evaluation into one folder first: `vlagents-ray merge OUT {first} "
                    f"{each.out}`, with --accept-changes if code or weights changed between them"
                )


def _of_other_weights(folders: Sequence[Results]) -> set[str]:
    """The policies of which a checkpoint's name stands for several weights."""
    first: dict[tuple[str, str | None], str] = {}  # by policy id and checkpoint
    found = set()
    for cell in (cell for each in folders for cell in each.cells):
        weights = weights_of(cell)
        if weights is not None and first.setdefault((cell.contender, checkpoint_of(cell)), weights) != weights:
            found.add(cell.policy)
    return found


def _labels(folders: Sequence[Results], base: Path) -> list[str]:
    """Names of the folders: their last parts, or their paths under `base` if last parts are the same."""
    names = [each.out.resolve().name for each in folders]
    if len(set(names)) == len(names):
        return names
    return [str(each.out.resolve().relative_to(base)) for each in folders]


def _name(cell: CellResults) -> tuple[str, str, str]:
    return cell.contender, cell.suite, cell.env


def _moved(cell: CellResults, policy: str, prefix: Path, runs_before: int) -> CellResults:
    episodes = tuple(
        replace(one, run=one.run + runs_before, videos=tuple(str(prefix / video) for video in one.videos))
        for one in cell.episodes
    )
    attempts = tuple(replace(one, run=one.run + runs_before) for one in cell.attempts)
    return replace(cell, policy=policy, episodes=episodes, attempts=attempts)
