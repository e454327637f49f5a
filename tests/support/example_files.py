"""The files of examples/."""

from __future__ import annotations

import json
from pathlib import Path

from readme_blocks import DOCUMENTED_HOST, ROOT, Block

EXAMPLES = ROOT / "examples"


def code_of(notebook: Path, server: str | None = None) -> Block:
    """The cells of a notebook in their order, as one block of Python; raises `ValueError` if it has outputs."""
    cells = [cell for cell in json.loads(notebook.read_text())["cells"] if cell["cell_type"] == "code"]
    if kept := [cell["id"] for cell in cells if cell["outputs"] or cell["execution_count"]]:
        raise ValueError(f"{notebook.name}: got outputs in {kept}, want none; clear them")
    code = "\n".join("".join(cell["source"]) for cell in cells).replace("localhost:8000", DOCUMENTED_HOST)
    return Block("python", 1, code, server)
