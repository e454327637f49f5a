"""`vlagents-ray replay`: one episode again, and whether it is the same."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from vlagents_ray.cli.console import errors, fresh, out
from vlagents_ray.cli.evaluation import Address, evaluated


def replay_command(
    folder: Annotated[Path, typer.Argument(metavar="OUT", help="Folder of the results.")],
    episode: Annotated[str, typer.Argument(help="Its key, or ENV#NUMBER: 'tabletop#3'.")],
    policy: Annotated[
        str | None, typer.Option(help="A registered name, a deployment file, or a URL, in place of the run's own.")
    ] = None,
    out_dir: Annotated[
        Path | None, typer.Option("--out", help="Folder of the replay, with its video; default: a new one below OUT.")
    ] = None,
    address: Address = None,
) -> None:
    """Play an episode of an evaluation again, and compare: exit code 0 if every action and its outcome is the same."""
    from vlagents_ray.evaluate import Results
    from vlagents_ray.evaluate.replay import compare, find

    with errors():
        recorded = find(Results.load(folder), episode)
        other: dict[str, Any] | None = None
        if policy is not None:
            other = {"source": policy, "url": None, "config": {}, "checkpoint": None}
        into = out_dir or fresh(folder / "replays" / "replay")
        summary = evaluated(recorded.config(into, policy=other), address, only=recorded.number_and_seed)
        found = compare(recorded, summary.results)
    steps = recorded.episode.result.steps
    lines = found or [f"the same: {steps} actions byte for byte, and what came of them"]
    for line in [*lines, f"replay: {into}"]:
        out.print(line, highlight=False, markup=False, soft_wrap=True)
    raise typer.Exit(bool(found))
