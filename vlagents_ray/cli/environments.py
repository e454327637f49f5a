"""`vlagents-ray env`: Python environments for policies."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vlagents_ray.cli.console import errors, out

env = typer.Typer(no_args_is_help=True, help="Python environments for policies that the server's own does not suit.")


@env.callback()
def _group() -> None:
    """Keeps `make` a command of its own."""


@env.command("make")
def make(
    requirements: Annotated[Path, typer.Argument(help="A requirements file: requirements/lerobot.txt.")],
    into: Annotated[Path | None, typer.Option(help="Folder; default: .venv- and the file's name.")] = None,
    more: Annotated[list[Path], typer.Option("--with", help="A further requirements file, repeatable.")] = [],  # noqa: B006
    python: Annotated[str | None, typer.Option(help="A version (3.12) or an interpreter; default: this one.")] = None,
    light: Annotated[bool, typer.Option("--light", help="Without Ray, for a child process.")] = False,
) -> None:
    """Make a virtual environment with this vlagents-ray and a policy's requirements, and say how to use it."""
    from vlagents_ray.serve.environments.making import make_environment

    folder = into or Path(f".venv-{requirements.stem}")
    with errors():
        made = make_environment(
            requirements,
            folder,
            more=more,
            python=python,
            light=light,
            tell=lambda text: out.print(text, highlight=False),
        )
    out.print(f"ready; in a deployment file, under args:\n\nenvironment:\n  python: {made}", highlight=False)
