"""Write random weights of a family's true size, and a deployment file for them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from benchmarks.checkpoints.recipes import write_checkpoint
from vlagents_ray.cli.console import errors, out


def main(
    family: Annotated[str, typer.Argument(help="pi0, smolvla, pi05, act, diffusion or openvla.")],
    folder: Annotated[Path, typer.Argument(help="A new folder.")],
    size: Annotated[
        Literal["full", "small"],
        typer.Option(help="full: the published size; small: a size for a CPU."),
    ] = "full",
    dtype: Annotated[
        str | None,
        typer.Option(help="Type of the weights; default: bfloat16, if the family supports it."),
    ] = None,
) -> None:
    """Write random weights of a family's true size, and a deployment file; run this in the family's
    environment.
    """
    with errors():
        written = write_checkpoint(family, folder, size, dtype)
    out.print(
        f"{written.parameters:,} parameters: python -m benchmarks.policy "
        f"{folder / 'deployment.yaml'} --out FILE"
    )


if __name__ == "__main__":
    typer.run(main)
