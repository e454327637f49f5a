"""The commands of `vlagents-ray` in README and docs."""

from __future__ import annotations

import re
import shlex
from typing import Any

from readme_blocks import ROOT
from typer.main import get_command

from vlagents_ray.cli.main import app

DOCS = ROOT / "docs"
TUTORIALS = sorted(page for page in (DOCS / "tutorials").glob("*.md") if page.name != "index.md")
COMMAND: Any = get_command(app)  # of click, or of what typer has of it
PAGES = sorted([ROOT / "README.md", ROOT / "SECURITY.md", *DOCS.rglob("*.md")])


def commands(text: str) -> list[tuple[str, bool]]:
    """The commands of `vlagents-ray` in a page, and whether one stands in a block, whole, and not in a sentence."""
    blocks = re.findall(r"```(?:bash|sh|console)\n(.*?)```", text, re.DOTALL)
    lines = [line.strip().removeprefix("$ ") for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    typed = [line for line in lines if re.match(r"(\w+=\S+ )*vlagents-ray ", line)]
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    mentioned = [" ".join(one.split()) for one in re.findall(r"`(vlagents-ray [^`]*)`", prose)]
    return [(line, True) for line in typed] + [(line, False) for line in mentioned]


def read_as_typed(line: str, *, whole: bool) -> None:
    """Raise what the command would say of its words before it does anything; of a mention some may be left out."""
    if not whole:
        line = re.sub(r"[\[\]…]", "", line)  # what is optional, and what is anything
    words = re.split(r" (?:\d?>|\||&)", line)[0]  # what the shell reads
    arguments = shlex.split(words, comments=True)
    arguments = arguments[arguments.index("vlagents-ray") + 1 :]
    command = COMMAND
    try:
        while hasattr(command, "resolve_command") and arguments:
            _, command, arguments = command.resolve_command(command.context_class(command), arguments)
        command.make_context(line, arguments)
    except Exception as error:
        left_out = type(error).__name__ in ("MissingParameter", "NoArgsIsHelpError") or "requires an argument" in str(
            error
        )
        if whole or not left_out:
            raise ValueError(f"{line}: {getattr(error, 'format_message', error.__str__)()}") from error
