"""Results of several folders, combined for a report that compares them."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.results.changes import changed
from vlagents_ray.evaluate.results.reader import CellResults, Results, Run, Worker
from vlagents_ray.evaluate.results.summary import stated


def require_distinct(folders: Iterable[Path]) -> None:
    """Raise `ConfigError` if one folder is named twice, possibly by other paths."""
    paths: dict[Path, Path] = {}
    for folder in folders:
        first = paths.setdefault(folder.resolve(), folder)
        if first is not folder:
            also = "twice" if str(first) == str(folder) else f"also as {first}"
            raise ConfigError(f"{folder}: is named {also}; name each folder once")


def combined(folders: Sequence[Results]) -> Results:
    """Combine the results of several folders.

    If two folders have a policy in the same env, or with other files, or with other weights under the same checkpoint's
    name, the folder's name is appended: "pi0 (second)".

    Raises:
        ConfigError: There is no folder, or two of them are parts of one evaluation, which are merged, not compared.
    """
    if not folders:
        raise ConfigError("report: got no folder, want one or more that evaluations wrote their results to")
    if len(folders) == 1:
        return folders[0]
    require_distinct(each.out for each in folders)
    seen: dict[str, Path] = {}
    for each in folders:
        for cell in each.cells:
            if (first := seen.setdefault(cell.cell, each.out)) is not each.out:
                raise ConfigError(
                    f"report: {first} and {each.out} both have {cell.contender!r} in {cell.env!r} with the same "
                    f"settings; put parts of one evaluation into one folder first: `vlagents-ray merge {first} "
                    f"{each.out} --out OUT`, with --accept-changes if code or weights changed between them"
                )
    every = [cell for each in folders for cell in each.cells]
    counts = Counter((cell.contender, cell.suite, cell.env) for cell in every)
    clashing = {cell.policy for cell in every if counts[cell.contender, cell.suite, cell.env] > 1}
    known: dict[tuple[str, str | None], str] = {}  # the weights by policy id and checkpoint
    for cell in every:
        weights, checkpoint = stated(cell, "weights"), stated(cell, "checkpoint")
        if weights is not None and known.setdefault((cell.contender, checkpoint), weights) != weights:
            clashing.add(cell.policy)
    swept = {cell.policy for cell in every if cell.step is not None}
    metadata: dict[str, dict[str, Any]] = {}  # of the first folder with the policy
    for each in folders:
        for name, of_server in each.policies.items():
            if changed(metadata.setdefault(name, of_server), of_server, swept=name in swept) is not None:
                clashing.add(name)
    homes = [each.out.resolve() for each in folders]
    base = Path(os.path.commonpath(homes))
    cells: list[CellResults] = []
    runs: list[Run] = []
    policies: dict[str, dict[str, Any]] = {}
    workers: list[Worker] = []
    # The folders' last parts or, if some are the same, their paths under `base`.
    labels = [home.name for home in homes]
    if len(set(labels)) < len(labels):
        labels = [str(home.relative_to(base)) for home in homes]
    for each, home, label in zip(folders, homes, labels, strict=True):
        names = {
            cell.policy: f"{cell.policy} ({label})" if cell.policy in clashing else cell.policy for cell in each.cells
        }
        prefix = home.relative_to(base)
        for cell in each.cells:
            episodes = tuple(
                replace(one, run=one.run + len(runs), videos=tuple(str(prefix / video) for video in one.videos))
                for one in cell.episodes
            )
            attempts = tuple(replace(one, run=one.run + len(runs)) for one in cell.attempts)
            cells.append(replace(cell, policy=names[cell.policy], episodes=episodes, attempts=attempts))
        policies |= {names.get(name, name): said for name, said in each.policies.items()}
        workers += [
            replace(one, policy=names.get(one.policy, one.policy), run=one.run + len(runs)) for one in each.workers
        ]
        runs += [replace(run, run=run.run + len(runs)) for run in each.runs]
    parts = tuple(sorted(homes, reverse=True))  # subfolders before their parents
    return Results(base, tuple(cells), tuple(runs), policies, tuple(workers), parts)
