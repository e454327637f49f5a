"""`vlagents-ray merge`: results of several machines in one folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vlagents_ray.cli.console import errors, out


def merge_command(
    into: Annotated[Path, typer.Argument(metavar="OUT", help="New folder.")],
    folders: Annotated[list[Path], typer.Argument(metavar="FOLDER...", help="Folders of results, which stay.")],
    keep_first: Annotated[
        bool,
        typer.Option("--keep-first", help="Of different outcomes of an episode keep that of the folder named first."),
    ] = False,
) -> None:
    """Put results together: each episode once, by its key; videos and trajectories go along."""
    from vlagents_ray.evaluate import print_summary
    from vlagents_ray.evaluate.merge import merge

    with errors():
        print_summary(out, merge(into, folders, keep_first=keep_first))
