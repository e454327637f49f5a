"""Draw the pictures of terminals: `COMMAND | python docs/pictures/terminal.py "COMMAND" FILE` draws
the output of a command, with its colours, as an SVG.

    export FORCE_COLOR=1 COLUMNS=88
    vlagents-ray eval tabletop --policy scripted --episodes 20 --out runs/first |
        python docs/pictures/terminal.py \\
        "vlagents-ray eval tabletop --policy scripted --episodes 20 --out runs/first" \\
        docs/pictures/eval.svg
    vlagents-ray robot check mujoco:so101_new_calib.xml --robot-set like=so101 |
        python docs/pictures/terminal.py \\
        "vlagents-ray robot check mujoco:so101_new_calib.xml --robot-set like=so101" \\
        docs/pictures/check.svg

The background is dark in both colour schemes, as in many terminals.
"""

from __future__ import annotations

import re
import sys
import textwrap
from html import escape
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.segment import Segment
from rich.text import Text

# Number of columns; width of a character, height of a line and margin in px, at a font size of 14
# px.
COLUMNS, CHARACTER, LINE, MARGIN = 88, 8.43, 20, 16
PAPER, INK, PROMPT = "#12161b", "#e8ebef", "#5fd3a3"
COLOURS = {
    "green": "#5fd3a3",
    "red": "#ff9a85",
    "yellow": "#e3c34a",
    "cyan": "#6cb6f0",
    "blue": "#6cb6f0",
    "magenta": "#e79bc9",
}
# Groups of words without the spaces between columns, since an SVG may not keep these spaces.
_WORDS = re.compile(r"\S+( \S+)*")
_FONTS = "ui-monospace, SFMono-Regular, Menlo, Consolas, 'DejaVu Sans Mono', monospace"


def draw(command: str, output: str) -> str:
    """Return the picture of a terminal in which a command was run.

    Args:
        command: The command, shown after a prompt.
        output: The command's output, with ANSI codes for colours.
    """
    prompt = Text("$ ", PROMPT)
    prompt.append(command, f"bold {INK}")
    text = Text("\n").join([prompt, Text.from_ansi(output.rstrip())])
    console = Console(width=COLUMNS, color_system="truecolor", file=sys.stderr)
    lines = console.render_lines(text, pad=False)
    width = round(COLUMNS * CHARACTER + 2 * MARGIN)
    height = len(lines) * LINE + 2 * MARGIN
    parts = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
            f'viewBox="0 0 {width} {height}" role="img">'
        ),
        f"<title>{escape(command)}</title>",
        f'<rect width="{width}" height="{height}" rx="10" fill="{PAPER}"/>',
        f'<g font-family="{_FONTS}" font-size="14" fill="{INK}">',
    ]
    for number, line in enumerate(lines):
        y = MARGIN + number * LINE + 15
        column = 0
        for segment in line:
            parts += _drawn(segment, column, y)
            column += segment.cell_length
    return "\n".join([*parts, "</g></svg>"]) + "\n"


def _drawn(segment: Segment, column: int, y: int) -> list[str]:
    """Return the words of a segment, each group at its own column, so that the columns align with
    any font.
    """
    style = segment.style
    attributes = ""
    if style is not None and style.color is not None:
        colour = COLOURS.get(style.color.name.removeprefix("bright_"), style.color.name)
        attributes += f' fill="{colour if colour.startswith("#") else INK}"'
    if style is not None and style.bold:
        attributes += ' font-weight="700"'
    if style is not None and style.italic:
        attributes += ' font-style="italic"'
    return [
        f'<text x="{MARGIN + (column + words.start()) * CHARACTER:.1f}" y="{y}" '
        f'textLength="{len(words[0]) * CHARACTER:.1f}"{attributes}>{escape(words[0])}</text>'
        for words in _WORDS.finditer(segment.text)
    ]


def main(
    command: Annotated[str, typer.Argument(help="The command whose output is on stdin.")],
    file: Annotated[Path, typer.Argument(help="The picture, an SVG.")],
) -> None:
    """Draw the output of a command."""
    wrapped = textwrap.fill(command, COLUMNS - 4, subsequent_indent="    ")
    file.write_text(draw(wrapped, sys.stdin.read()))


if __name__ == "__main__":
    typer.run(main)
