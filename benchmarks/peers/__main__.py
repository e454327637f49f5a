"""Installs other policy servers, at pinned versions, in two separate Python environments."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.peers import FOLDER, TORCH, TORCH_REQUIREMENTS, set_up
from vlagents_ray.cli.console import errors, out, progress


def main(
    folder: Annotated[Path, typer.Option("--dir", help="Folder of the environment.")] = FOLDER,
) -> None:
    """Install other policy servers, at pinned versions, in separate Python environments."""
    with errors():
        python = set_up(folder, progress=progress)
        set_up(folder.with_name(folder.name + TORCH), TORCH_REQUIREMENTS, progress)
    used = "" if folder == FOLDER else f" --peers-python {python}"
    out.print(f"ready: python -m benchmarks.rtt --peers all{used}")


if __name__ == "__main__":
    typer.run(main)
