"""The tables of docs/measured_tables.md that `benchmarks.report` does not measure itself, in
`further_tables.json`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

FILE = Path(__file__).with_name("further_tables.json")


@dataclass(frozen=True, slots=True)
class FurtherTable:
    """A section of the page: one or two sentences, and a table."""

    title: str
    caption: str
    command: str  # command that repeats the measurement
    date: str
    head: list[str]
    rows: list[list[str]]

    def to_markdown(self) -> str:
        """Return the section; the caption contains the origin of the table."""
        origin = f"(`{self.command}`, {self.date})"
        table = table_markdown(self.head, self.rows)
        return f"## {self.title}\n\n{self.caption} {origin}:\n\n{table}"


def table_markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def read_tables(file: Path = FILE) -> list[FurtherTable]:
    """Return the tables of a file, in the order of the page."""
    return [FurtherTable(**table) for table in json.loads(file.read_text())]


def replace_rows(
    title: str, head: list[str], rows: list[list[str]], date: str, file: Path = FILE
) -> None:
    """Write a new measurement into the table with this title.

    Args:
        title: Title of a table in the file.
        head: Headings of the columns.
        rows: Cells of each row.
        date: Date of the measurement.
        file: File of the tables.

    Raises:
        KeyError: No table has this title.
    """
    tables = read_tables(file)
    if title not in {table.title for table in tables}:
        raise KeyError(f"{file}: expected a table {title!r}, got none")
    changed = [
        replace(table, head=head, rows=rows, date=date) if table.title == title else table
        for table in tables
    ]
    text = json.dumps([asdict(table) for table in changed], indent=1, ensure_ascii=False)
    file.write_text(f"{text}\n")
