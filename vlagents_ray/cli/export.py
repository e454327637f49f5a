"""`vlagents-ray export`: results for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vlagents_ray.cli.console import errors, out
from vlagents_ray.errors import ConfigError


def export_command(
    folder: Annotated[Path, typer.Argument(metavar="OUT", help="Folder of the results.")],
    path: Annotated[Path, typer.Argument(metavar="PATH", help="File to write; of lerobot, a new folder.")],
    to: Annotated[str, typer.Option(help="json, csv, parquet: a row an episode; lerobot: a dataset of what was seen.")],
    policy: Annotated[str | None, typer.Option(help="Only this one: NAME, or NAME@STEP in a sweep.")] = None,
    env: Annotated[str | None, typer.Option(help="Only this one.")] = None,
) -> None:
    """Write the episodes of an evaluation as JSON, CSV, Parquet or a LeRobotDataset v3.0."""
    from vlagents_ray.evaluate import Results
    from vlagents_ray.evaluate.exports import EXPORTS

    with errors():
        if to not in EXPORTS:
            raise ConfigError(f"--to: got {to!r}, want one of {', '.join(EXPORTS)}")
        number = EXPORTS[to](Results.load(folder).only(policy, env), path)
    out.print(f"wrote {number} episodes to {path}", highlight=False, markup=False, soft_wrap=True)
