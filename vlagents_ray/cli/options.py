"""Options that several commands of `vlagents-ray bench` have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

PEERS_DIR = Path(".venv-peers")
DEFAULT_PEERS_PYTHON = PEERS_DIR / "bin" / "python"

Json = Annotated[Path | None, typer.Option("--json", help="Write the figures here.")]
Plot = Annotated[Path | None, typer.Option("--plot", help="Draw the figures here: .png, .svg or .pdf.")]
PeersPython = Annotated[
    Path, typer.Option(help="The Python of the peers' environment, which `bench peers-setup` makes.")
]
