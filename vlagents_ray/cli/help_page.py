"""The help of a command, in one layout for commands of argparse and of Typer.

This module is in the light install, so it uses neither Typer nor Rich.
"""

from __future__ import annotations

import importlib.metadata
import os
import shutil
import sys
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

_MOST_COLUMNS = 100
_TERM_COLUMNS = 26  # maximum width of a term on the same line as its description
_BOLD, _PLAIN = "\033[1m", "\033[0m"
HELP = "Show this help and exit."
VERSION = "Print the version and exit."


@dataclass(frozen=True)
class HelpRow:
    """An argument, an option or a command.

    Attributes:
        term: The text that a user types, such as "--out FOLDER".
        about: The description, a sentence.
        default: The default in words; empty if there is no default, or if it is obvious.
        required: Whether the argument is required.
    """

    term: str
    about: str
    default: str = ""
    required: bool = False

    @property
    def sentence(self) -> str:
        """The description, with the default."""
        if self.required:
            return f"{self.about} [required]".lstrip()
        if self.default:
            return f"{self.about} [default: {self.default}]".lstrip()
        return self.about


@dataclass(frozen=True)
class HelpPanel:
    """A group of rows.

    Attributes:
        title: The title of the group.
        rows: The rows.
        note: A sentence about the group; may be empty.
    """

    title: str
    rows: tuple[HelpRow, ...]
    note: str = ""


@dataclass(frozen=True)
class HelpPage:
    """The help of a command.

    Attributes:
        usage: The command and its arguments on one line.
        description: The description; empty lines separate its paragraphs.
        panels: The groups of arguments, options and commands.
        examples: Command lines, without a prompt.
    """

    usage: str
    description: str
    panels: tuple[HelpPanel, ...]
    examples: tuple[str, ...] = ()

    def text(self, columns: int | None = None, *, bold: bool | None = None) -> str:
        """Return the help as text.

        Args:
            columns: The width in columns; None uses the width of the terminal, at most 100.
            bold: Whether the titles are bold; None makes them bold on a terminal.
        """
        if columns is None:
            columns = min(_MOST_COLUMNS, shutil.get_terminal_size((_MOST_COLUMNS, 24)).columns)
        if bold is None:
            bold = sys.stdout.isatty() and "NO_COLOR" not in os.environ

        def title(text: str) -> str:
            return f"{_BOLD}{text}{_PLAIN}" if bold else text

        lines = [f"{title('Usage:')} {self.usage}"]
        for paragraph in paragraphs(self.description):
            lines += ["", *_wrapped(paragraph, columns)]
        for panel in self.panels:
            lines += ["", title(f"{panel.title}:")]
            term_columns = _TERM_COLUMNS
            if panel.rows:
                longest = max(len(row.term) for row in panel.rows)
                term_columns = min(_TERM_COLUMNS, longest)
            for row in panel.rows:
                lines += _row_lines(row, term_columns, columns)
            if panel.note:
                lines += _wrapped(panel.note, columns, "  ")
        if self.examples:
            lines += ["", title("Examples:")]
            lines += [f"  $ {example}" for example in self.examples]
        return "\n".join(lines) + "\n"


def row(term: str, about: str, default: str = "", *, required: bool = False) -> HelpRow:
    """Return a row; its default may be given at the end of the description.

    Args:
        term: The text that a user types.
        about: The description, which may end with "; default: " and the default.
        default: The default, if the description does not contain it.
        required: Whether the argument is required.
    """
    about, separator, stated = about.partition("; default: ")
    if separator:
        default = stated.rstrip(".")
        about += "."
    return HelpRow(term, about, default, required)


def default_text(value: Any) -> str:
    """Return a default value as a user would type it; empty if there is no default, or if it is an
    empty value.
    """
    if value is None or isinstance(value, bool) or value in ("", [], ()) or value is Ellipsis:
        return ""
    if isinstance(value, float):
        return f"{value:g}"
    return str(getattr(value, "value", value))


def paragraphs(text: str) -> list[str]:
    """Split a docstring into paragraphs without line breaks."""
    blocks = textwrap.dedent(text).strip().split("\n\n")
    return [" ".join(block.split()) for block in blocks if block.strip()]


def version_line() -> str:
    """Return the line that --version prints."""
    return f"vlagents-ray {importlib.metadata.version('vlagents-ray')}"


def error_line(message: str) -> str:
    """Return an error as all commands print it; click has the same form for its own errors."""
    return f"Error: {message}"


def usage_error(usage: str, command: str, message: str) -> str:
    """Return the error message for invalid arguments.

    Args:
        usage: The usage of the command, on one line.
        command: The command, such as "vlagents-ray robot".
        message: The reason.
    """
    return f"Usage: {usage}\nTry '{command} --help' for help.\n\n{error_line(message)}\n"


def _row_lines(row: HelpRow, term_columns: int, columns: int) -> Iterable[str]:
    """Return the lines of a row; the first line begins with the term."""
    indent = " " * (term_columns + 4)
    lines = _wrapped(row.sentence, columns, indent)
    if len(row.term) > term_columns:
        return [f"  {row.term}", *lines]
    first = lines[0] if lines else ""
    return [f"  {row.term:<{term_columns}}  {first.strip()}".rstrip(), *lines[1:]]


def _wrapped(text: str, columns: int, indent: str = "") -> list[str]:
    """Wrap a text at spaces."""
    return textwrap.wrap(
        text,
        max(columns, len(indent) + 20),
        initial_indent=indent,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
